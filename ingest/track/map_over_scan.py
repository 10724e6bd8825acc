"""Maps first, and the scan under them where they know nothing of a frame."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.track.scan_ground import ScanFinder, ScanGround
from reloc.localise.result import LocaliseRequest
from reloc.tracking.ground import Ground, Keyframe, Standing, StandingInMap, Unmatched
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.options import TrackOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapOverScan:
    """The maps of an area on a scan in its frame; landmarks of both are told apart by their numbers."""

    maps: Ground
    scan: ScanGround

    @property
    def frame(self) -> LocalFrame:
        """The area's."""
        return self.maps.frame

    def match(
        self, gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """By the maps, or where they know nothing, by the scan; both reasons where that knows nothing."""
        by_map = self.maps.match(gray, camera, pose, options)
        if isinstance(by_map, Keyframe):
            self.scan.seen_elsewhere(
                by_map.cam_from_local
            )  # where it is looked for on the scan, were it lost
            return replace(by_map, ground=self)
        by_scan = self.scan.match(gray, camera, pose, options)
        if isinstance(by_scan, Keyframe):
            return replace(by_scan, ground=self)
        return _both(by_map, by_scan)

    def standing(
        self, rows: NDArray[np.int64], center: FloatArray, measured: FloatArray
    ) -> Standing | StandingInMap:
        """On that of which more landmarks are."""
        of_map = rows >= 0
        if 2 * int(of_map.sum()) >= len(rows):
            return self.maps.standing(rows[of_map], center, measured)
        return self.scan.standing(rows[~of_map], center, measured)

    def visible(self, camera: Camera, pose: Rigid3) -> FloatArray:
        """Of both."""
        return np.concatenate([self.maps.visible(camera, pose), self.scan.visible(camera, pose)])


class MapOverScanFinder:
    """Finds frames on the maps, and else on the scan."""

    def __init__(self, maps: MapFinder, scan: ScanFinder) -> None:
        """
        Args:
            scan: in the frame of the maps' one area.

        Raises:
            InvalidValueError: the maps are of several areas, or in another frame than the scan.
        """
        frames = [ground.frame for ground in maps.grounds]
        if len(frames) != 1 or frames[0] != scan.ground.frame:
            raise InvalidValueError(
                f"expected the maps of one place, in the frame of the scan, found {len(frames)} places; name "
                "one map by --map"
            )
        self._maps, self._scan = maps, scan
        self._ground = MapOverScan(maps=maps.grounds[0], scan=scan.ground)

    def find(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """By the maps, or where they do not know the frame, by the scan."""
        by_map = self._maps.find(gray, request, options)
        if isinstance(by_map, Keyframe):
            self._scan.ground.seen_elsewhere(by_map.cam_from_local)
            return replace(by_map, ground=self._ground)
        by_scan = self._scan.find(gray, request, options)
        if isinstance(by_scan, Keyframe):
            return replace(by_scan, ground=self._ground)
        return _both(by_map, by_scan)

    def has(self, ground: Ground) -> bool:
        """Whether the track is on these."""
        return ground is self._ground


def _both(by_map: Unmatched, by_scan: Unmatched) -> Unmatched:
    return Unmatched(
        reason=by_map.reason,
        detail=f"{by_map.detail}; on the scan: {by_scan.reason}: {by_scan.detail}",
    )
