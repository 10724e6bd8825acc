"""A snapshot as the page's values: places with maps, photos, scans and tracks, and the points to draw.

`build_scene` reads everything once; after it the database is needed for queries only. What is in
`ViewerScene.document` goes into JSON as it is; coordinates are metres east, north, up in the frame of their
place: such a frame is level at its origin only, so maps that are far from each other get one each.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from featuredb.errors import InvalidValueError
from featuredb.export.selection import Selection, licence_is, licensed, selected_any
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import MAP_STATUSES, MapImage
from featuredb.store import Database, MapSummary, Snapshot, UnplacedSummary, UtmBox
from featuredb.store.scans import ScanSummary, count_points, list_scans
from reloc.tracking.trajectory.values import Trajectory
from reloc.viewer.map_layer import (
    coverage,
    describe_map,
    describe_own_place,
    describe_photos,
    describe_trajectory,
    picks_command,
)
from reloc.viewer.points import DrawnPoints, drawn_points, map_points, sampled, scan_points_in, shares

DEFAULT_POINTS = 1_000_000
# Over this distance the vertical turns by 0.18 degrees and the ground falls away by 31 m.
_TOGETHER_M = 20_000.0
# Of a scan that is larger than the maps, this much is shown around them.
SCAN_MARGIN_M = 50.0

Spot = tuple[FloatArray, int]  # where something lies: (3,) easting, northing, height in metres; the zone


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewerSceneOptions:
    """What is shown."""

    # Of maps; of their photos where it names licences.
    selection: Selection = field(default_factory=lambda: Selection(statuses=(*MAP_STATUSES, "unplaced")))
    points: int = DEFAULT_POINTS  # at most so many in each place, of maps and scans together
    photos: Path | None = None  # their folder, for the command that places a map without a place
    told: Callable[[int, int], None] = lambda done, total: None  # with maps read, and their total

    def __post_init__(self) -> None:
        if self.points < 0:
            raise InvalidValueError(f"--points: expected a number from 0 on, found {self.points}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewerScene:
    """Everything that the page shows."""

    document: dict[str, Any]  # ready for JSON; maps and scans name their part of the points by `buffer`
    points: tuple[bytes, ...]  # of each place, the buffers of its maps and scans one after the other
    images: Mapping[tuple[str, int], MapImage]  # by map id and image id
    frames: tuple[LocalFrame, ...]  # of each place on Earth; places of maps without one come after them
    place_of_map: Mapping[str, int]  # row of the place, by map id


def build_scene(
    database: Database,
    snapshot: Snapshot,
    trajectories: Sequence[Trajectory] = (),
    options: ViewerSceneOptions | None = None,
) -> ViewerScene:
    """Read what is shown of a snapshot, and the scans of the newest version.

    Raises:
        ExportError: nothing is selected of a database that has maps. InvalidValueError: a track without a
            single pose. StoreError, MapNotFoundError: as `Snapshot`.
    """
    return _Builder(database, snapshot, trajectories, options or ViewerSceneOptions()).build()


class _Builder:
    """What the steps of `build_scene` share."""

    def __init__(
        self,
        database: Database,
        snapshot: Snapshot,
        trajectories: Sequence[Trajectory],
        options: ViewerSceneOptions,
    ) -> None:
        self._database, self._snapshot = database, snapshot
        self._trajectories, self._options = trajectories, options
        known = snapshot.rows()
        chosen = selected_any(database, snapshot, options.selection) if known else []
        self._maps = [m for m in chosen if isinstance(m, MapSummary)]
        self._unplaced = [m for m in chosen if isinstance(m, UnplacedSummary)]
        self._shown = {m.map_id for m in self._maps}
        self._lineages = snapshot.lineages()
        self._images: dict[tuple[str, int], MapImage] = {}
        self._place_of_map: dict[str, int] = {}
        self._read = 0

    def build(self) -> ViewerScene:
        maps, scans, tracks = self._maps, self._scans(), self._trajectories
        spots = [self._spot(m) for m in maps] + [spot_of(s.box, s.epsg) for s in scans]
        spots += [spot_of_trajectory(t) for t in tracks]
        places: list[dict[str, Any]] = []
        points: list[bytes] = []
        frames: list[LocalFrame] = []
        for frame, rows in group(spots):
            here = [maps[r] for r in rows if r < len(maps)]
            beside = [scans[r - len(maps)] for r in rows if 0 <= r - len(maps) < len(scans)]
            played = [tracks[r - len(maps) - len(scans)] for r in rows if r >= len(maps) + len(scans)]
            if not here and not played and self._is_part:
                continue
            place, data = self._place(len(places), frame, here, beside)
            # Of what there is first: the zone in which spots of this place are told.
            place["epsg"] = spots[rows[0]][1]
            place["trajectories"] = [describe_trajectory(t, frame) for t in played]
            places.append(place)
            points.append(data)
            frames.append(frame)
        for summary in self._unplaced:
            self._add_own_place(summary, places, points)
        document = {
            "database": self._database.name,
            "snapshot": self._snapshot.version,
            "time": self._snapshot.timestamp.isoformat(timespec="seconds"),
            "points_limit": self._options.points,
            "places": places,
        }
        return ViewerScene(
            document=document,
            points=tuple(points),
            images=self._images,
            frames=tuple(frames),
            place_of_map=self._place_of_map,
        )

    def _add_own_place(
        self, summary: UnplacedSummary, places: list[dict[str, Any]], points: list[bytes]
    ) -> None:
        """A map without a place, unless no photo of it has one of the licences."""
        unplaced = licensed(self._snapshot.load_unplaced(summary.map_id), self._options.selection.licences)
        self._tell()
        if unplaced is None:
            return
        points_of, count = unplaced.points, len(unplaced.points)
        rows = sampled(count, self._options.points)
        drawn = drawn_points(points_of.xyz[rows], points_of.rgb[rows], count)
        (buffer,), data = _packed([drawn])
        command = picks_command(self._database.url, summary.map_id, self._options.photos)
        places.append(describe_own_place(summary, unplaced, drawn, buffer, command))
        points.append(data)
        self._images |= {(summary.map_id, image.image_id): image for image in unplaced.images}

    def _tell(self) -> None:
        self._read += 1
        self._options.told(self._read, len(self._maps) + len(self._unplaced))

    @property
    def _is_part(self) -> bool:
        """Whether a part of the database was asked for; scans elsewhere do not belong to it."""
        asked = self._options.selection
        return bool(asked.maps or asked.bbox or asked.where)

    def _scans(self) -> list[ScanSummary]:
        licences = self._options.selection.licences
        return [
            scan
            for scan in list_scans(self._database)
            if licences is None or any(licence_is(scan.licence, wanted) for wanted in licences)
        ]

    def _spot(self, summary: MapSummary) -> Spot:
        if summary.box is not None:
            return spot_of(summary.box, summary.epsg)
        frame = self._snapshot.load_map(summary.map_id).frame  # it has no points
        return frame.utm_from_enu(np.zeros(3), summary.epsg), summary.epsg

    def _place(
        self, number: int, frame: LocalFrame, maps: list[MapSummary], scans: list[ScanSummary]
    ) -> tuple[dict[str, Any], bytes]:
        limit = self._options.points
        wanted = shares([m.points for m in maps], limit)
        read = [self._map(number, frame, m, int(n)) for m, n in zip(maps, wanted, strict=True)]
        shown = [entry for entry in read if entry is not None]
        map_boxes = [drawn.box() for _, drawn in shown if len(drawn)]
        boxes = [scan_box(frame, map_boxes, scan.epsg) for scan in scans]
        of_scans = [
            sum(count_points(self._database, s, level, box) for level in range(len(s.level_points)))
            for s, box in zip(scans, boxes, strict=True)
        ]
        for_maps, for_scans = _budget(sum(len(drawn) for _, drawn in shown), sum(of_scans), limit)
        counts = shares([len(drawn) for _, drawn in shown], for_maps)
        drawn = [one.first(int(count)) for (_, one), count in zip(shown, counts, strict=True)]
        drawn += [
            scan_points_in(self._database, scan, frame, box, int(count))
            for scan, box, count in zip(scans, boxes, shares(of_scans, for_scans), strict=True)
        ]
        buffers, data = _packed(drawn)
        of_scan = slice(len(shown), None)
        place = {
            "name": f"{frame.latitude_deg:.4f}, {frame.longitude_deg:.4f}",
            "frame": asdict(frame),
            "height_datums": sorted({m.height_datum for m in maps} | {s.height_datum for s in scans}),
            "maps": [{**told, "buffer": b} for (told, _), b in zip(shown, buffers, strict=False)],
            "scans": [
                _describe_scan(scan, one, buffer)
                for scan, one, buffer in zip(scans, drawn[of_scan], buffers[of_scan], strict=True)
            ],
        }
        return place, data

    def _map(
        self, number: int, frame: LocalFrame, summary: MapSummary, wanted: int
    ) -> tuple[dict[str, Any], DrawnPoints] | None:
        """A map and at most `wanted` of its points; None where no photo has one of the licences."""
        feature_map = licensed(self._snapshot.load_map(summary.map_id), self._options.selection.licences)
        self._tell()
        if feature_map is None:
            return None
        drawn = map_points(feature_map.points, feature_map.epsg, frame, wanted)
        self._place_of_map[summary.map_id] = number
        for image in feature_map.images:
            self._images[summary.map_id, image.image_id] = image
        # In the tree it stands under the next map on its chain to an anchor.
        lineage = self._lineages[summary.map_id]
        under = next((m for m in lineage.chain[1:2] if m in self._shown), None)
        told = {
            **describe_map(summary, lineage, under),
            "points": len(feature_map.points),
            "photos": describe_photos(feature_map, frame),
            "coverage": coverage(drawn),
        }
        return told, drawn


def _packed(parts: Sequence[DrawnPoints]) -> tuple[list[dict[str, Any]], bytes]:
    """Points of one place, one part after the other, and for each where it is and how to read it."""
    buffers, data = [], bytearray()
    for drawn in parts:
        buffers.append(
            {
                "origin": drawn.origin.tolist(),
                "count": len(drawn),
                "offset": len(data),
                "box": np.round(drawn.box(), 3).tolist(),
            }
        )
        data += drawn.packed()
    return buffers, bytes(data)


def _budget(of_maps: int, of_scans: int, limit: int) -> tuple[int, int]:
    """How many points maps and scans may draw: all, or half each, and what the one leaves the other takes."""
    for_maps = min(of_maps, max(limit - limit // 2, limit - of_scans))
    return for_maps, min(of_scans, limit - for_maps)


def _describe_scan(scan: ScanSummary, drawn: DrawnPoints, buffer: dict[str, Any]) -> dict[str, Any]:
    same = ("name", "points", "spacing_m", "epsg", "height_datum", "licence")
    return {
        "id": scan.scan_id,
        "points_here": drawn.of,
        "colour": scan.colour or ("intensity" if scan.has_intensity else "none"),
        "buffer": buffer,
        **{name: getattr(scan, name) for name in same},
    }


def spot_of_trajectory(trajectory: Trajectory) -> Spot:
    """Where the first known pose lies. Raises InvalidValueError: all frames are lost."""
    pose = next((point.pose for point in trajectory.points if point.pose is not None), None)
    if pose is None:
        raise InvalidValueError(
            f"{trajectory.source}: all {len(trajectory.points)} frames are lost, there is nothing to show"
        )
    return pose.utm, pose.epsg


def spot_of(box: UtmBox, epsg: int) -> Spot:
    """The middle of a box in plan, at its foot."""
    easting, northing = (box.min_easting + box.max_easting) / 2.0, (box.min_northing + box.max_northing) / 2.0
    return np.array([easting, northing, box.min_height]), epsg


def group(spots: Sequence[Spot]) -> list[tuple[LocalFrame, list[int]]]:
    """Places, the one with most spots first: frame at the middle of the spots, and their rows.

    Spots within 20 km of each other, directly or through others, are one place.
    """
    if not spots:
        return []
    (easting, northing, height), epsg = spots[0]
    frame = LocalFrame.from_utm(float(easting), float(northing), float(height), epsg)
    enu = np.array([frame.enu_from_utm(utm, epsg) for utm, epsg in spots])
    near = cKDTree(enu).query_pairs(_TOGETHER_M, output_type="ndarray")
    links = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(spots), len(spots)))
    count, label = connected_components(links, directed=False)
    places = [np.flatnonzero(label == k) for k in range(count)]
    places.sort(key=lambda rows: (-len(rows), int(rows[0])))
    return [(_frame_at(frame, enu[rows].mean(axis=0)), rows.tolist()) for rows in places]


def scan_box(
    frame: LocalFrame, boxes: Sequence[FloatArray], epsg: int
) -> tuple[float, float, float, float] | None:
    """(e0, n0, e1, n1) in a scan's zone of what is shown: 50 m around the maps' boxes (2, 3) in `frame`."""
    if not boxes:
        return None  # all of it is shown
    (e0, n0, up), (e1, n1, _) = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    around = [
        (e, n, up)
        for e in (e0 - SCAN_MARGIN_M, e1 + SCAN_MARGIN_M)
        for n in (n0 - SCAN_MARGIN_M, n1 + SCAN_MARGIN_M)
    ]
    utm = frame.utm_from_enu(np.array(around), epsg)
    low, high = utm.min(axis=0), utm.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _frame_at(frame: LocalFrame, enu: FloatArray) -> LocalFrame:
    latitude, longitude, height = frame.geodetic_from_enu(enu)
    return LocalFrame(
        latitude_deg=float(latitude), longitude_deg=float(longitude), height_m=round(float(height), 3)
    )
