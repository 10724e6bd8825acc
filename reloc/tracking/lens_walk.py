"""The lens of a film that nobody gave: its focal length is estimated with every frame's pose, through zooms.

A lens that stands still is known better with every frame, down to a floor; one that a frame contradicts is
zooming, and each frame has a focal length of its own until it stands still again.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from featuredb.geometry.camera import Camera
from reloc.localise.lens_prior import LensPriors
from reloc.tracking.pose_fit import LensSigmas

# How a focal length is followed; shares of it are standard deviations of its logarithm.
_ESTIMATED_REL = 0.2  # of a lens that the first frame was localised with
_PRIORS = LensPriors()  # of its principal point and first radial coefficient: one frame tells little of them
# Of one that the map lends, whose points agree with it; and of many frames, which share their errors and do
# not tell more than this.
_FLOOR_REL = 0.001
_ZOOM_REL = 0.03  # from one frame to the next; quick ones go through two to one in a second, 3 % a frame
# Times its standard deviation by which a frame's focal length may differ from what was known; beyond the lens
# is zooming. One of sixteen thousand frames differs by more by chance, and then has a pose that is less sure,
# no wrong one.
_SURPRISE = 4.0
STILL_S = 1.0  # a lens that has not changed for so long is not zooming


@dataclass(slots=True, kw_only=True, eq=False)
class LensWalk:
    """A lens as the last frame has it."""

    camera: Camera
    rel: float  # how sure its focal length is
    lent: bool  # by a map, whose points agree with its principal point and distortion
    zooming: bool = False  # it may change
    _seen: deque[tuple[float, float, float]] = field(default_factory=deque)

    @classmethod
    def begun(cls, camera: Camera, *, lent: bool) -> "LensWalk":
        """With the lens of the first frame."""
        return cls(camera=camera, rel=_FLOOR_REL if lent else _ESTIMATED_REL, lent=lent)

    @property
    def before_rel(self) -> float:
        """How sure the next frame's focal length is before it is looked at."""
        walk = _ZOOM_REL if self.zooming else 0.0
        return float(np.hypot(max(self.rel, _FLOOR_REL), walk))

    @property
    def doubt(self) -> LensSigmas:
        """What is not known of the lens before the next frame is looked at."""
        if self.lent:
            return LensSigmas(focal_rel=self.before_rel)
        longer = max(self.camera.width, self.camera.height)
        return LensSigmas(
            focal_rel=self.before_rel, center_px=_PRIORS.center_rel * longer, radial=_PRIORS.radial
        )

    def surprised(self, focal_px: float, focal_rel: float) -> bool:
        """Whether a frame's focal length contradicts what was known of it."""
        if self.zooming:
            return False
        spread = np.sqrt(max(self.before_rel**2 - focal_rel**2, 1e-12))
        return bool(abs(np.log(focal_px / self.camera.focal_px)) > _SURPRISE * spread)

    def zooms(self) -> None:
        """From now on the focal length may change."""
        self.zooming = True
        self._seen.clear()

    def take(self, focal_px: float, focal_rel: float, time_s: float) -> None:
        """The focal length of the frame at a time, as it was estimated."""
        self.camera, self.rel = self.camera.with_focal(focal_px), focal_rel
        if not self.zooming:
            return
        self._seen.append((time_s, float(np.log(focal_px)), focal_rel))
        while self._seen[-1][0] - self._seen[0][0] > 2.0 * STILL_S:
            self._seen.popleft()
        if time_s - self._seen[0][0] < STILL_S:
            return
        recent = np.array([one for one in self._seen if time_s - one[0] <= STILL_S])
        half = len(recent) // 2
        if not half:  # frames are that far apart
            return
        change = abs(recent[:half, 1].mean() - recent[half:, 1].mean())
        if change < 0.5 * _SURPRISE * recent[:, 2].mean():
            self.zooming = False
            self._seen.clear()
