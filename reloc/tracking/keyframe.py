"""A keyframe against the feature map: where its pose says points are, or, without one, anywhere."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import IncompatibleExtractorError
from featuredb.features.extractor import extract
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from reloc.candidates import IndexedArea
from reloc.localise import localise_features
from reloc.matching import guided_matches
from reloc.pose import PoseHypothesis, refine_pose
from reloc.result import LocaliseRequest
from reloc.search import pairs
from reloc.tracking.options import TrackOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keyframe:
    """What the map says of a frame.

    Attributes:
        cam_from_local: pose in the area's frame. area: that it is of.
        camera: intrinsics; the given ones, or estimated along.
        pixels: (k, 2) of its inliers. rows: (k,) of the area's points that they see.
    """

    cam_from_local: Rigid3
    area: Area
    camera: Camera
    pixels: FloatArray
    rows: NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Unmatched:
    """Why the map says nothing of a frame: a code and a sentence."""

    reason: str
    detail: str


def usable_areas(areas: Sequence[IndexedArea], fingerprint: str) -> list[IndexedArea]:
    """Those whose descriptors can be compared with the film's.

    Raises:
        IncompatibleExtractorError: there are areas, and none of them is.
    """
    usable = [a for a in areas if a.area.extractor_fingerprint == fingerprint]
    if areas and not usable:
        raise IncompatibleExtractorError(
            f"the maps have descriptors of {areas[0].area.extractor_fingerprint}, a film's are {fingerprint}"
        )
    return usable


def match_keyframe(
    gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, area: Area, options: TrackOptions
) -> Keyframe | Unmatched:
    """Matches of a frame (h, w) whose pose is known to some pixels, and the pose that they give."""
    settings = options.localise
    features = extract(gray, settings.extractor)
    matches = guided_matches(
        features, area, np.arange(len(area.points), dtype=np.int32), camera, pose, settings.matching
    )
    if len(matches) < options.min_matches:
        return Unmatched(
            reason="TOO_FEW_MATCHES",
            detail=f"{len(matches)} map points where the track has them, {options.min_matches} needed",
        )
    pixels, points = pairs(features, area, matches)
    start = PoseHypothesis(
        cam_from_local=pose,
        camera=camera,
        camera_source="request",
        inliers=np.ones(len(pixels), dtype=np.bool_),
        prior_focal_px=camera.focal_px,
    )
    refined = refine_pose(pixels, points, start, settings.pose)
    if refined.count < options.min_matches:
        return Unmatched(
            reason="TOO_FEW_INLIERS",
            detail=f"{refined.count} map points agree, {options.min_matches} needed",
        )
    return Keyframe(
        cam_from_local=refined.cam_from_local,
        area=area,
        camera=camera,
        pixels=pixels[refined.inliers],
        rows=matches.point[refined.inliers],
    )


def find_frame(
    gray: NDArray[np.uint8], request: LocaliseRequest, areas: Sequence[IndexedArea], options: TrackOptions
) -> Keyframe | Unmatched:
    """A frame (h, w) whose pose is not known, localised as a query would be."""
    features = extract(gray, options.localise.extractor)
    outcome = localise_features(features, request, areas, options.localise)
    if outcome.best is None:
        return Unmatched(reason=str(outcome.result.reason), detail=outcome.result.detail)
    best = outcome.best
    pixels, _ = pairs(features, best.area, best.matches)
    return Keyframe(
        cam_from_local=best.pose.cam_from_local,
        area=best.area,
        camera=best.pose.camera,
        pixels=pixels[best.rows],
        rows=best.matches.point[best.rows],
    )
