"""Feature maps under a track: a frame against them where its pose says points are, or, without, anywhere."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import extract
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area
from featuredb.maps.unplaced_map import OwnFrame
from reloc.localise.answer import on_earth
from reloc.localise.candidates import IndexedArea
from reloc.localise.localise import localise_features
from reloc.localise.matching import guided_matches, visible_points
from reloc.localise.pose import PoseHypothesis, refine_pose
from reloc.localise.result import LocaliseRequest, OwnPose, place_on_earth
from reloc.localise.search import pairs
from reloc.tracking.ground import EarthPose, Ground, Keyframe, Unmatched
from reloc.tracking.options import TrackOptions

_MOST_SHOWN = 1500  # more dots hide the picture
_MOST_LOOKED_AT = 20_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapGround:
    """The maps of an area, or a map without a place, whose `own` frame is the area's local frame."""

    area: Area
    own: OwnFrame | None = None

    @property
    def frame(self) -> LocalFrame:
        """The area's."""
        return self.area.frame

    def match(
        self, gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """Matches of a frame (h, w) whose pose is known to some pixels, and the pose that they give."""
        settings, area = options.localise, self.area
        features = extract(gray, options.keyframes)
        matches = guided_matches(
            features, area, area.searched_points().astype(np.int32), camera, pose, settings.matching
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
        )
        refined = refine_pose(pixels, points, start, settings.pose)
        if refined.count < options.min_matches:
            return Unmatched(
                reason="TOO_FEW_INLIERS",
                detail=f"{refined.count} map points agree, {options.min_matches} needed",
            )
        rows = matches.point[refined.inliers].astype(np.int64)
        return Keyframe(
            cam_from_local=refined.cam_from_local,
            ground=self,
            camera=camera,
            pixels=pixels[refined.inliers],
            points=area.points[rows],
            rows=rows,
        )

    def posed(self, rows: NDArray[np.int64], pose: Rigid3, measured: FloatArray) -> EarthPose | OwnPose:
        """By the map whose points most landmarks are."""
        area = self.area
        if self.own is not None:
            return OwnPose(map_id=area.maps[0].map_id, frame=self.own, cam_from_map=pose, covariance=measured)
        main = area.maps[int(np.argmax(np.bincount(area.map_of(rows), minlength=len(area.maps))))]
        return EarthPose(
            **place_on_earth(area.frame, pose, main.epsg),
            height_datum=main.height_datum,
            map_id=main.map_id,
            covariance=on_earth(area, main, pose.center, measured, rows),
        )

    def visible(self, camera: Camera, pose: Rigid3) -> FloatArray:
        """Of points that the pose says are in the picture, seen from a side that the map knows."""
        rows = self.area.searched_points()
        rows = visible_points(self.area, rows[:: max(1, len(rows) // _MOST_LOOKED_AT)], camera, pose)
        rows = rows[:: max(1, len(rows) // _MOST_SHOWN)]
        pixels = camera.project(pose.act(self.area.points[rows]))
        return pixels[np.isfinite(pixels).all(axis=1)]


class MapFinder:
    """Finds frames as queries are found, on maps of areas, or one without a place and its own frame."""

    def __init__(self, areas: Sequence[IndexedArea], own: OwnFrame | None = None) -> None:
        self._areas, self._own = tuple(areas), own
        assert own is None or len(self._areas) == 1

    @property
    def grounds(self) -> list[MapGround]:
        """A ground for each area."""
        return [MapGround(area=a.area, own=self._own) for a in self._areas]

    @property
    def own_map(self) -> str | None:
        """Id of the map without a place whose frame the poses are in."""
        return None if self._own is None else self._areas[0].area.maps[0].map_id

    def find(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """A frame (h, w) whose pose is not known, localised as a query would be."""
        features = extract(gray, options.localise.extractor)
        outcome = localise_features(features, request, self._areas, options.localise)
        if outcome.best is None:
            return Unmatched(reason=str(outcome.result.reason), detail=outcome.result.detail)
        best = outcome.best
        pixels, points = pairs(features, best.area, best.matches)
        return Keyframe(
            cam_from_local=best.pose.cam_from_local,
            ground=MapGround(area=best.area, own=self._own),
            camera=best.pose.camera,
            pixels=pixels[best.rows],
            points=points[best.rows],
            rows=best.matches.point[best.rows].astype(np.int64),
            camera_source=best.pose.camera_source,
        )

    def has(self, ground: Ground) -> bool:
        """Whether these very maps are among its own: one that was moved or taken back is another."""
        return isinstance(ground, MapGround) and any(a.area is ground.area for a in self._areas)
