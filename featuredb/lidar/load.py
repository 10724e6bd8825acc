"""Scans of a database, or parts of them, as a point cloud in a local frame."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from featuredb.errors import ScanError, ScanNotFoundError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geo.utm import utm_from_geodetic
from featuredb.render.cloud import CloudNodes, PointCloud, point_spacing
from featuredb.store import Database
from featuredb.store.scans import ScanSummary, count_points, list_scans, scan_points
from featuredb.store.snapshot import full_id
from featuredb.store.tables import LIDAR_POINTS, SPECS, UTM_COORDINATES

_RGB = ("red", "green", "blue")

_GREY = 128  # of points that have neither colour nor intensity in a cloud that has

PlanBox = tuple[float, float, float, float]

# About 30 bytes each in memory, and what two cores draw ten times a second.
_LARGEST_POINTS = 20_000_000


class _Part(NamedTuple):
    """One level of one scan."""

    scan: ScanSummary
    level: int
    table: pa.Table


def scan_frame(scan: ScanSummary) -> LocalFrame:
    """A local frame at the centre of a scan, at its lowest height."""
    box = scan.box
    return LocalFrame.from_utm(
        (box.min_easting + box.max_easting) / 2.0,
        (box.min_northing + box.max_northing) / 2.0,
        box.min_height,
        scan.epsg,
    )


def load_cloud(
    database: Database,
    frame: LocalFrame,
    box_local: PlanBox | None = None,
    *,
    scan_ids: Sequence[str] | None = None,
    largest_points: int = _LARGEST_POINTS,
) -> PointCloud:
    """The points of all scans, or of some, around a place.

    Colours or intensities are in the cloud if all of the loaded scans have them.

    Args:
        frame: local frame of the result; anywhere near the scans.
        box_local: (east0, north0, east1, north1) metres in `frame`; what lies in the box is loaded, and a
            little around it where the frame is turned against the UTM grid. None for everything.
        scan_ids: the scans to load, as `chosen_scans`; None for all that are not retired.
        largest_points: finer levels are left out from the one on that would exceed this many points.

    Returns:
        The cloud, with levels as they are stored: level l has a point every 4 m / 2^l. Without any point
            where no scan reaches into the box.

    Raises:
        ScanNotFoundError: the database has no scan, or not one of those.
        ScanError: the scans' heights are of different datums, or even the coarsest level has too many points.
        StoreError: the points cannot be read.
    """
    scans = chosen_scans(database, scan_ids)
    datums = sorted({scan.height_datum for scan in scans})
    if len(datums) > 1:
        raise ScanError(
            f"expected scans with heights of one datum, found {', '.join(datums)}; choose among the scans"
        )
    boxes = {scan.scan_id: _utm_box(frame, box_local, scan.epsg) for scan in scans}
    touched = [s for s in scans if (b := boxes[s.scan_id]) is None or s.box.touches(*b)]
    rgb = bool(touched) and all(scan.colour for scan in touched)
    intensity = bool(touched) and all(scan.has_intensity for scan in touched)
    columns = [*UTM_COORDINATES, *(_RGB if rgb else ()), *(("intensity",) if intensity else ())]
    columns += ["classification", "node", "node_spacing_m"]
    parts: list[_Part] = []
    total = 0
    for level in range(max((len(scan.level_points) for scan in touched), default=0)):
        total += sum(count_points(database, scan, level, boxes[scan.scan_id]) for scan in touched)
        if total > largest_points:
            if level == 0:
                raise ScanError(
                    f"expected at most {largest_points} points, found {total} in the coarsest level "
                    "alone; ask for a smaller area"
                )
            break
        for scan in touched:
            table = scan_points(database, scan, level, boxes[scan.scan_id], columns)
            if len(table):
                parts.append(_Part(scan, level, table))
    return _cloud(frame, scans[0].height_datum, parts, columns)


def chosen_scans(database: Database, scan_ids: Sequence[str] | None) -> list[ScanSummary]:
    """The scans meant, oldest first, by ids or their first letters; None: all that are not retired.

    Raises:
        ScanNotFoundError: the database has no scan, or not one of those, or several ids begin so.
    """
    scans = list_scans(database)
    if scan_ids is not None:
        ids, meant = [scan.scan_id for scan in scans], set()
        for start in scan_ids:
            said = f"no scan {start}" if start else "expected a scan's id or its first letters, found nothing"
            none = f"{said}; `featuredb lidar list` lists what there is"
            meant.add(full_id(start, ids, "scans", ScanNotFoundError, none))
        scans = [s for s in scans if s.scan_id in meant]
    if not scans:
        raise ScanNotFoundError(f"{database.url} has no scans; add one by `featuredb lidar add`")
    return scans


def _utm_box(frame: LocalFrame, box: PlanBox | None, epsg: int) -> PlanBox | None:
    """The upright box in a zone around a box of the local frame."""
    if box is None:
        return None
    e0, n0, e1, n1 = box
    steps = np.linspace(0.0, 1.0, 5)
    edge = [(e0 + t * (e1 - e0), n) for t in steps for n in (n0, n1)]
    edge += [(e, n0 + t * (n1 - n0)) for t in steps for e in (e0, e1)]
    geodetic = frame.geodetic_from_enu(np.array([(e, n, 0.0) for e, n in edge]))
    utm = utm_from_geodetic(geodetic, epsg)
    low, high = utm[:, :2].min(axis=0), utm[:, :2].max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _cloud(frame: LocalFrame, datum: str, parts: Sequence[_Part], columns: Sequence[str]) -> PointCloud:
    """The parts one after the other, in the frame, with their nodes."""
    none = SPECS[LIDAR_POINTS].schema.empty_table().select(columns)
    table = pa.concat_tables([none, *(part.table for part in parts)], promote_options="permissive")
    xyz = np.empty((len(table), 3), np.float32)
    row = 0
    for part in parts:
        utm = np.stack([part.table[name].to_numpy() for name in UTM_COORDINATES], axis=1)
        xyz[row : row + len(utm)] = frame.enu_from_utm(utm, part.scan.epsg)
        row += len(utm)
    return PointCloud(
        frame=frame,
        height_datum=datum,
        xyz=xyz,
        rgb=np.stack([_bytes(table, name) for name in _RGB], axis=1) if "red" in columns else None,
        intensity=_bytes(table, "intensity") if "intensity" in columns else None,
        classification=_bytes(table, "classification"),
        nodes=_nodes(xyz, table, parts),
        spacing_m=point_spacing(xyz),
    )


def _bytes(table: pa.Table, name: str) -> NDArray[np.uint8]:
    """A column (n,) as uint8; where a point has no value, its intensity or a grey."""
    column: Any = table[name]
    if column.null_count:
        grey = [table["intensity"]] if "intensity" in table.column_names else []
        column = pc.coalesce(column, *grey, pa.scalar(_GREY, pa.int16()))
    return np.asarray(column.to_numpy(), dtype=np.uint8)


def _nodes(xyz: NDArray[np.float32], table: pa.Table, parts: Sequence[_Part]) -> CloudNodes:
    """Runs of equal node keys, and the boxes around their points."""
    node, spacing = (table[name].to_numpy() for name in ("node", "node_spacing_m"))
    part = np.repeat(np.arange(len(parts)), np.array([len(p.table) for p in parts], np.int64))
    new = np.ones(len(node), np.bool_)
    new[1:] = (node[1:] != node[:-1]) | (spacing[1:] != spacing[:-1]) | (part[1:] != part[:-1])
    start = np.flatnonzero(new)
    return CloudNodes(
        start=start,
        count=np.diff(start, append=len(xyz)),
        level=np.array([p.level for p in parts], np.int16)[part[start]],
        spacing_m=spacing[start],
        box_min=np.minimum.reduceat(xyz, start, axis=0) if len(start) else np.empty((0, 3), np.float32),
        box_max=np.maximum.reduceat(xyz, start, axis=0) if len(start) else np.empty((0, 3), np.float32),
    )
