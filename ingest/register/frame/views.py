"""The photo's features, and renders of the scan from any pose at the size that suits both."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering, RenderOptions, render, shaded_relief
from featuredb.stage_clock import StageClock
from ingest.register.frame_registration import FramePrior, RenderSource

MIN_COVER = 0.03  # smallest share of a render that shows the scan
# Renders for features: so many pixels between scan points, since splats show nothing more, and at most that
# longer side.
FEATURES_SPACING_PX, _FEATURES_SIDE_PX = 1.5, 960
MIN_SIDE_PX = 400  # of any render; smaller pictures show too little

_LOOK_SIDE_PX = 200  # of the first look, which only measures distance and cover
_LOOK_WIDER = 2.0  # and sees so many times as far to every side: the prior may look past the scan


def available_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """What can be rendered of a scan, most telling first."""
    sources: list[RenderSource] = []
    if cloud.rgb is not None:
        sources.append("rgb")
    if cloud.intensity is not None:
        sources.append("intensity")
    return (*sources, "shaded")


def searched_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """Those in which poses are searched, and not only compared.

    Shaded relief has nothing to match and few edges (docs/measurements/descriptors.md): it is searched where
    the scan has no more to show.
    """
    *telling, shaded = available_sources(cloud)
    return tuple(telling) or (shaded,)


def source_image(rendering: Rendering, source: RenderSource) -> NDArray[np.uint8]:
    """(h, w) uint8, what the render shows by one of the scan's properties.

    Raises:
        InvalidValueError: the scan does not have it.
    """
    if source == "shaded":
        return shaded_relief(rendering)
    if source == "rgb" and rendering.rgb is not None:
        return np.asarray(cv2.cvtColor(rendering.rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    if source == "intensity" and rendering.intensity is not None:
        return rendering.intensity
    raise InvalidValueError(f"source_image: expected a scan with {source}, found one without")


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """How one photo is registered.

    Attributes:
        threads: for renders and features; 0 takes as many as the process may use, up to four.
        fit_rounds: of fitting a pose to pieces, in pixels of the render: distance of neighbouring scan points
            there, finer than the scan, since edges between splats are known better than their spacing; least
            side of a piece; how near its place is looked for: the first takes up what the search left.
        more_rounds: at most, like the last one, until the pose moves less than a fifth of a pixel.
        finest_spacing: where pictures are to confirm a pose, a pixel is at least this share of the mean
            distance between scan points.
        min_agreeing: smallest share of their pieces that agree.
    """

    threads: int = 0
    fit_rounds: tuple[tuple[float, int, int], ...] = ((2.4, 28, 10), (3.75, 40, 6), (3.75, 40, 6))
    more_rounds: int = 8
    finest_spacing: float = 1.2
    min_agreeing: float = 0.18


DEFAULTS = FrameOptions()


@dataclass(frozen=True, slots=True, kw_only=True)
class FirstLook:
    """What a pose sees of the scan.

    Attributes:
        depth_m: median distance along the optical axis.
        cover: share of the view, taken twice as wide, that shows the scan.
        spacing_m: between neighbouring points, median over what is seen.
    """

    depth_m: float
    cover: float
    spacing_m: float


def first_look(cloud: PointCloud, camera: Camera, cam_from_local: Rigid3) -> FirstLook | None:
    """Distance, cover and density of the scan where a pose looks; None where it sees nothing."""
    factor = _LOOK_SIDE_PX / max(camera.width, camera.height)
    width, height = (max(round(side * factor), 32) for side in (camera.width, camera.height))
    wide = Camera.from_focal(width, height, camera.focal_px * factor / _LOOK_WIDER, model="PINHOLE")
    rendering = render(cloud, wide, cam_from_local, RenderOptions(attributes=False, threads=1))
    depth = rendering.depth[rendering.valid]
    if len(depth) == 0:
        return None
    rows, nodes = np.unique(rendering.index[rendering.index >= 0]), cloud.nodes
    sample = cloud.xyz[rows[:: max(len(rows) // 200, 1)]]
    inside = (sample[:, None] >= nodes.box_min).all(axis=2) & (sample[:, None] <= nodes.box_max).all(axis=2)
    finest = np.where(inside, nodes.spacing_m, np.inf).min(axis=1)  # of the nodes around each
    return FirstLook(
        depth_m=float(np.median(depth)),
        cover=float(rendering.valid.mean()),
        spacing_m=float(np.median(finest[np.isfinite(finest)])),
    )


@dataclass(frozen=True, eq=False)
class FrameViews:
    """One photo and one scan; renders and features are made on a small pool of threads.

    Attributes:
        gray: (h, w) uint8, the photo. camera: of the photo, full size. look: from the prior.
        clock: of what is done with them.
    """

    gray: NDArray[np.uint8]
    camera: Camera
    cloud: PointCloud
    look: FirstLook
    options: FrameOptions
    clock: StageClock = field(default_factory=StageClock)

    @property
    def threads(self) -> int:
        """So many may be used."""
        return self.options.threads or min(len(os.sched_getaffinity(0)), 4)

    @property
    def spacing_full_px(self) -> float:
        """Distance of neighbouring scan points, in pixels of the full-size photo."""
        return self.look.spacing_m * self.camera.focal_px / self.look.depth_m

    def side_px(self, spacing_px: float, most_px: int) -> int:
        """Longer side of renders in which neighbouring scan points are `spacing_px` apart, within bounds."""
        side = max(self.camera.width, self.camera.height)
        by_scan = round(spacing_px * side / max(self.spacing_full_px, 1e-6))
        return int(np.clip(by_scan, min(MIN_SIDE_PX, side), min(most_px, side)))

    @property
    def features_side_px(self) -> int:
        """Longer side of the renders that features are found in."""
        return self.side_px(FEATURES_SPACING_PX, _FEATURES_SIDE_PX)

    def renders(self, poses: Sequence[Rigid3], side_px: int) -> list[Rendering]:
        """The scan from each pose, no larger than the photo; without those that show next to nothing."""
        camera = self.camera
        factor = min(side_px / max(camera.width, camera.height), 1.0)
        camera = camera.scaled_to(max(round(camera.width * factor), 1), max(round(camera.height * factor), 1))
        single = RenderOptions(threads=1)
        with ThreadPoolExecutor(self.threads) as threads:
            made = list(threads.map(lambda pose: render(self.cloud, camera, pose, single), poses))
        return [r for r in made if r.valid.mean() >= MIN_COVER]

    @cached_property
    def features(self) -> Features:
        """Of the photo, without orientation, at about the size of the renders."""
        return extract(
            self.gray,
            ExtractorOptions(
                first_octave_px=max(round(2.5 * self.features_side_px), 64),
                max_features=5000,
                oversample=1.5,
                contrast_threshold=0.01,
                upright=True,
            ),
        )


# Where the scan is looked at from: a star of poses around the prior (paper, section 2.3).

# The views to the sides stand so many standard deviations of the prior away: pooled with the middle one they
# show what 95 of 100 true poses see.
_ARM_SIGMAS = 1.5
# Of the width that the camera sees; nearer views show nothing new, farther ones nothing in common with the
# middle one.
MIN_ARM_SHARE = 0.08
MAX_ARM_SHARE = 0.4
# A view along the optical axis comes nearer, or goes farther, by at most this factor. SIFT bridges a factor
# of 2 in scale, appearance of splats less.
_MAX_ZOOM = 1.4
_MIN_ZOOM = 1.12  # and by at least this one: the change of scale helps even a good prior
UPRIGHT_REACH_DEG = 15.0  # features without orientation survive a rotation of the image by so much
FULL_CIRCLE_SIGMA_DEG = 75.0  # from here on a heading is taken as unknown


def star_poses(prior: FramePrior, depth_m: float, camera: Camera) -> list[Rigid3]:
    """Seven poses: the prior's, two to either side, two up and down the image, nearer and farther.

    Args:
        depth_m: distance along the optical axis to what the prior sees.
        camera: of the photo, for the width that it sees at that distance.

    Returns:
        Poses cam_from_local with the prior's rotation, the prior's own first.
    """
    rotation, center = prior.cam_from_local.rotation, prior.cam_from_local.center
    right, down, forward = rotation
    seen_m = depth_m * min(camera.width, camera.height) / camera.focal_px
    turned_m = depth_m * np.radians(prior.sigma_tilt_deg)
    offsets = [np.zeros(3)]
    for axis in (right, down):
        wanted = _ARM_SIGMAS * float(np.hypot(_sigma_along(prior, axis), turned_m))
        arm = np.clip(wanted, MIN_ARM_SHARE * seen_m, MAX_ARM_SHARE * seen_m)
        offsets += [arm * axis, -arm * axis]
    zoom = 1.0 + _ARM_SIGMAS * _sigma_along(prior, forward) / depth_m
    zoom = float(np.clip(zoom, _MIN_ZOOM, _MAX_ZOOM))
    offsets += [depth_m * (1.0 - 1.0 / zoom) * forward, -depth_m * (zoom - 1.0) * forward]
    return [Rigid3.from_center(rotation, center + offset) for offset in offsets]


def fan_headings_deg(sigma_heading_deg: float) -> list[float]:
    """Turns about the vertical that upright features need, 0 first; the full circle if nothing is known."""
    step = 2.0 * UPRIGHT_REACH_DEG
    if sigma_heading_deg >= FULL_CIRCLE_SIGMA_DEG:
        return [i * step for i in range(round(360.0 / step))]
    reach = 2.0 * sigma_heading_deg  # 95 of 100 priors
    side = max(int(np.ceil((reach - UPRIGHT_REACH_DEG) / step)), 0)
    return [0.0, *(sign * i * step for i in range(1, side + 1) for sign in (1.0, -1.0))]


def turned_about_vertical(cam_from_local: Rigid3, angle_deg: float) -> Rigid3:
    """The camera at the same place, its heading turned clockwise seen from above."""
    turn = so3_exp([0.0, 0.0, np.radians(angle_deg)])
    return Rigid3.from_center(cam_from_local.rotation @ turn, cam_from_local.center)


def _sigma_along(prior: FramePrior, axis: FloatArray) -> float:
    sigma = np.array([prior.sigma_horizontal_m, prior.sigma_horizontal_m, prior.sigma_vertical_m])
    return float(np.linalg.norm(sigma * axis))
