"""Which frames of a map are worth registering first."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame_registration import FramePrior

PhotoReader = Callable[[MapImage], NDArray[np.uint8]]

_VIEW_WIDTH_PX = 200  # of the renders that tell coverage; figures change by a hundredth with twice as many
_GRID = 8  # cells along each side of the photo in which map points are counted
# Frames that see less of the scan are not proposed; scans have holes (brighton's frames see 0.4 to 0.65), but
# a quarter of a photo must have something to match.
_MIN_COVERAGE = 0.25
# Map points seen by a frame after which more do not help: structure projection works with hundreds.
_ENOUGH_POINTS = 300
# The score of a frame is multiplied by 1 - penalty times the share of its map points that frames chosen
# before see already: frames side by side tell of the same corner of the map.
_OVERLAP_PENALTY = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameProposal:
    """How likely a frame registers, with the figures behind it, each from 0 to 1 unless it says otherwise.

    Attributes:
        prior: that its registration starts from.
        score: product of the others' square roots.
        coverage: share of the photo that shows the scan, from the prior.
        downward: mean cosine between viewing rays and the vertical: airborne scans see roofs and ground well,
            walls hardly.
        points: map points seen, a number.
        spread: share of the photo's cells that see map points: blur and water show few.
    """

    image: MapImage
    prior: FramePrior
    score: float
    coverage: float
    downward: float
    points: int
    spread: float


def propose_frames(
    feature_map: FeatureMap, cloud: PointCloud, priors: Mapping[int, FramePrior]
) -> list[FrameProposal]:
    """All frames that see enough of the scan, the most promising first.

    The first few are made to see different parts of the map: each next frame is the one with the
    best score after its overlap with those before it is counted against it.

    Args:
        priors: of the images to be ranked, by image id, in the cloud's frame.
    """
    rough = [
        _proposal(feature_map, image, prior, cloud)
        for image in feature_map.images
        if (prior := priors.get(image.image_id)) is not None
    ]
    rough = [p for p in rough if p.coverage >= _MIN_COVERAGE]
    rough.sort(key=lambda p: (-p.score, p.image.image_id))
    return _spread_out(feature_map, rough)


def _proposal(
    feature_map: FeatureMap, image: MapImage, prior: FramePrior, cloud: PointCloud
) -> FrameProposal:
    camera = feature_map.cameras[image.camera_id]
    small = small_camera(camera, _VIEW_WIDTH_PX)
    seen = render(cloud, small, prior.cam_from_local, RenderOptions(attributes=False))
    valid = seen.valid
    coverage = float(valid.mean())
    points = len(np.unique(feature_map.points_in(image)))
    xy = feature_map.observations.xy[feature_map.observations.image_id == image.image_id]
    cells = xy / [camera.width, camera.height] * _GRID
    spread = len(np.unique(np.floor(cells).clip(0, _GRID - 1), axis=0)) / _GRID**2
    downward = _downward(small, prior.cam_from_local, valid)
    score = float(np.prod(np.sqrt([coverage, downward, min(points / _ENOUGH_POINTS, 1.0), spread])))
    figures = {"score": score, "coverage": coverage, "downward": downward, "spread": spread}
    return FrameProposal(image=image, prior=prior, points=points, **figures)


def _downward(camera: Camera, pose: Rigid3, valid: NDArray[np.bool_]) -> float:
    """Mean cosine between the rays of valid pixels and straight down, 0 where it is negative."""
    rows, columns = np.nonzero(valid)
    if not len(rows):
        return 0.0
    step = max(1, len(rows) // 2000)
    rays = camera.unproject(np.column_stack([columns, rows])[::step] + 0.5)
    rays = np.column_stack([rays, np.ones(len(rays))])
    up = rays @ pose.rotation[:, 2] / np.linalg.norm(rays, axis=1)
    return float(np.maximum(-up[np.isfinite(up)], 0.0).mean())


def _spread_out(feature_map: FeatureMap, proposals: Sequence[FrameProposal]) -> list[FrameProposal]:
    """Order by score and by what frames before have not seen."""
    sees = {p.image.image_id: np.unique(feature_map.points_in(p.image)) for p in proposals}
    seen = np.zeros(len(feature_map.points), bool)
    left, ordered = list(proposals), []
    while left:
        of = [seen[sees[p.image.image_id]] for p in left]
        values = [
            p.score * (1.0 - _OVERLAP_PENALTY * already.sum() / max(len(already), 1))
            for p, already in zip(left, of, strict=True)
        ]
        chosen = left.pop(int(np.argmax(values)))
        seen[sees[chosen.image.image_id]] = True
        ordered.append(chosen)
    return ordered


def small_camera(camera: Camera, width_px: int) -> Camera:
    """The same lens for a smaller picture of about that width, never a larger one.

    The height is rounded to whole pixels; widths that keep the aspect within a tenth of a percent are found
    for any camera of usual size.
    """
    for width in range(min(width_px, camera.width), camera.width + 1):
        height = max(1, round(width * camera.height / camera.width))
        if abs(height * camera.width / (width * camera.height) - 1) <= 1e-3:
            break
    return camera.scaled_to(width, height)
