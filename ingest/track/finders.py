"""What a film is followed by, from a database: its maps, its scans, or both."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.lidar.load import PlanBox, chosen_scans, load_cloud
from featuredb.store import Database
from featuredb.store.scans import ScanSummary
from ingest.register.anchor.start.priors import RoughPose, read_pose
from ingest.track.scan_ground import ScanFinder, ScanGround
from reloc.localise.candidates import usable_areas
from reloc.localise.result import LocaliseRequest, OwnPose
from reloc.localiser import Localiser
from reloc.tracking.ground import EarthPose, Finder, Ground, Keyframe, Unmatched
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.options import TrackOptions

FilmBy = Literal["map", "scan", "both"]
_REACH_M = 600.0  # around where the film begins: people fly in sight, and see further
_MAP_MARGIN_M = 300.0  # around the cameras of a map


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmGround:
    """What a person asks a film to be followed by.

    Attributes:
        by: what. maps, scans: ids; None: all there are.
        pose_file: coarse pose of the first frame (JSON), see `read_pose`.
    """

    by: FilmBy = "map"
    maps: tuple[str, ...] | None = None
    scans: tuple[str, ...] | None = None
    pose_file: Path | None = None

    def __post_init__(self) -> None:
        if self.by not in get_args(FilmBy):
            raise InvalidValueError(f"by: expected one of {', '.join(get_args(FilmBy))}, found {self.by!r}")


def finder_for(database: Database, asked: FilmGround, camera: Camera | None, options: TrackOptions) -> Finder:
    """What finds the film's frames.

    Args:
        camera: intrinsics of the film's frames, if they are known.

    Raises:
        InvalidValueError: what was asked for contradicts itself, or lacks a pose or a camera.
        RegistrationError: the file of the pose is none.
        ScanNotFoundError, MapNotFoundError, ScanError, StoreError
        IncompatibleExtractorError: all maps are of another extractor.
    """
    if asked.by == "map":
        if asked.scans or asked.pose_file:
            raise InvalidValueError("--scan and --pose are for --by scan and --by both; add one of these")
        return _maps(database, asked, options)
    rough = None if asked.pose_file is None else read_pose(asked.pose_file, "the first frame")
    if asked.by == "scan":
        if asked.maps:
            raise InvalidValueError("--by scan follows a scan alone and no map; leave out --map or --by scan")
        if rough is None or camera is None:
            raise InvalidValueError(
                "a scan alone tells neither the lens nor where to look: give --camera and --pose, or let a "
                "map find the film by --by both"
            )
        return _on_scan(database, asked, rough)
    maps = _maps(database, asked, options)
    if maps.own_map is not None:
        raise InvalidValueError(
            f"--by both follows maps on a scan, and map {maps.own_map} has no place on any; leave out --by, "
            "or place the map first: `featuredb maps` says how"
        )
    if len(maps.grounds) != 1:
        raise InvalidValueError(
            f"--by both follows the maps of one place, found {len(maps.grounds)}; name one by --map"
        )
    area, scans = maps.grounds[0].area, chosen_scans(database, asked.scans)
    centers = area.image_center[area.searched_images()]
    low, high = np.min(centers, axis=0) - _MAP_MARGIN_M, np.max(centers, axis=0) + _MAP_MARGIN_M
    box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return MapOverScanFinder(maps, _finder(database, scans, area.frame, box, rough))


def _maps(database: Database, asked: FilmGround, options: TrackOptions) -> MapFinder:
    localiser = Localiser.open(database)
    fingerprint = options.localise.extractor.fingerprint
    own = localiser.own_area_of(asked.maps)
    if own is not None:
        unplaced, area = own
        return MapFinder(usable_areas([area], fingerprint), unplaced.frame)
    return MapFinder(usable_areas(localiser.areas_of(asked.maps), fingerprint))


def _on_scan(database: Database, asked: FilmGround, rough: RoughPose) -> ScanFinder:
    scans = chosen_scans(database, asked.scans)
    epsg = scans[0].epsg
    east, north, _ = rough.utm.tolist()
    frame = LocalFrame.from_utm(east, north, min(s.box.min_height for s in scans), epsg)
    return _finder(database, scans, frame, (-_REACH_M, -_REACH_M, _REACH_M, _REACH_M), rough)


def _finder(
    database: Database, scans: list[ScanSummary], frame: LocalFrame, box: PlanBox, rough: RoughPose | None
) -> ScanFinder:
    ids = [s.scan_id for s in scans]
    cloud = load_cloud(database, frame, box, scan_ids=ids)
    if not len(cloud):
        raise InvalidValueError(
            f"scan {', '.join(ids)} has no points around where the film is looked for; is the pose's zone "
            f"that of the scan, EPSG:{scans[0].epsg}? `featuredb lidar list` tells where scans lie"
        )
    first = None if rough is None else rough.prior(frame, scans[0].epsg)
    return ScanFinder(cloud, ids[0], scans[0].epsg, first)


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
        return self.first_of(by_map, lambda: self.scan.match(gray, camera, pose, options))

    def first_of(
        self, by_map: Keyframe | Unmatched, ask_scan: Callable[[], Keyframe | Unmatched]
    ) -> Keyframe | Unmatched:
        """What the maps found, else what the scan finds, on this ground; else both reasons."""
        if isinstance(by_map, Keyframe):
            self.scan.seen_elsewhere(by_map.cam_from_local)  # where the scan looks for it, were it lost
            return replace(by_map, ground=self)
        by_scan = ask_scan()
        if isinstance(by_scan, Keyframe):
            return replace(by_scan, ground=self)
        detail = f"{by_map.detail}; on the scan: {by_scan.reason}: {by_scan.detail}"
        return Unmatched(reason=by_map.reason, detail=detail)

    def posed(self, rows: NDArray[np.int64], pose: Rigid3, measured: FloatArray) -> EarthPose | OwnPose:
        """By that of which more landmarks are."""
        of_map = rows >= 0
        if 2 * int(of_map.sum()) >= len(rows):
            return self.maps.posed(rows[of_map], pose, measured)
        return self.scan.posed(rows[~of_map], pose, measured)

    def visible(self, camera: Camera, pose: Rigid3) -> FloatArray:
        """Of both."""
        return np.concatenate([self.maps.visible(camera, pose), self.scan.visible(camera, pose)])


class MapOverScanFinder:
    """Finds frames on the maps, and else on the scan."""

    def __init__(self, maps: MapFinder, scan: ScanFinder) -> None:
        """
        Args:
            maps: of one area. scan: in its frame.
        """
        self._maps, self._scan = maps, scan
        self._ground = MapOverScan(maps=maps.grounds[0], scan=scan.ground)

    def find(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """By the maps, or where they do not know the frame, by the scan."""
        by_map = self._maps.find(gray, request, options)
        return self._ground.first_of(by_map, lambda: self._scan.find(gray, request, options))

    def has(self, ground: Ground) -> bool:
        """Whether the track is on these."""
        return ground is self._ground
