"""A frame's pose, and focal length if need be, from pixels of known points: Gauss-Newton, Cauchy loss.

The lens of a film that nobody gave is followed through zooms: its focal length is estimated with every
frame's pose. A lens that stands still is known better with every frame, down to a floor; one that a frame
contradicts is zooming, and each frame has a focal length of its own until it stands still again.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.localise.lens_prior import LensPriors

_REFERENCE_SIDE_PX = 1280  # of the frames that these are for: lengths grow with them
_LOSS_PX, _TOLERANCE_PX = 1.0, 4.0  # of the Cauchy loss; beyond which a landmark does not agree with the pose
_ITERATIONS = 10
_STILL = 1e-5  # radians, and metres over distance: a hundredth of a pixel
# Least eigenvalue of scaled normal equations that have no one solution: one or two points over and over and
# points on a line have 2e-15 and less; a patch of 10 cm, seen from 50 m, still has 2e-7.
_SINGULAR = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FittedPose:
    """A pose and how well it is known."""

    cam_from_local: Rigid3
    inlier: NDArray[np.bool_]  # (n,) pixels within the tolerance
    # (6, 6) of the camera's rotation about the local axes (rad) before the displacement of its centre (m); of
    # independent pixels, scaled by their residuals, and of what they leave open of the lens.
    covariance: FloatArray
    focal_px: float
    focal_rel: float  # standard deviation of the focal length's logarithm; 0 where it was given


@dataclass(frozen=True, slots=True, kw_only=True)
class LensSigmas:
    """Standard deviations of what is not known of a lens; all 0: it is given."""

    focal_rel: float = 0.0  # of the focal length's logarithm, which is fitted with the pose
    # Of principal point and first radial coefficient, which are not: what they may be is in the covariance.
    center_px: float = 0.0
    radial: float = 0.0


GIVEN = LensSigmas()


def fit_pose(
    camera: Camera,
    pixels: FloatArray,
    points: FloatArray,
    start: Rigid3,  # a pose within some degrees and a few per cent of the distance
    doubt: LensSigmas = GIVEN,  # what is not known of the camera
) -> FittedPose | None:
    """Fit the pose to pixels (n, 2) of points (n, 3); None where the points do not determine it."""
    if len(pixels) < 4:
        return None
    focal_rel = doubt.focal_rel
    scale = max(camera.width, camera.height) / _REFERENCE_SIDE_PX
    seen = camera.unproject(pixels)
    points = np.ascontiguousarray(points, dtype=np.float64)
    focal, loss = camera.focal_px, _LOSS_PX * scale
    pose, zoom = start, 0.0
    depth = max(float(np.median(start.act(points)[:, 2])), 1e-6)
    still = np.array([1.0, 1.0, 1.0, *[1.0 / depth] * 3, 1.0])
    # What was known of the focal length weighs as much as pixels that are off by half the loss's scale.
    known_focal = (0.5 * loss / focal_rel) ** 2 if focal_rel > 0.0 else 0.0
    count = 7 if focal_rel > 0.0 else 6
    linearised = compiled_module("reloc.tracking.fit_loops").linearised
    residual, jacobian = np.empty((2, len(points))), np.empty((7, 2, len(points)))
    normal, gradient = np.empty((7, 7)), np.empty(7)

    def linearise() -> None:
        longer = focal * float(np.exp(zoom))
        rotation = np.array(pose.rotation, order="C")  # the loop is compiled for this order, and once
        made = (residual, jacobian, normal, gradient)
        linearised(rotation, pose.translation, points, seen, focal, longer, loss, *made)

    for _ in range(_ITERATIONS):
        linearise()
        if not _is_determined(normal[:6, :6]):
            return None
        normal[6, 6] += known_focal
        gradient[6] += known_focal * zoom
        step = -np.linalg.solve(normal[:count, :count], gradient[:count])
        pose = Rigid3.exp(step[:6]) @ pose
        zoom += float(step[6]) if count == 7 else 0.0
        if np.abs(step * still[:count]).max() < _STILL:
            break
    linearise()
    distance = np.hypot(*residual)
    inlier = np.asarray(distance < _TOLERANCE_PX * scale)
    if inlier.sum() < 4:
        return None
    variance = float((distance[inlier] ** 2).sum()) / max(2 * int(inlier.sum()) - count, 1)
    agreeing = jacobian[:count, :, inlier]
    normal = _product(agreeing, agreeing)
    if not _is_determined(normal[:6, :6]):
        return None
    normal /= max(variance, 1e-4)
    if count == 7:
        normal[6, 6] += 1.0 / focal_rel**2
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    if doubt.center_px > 0.0 or doubt.radial > 0.0:
        lens = _by_lens(seen[inlier], focal)
        moved = covariance @ _product(agreeing, lens) / max(variance, 1e-4)
        sigmas = np.array([doubt.center_px, doubt.center_px, doubt.radial])
        covariance += (moved * sigmas**2) @ moved.T
    return FittedPose(
        cam_from_local=pose,
        inlier=inlier,
        covariance=of_camera(pose, covariance[:6, :6]),
        focal_px=focal * float(np.exp(zoom)),
        focal_rel=float(np.sqrt(covariance[6, 6])) if count == 7 else 0.0,
    )


def warm_up() -> None:
    """Load the compiled loop, or compile it, now: processes that are forked then have it."""
    camera = Camera(model="PINHOLE", width=640, height=480, params=(600.0, 600.0, 320.0, 240.0))
    points = np.array([[-1.0, -1.0, 9.0], [1.0, -1.0, 10.0], [1.0, 1.0, 11.0], [-1.0, 1.0, 12.0]])
    fit_pose(camera, camera.project(points), points, Rigid3.identity())


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    """(a, b) sums over pixels and axes of (a, 2, n) times (b, 2, n)."""
    sums: FloatArray = first.reshape(len(first), -1) @ second.reshape(len(second), -1).T
    return sums


def _is_determined(normal: FloatArray) -> bool:
    """Whether normal equations (6, 6) have one solution, whatever the units of its parts.

    LAPACK finds a matrix singular only where a pivot is exactly zero, which depends on the processor.
    """
    scale = np.sqrt(np.diag(normal))
    if not (np.isfinite(normal).all() and scale.all()):
        return False
    return bool(np.linalg.eigvalsh(normal / np.outer(scale, scale))[0] > _SINGULAR)


def _by_lens(seen: FloatArray, focal: float) -> FloatArray:
    """Derivatives (3, 2, n) of the residuals by principal point (pixels) and first radial coefficient."""
    derivatives = np.zeros((3, 2, len(seen)))
    derivatives[0, 0] = derivatives[1, 1] = 1.0
    derivatives[2] = focal * seen.T * (seen**2).sum(axis=1)
    return derivatives


def of_camera(pose: Rigid3, covariance: FloatArray) -> FloatArray:
    """From the left perturbation of cam_from_local to a rotation about local axes and a moved centre.

    cam_from_local' = exp(xi) cam_from_local: the camera turns by -R^T omega about the local axes, and its
    centre moves by -R^T nu.
    """
    turn = np.kron(np.eye(2), -pose.rotation.T)
    return np.asarray(turn @ covariance @ turn.T, dtype=np.float64)


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
