"""The scans that the maps lie on: their tiles as LAZ, and what is known of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.export.dataset import layout
from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.export.job import ExportJob, write_json
from featuredb.export.selection import licence_is
from featuredb.geo.crs.wkt import utm_wkt
from featuredb.geo.tiles import tile_bounds, tiles_touching
from featuredb.geo.utm import geodetic_from_utm, utm_from_geodetic
from featuredb.lidar.formats.las_stream import LasStream
from featuredb.store.database import Database
from featuredb.store.scans import ScanSummary, count_points, list_scans, scan_points
from featuredb.store.tables import UTM_COORDINATES

SCANS = f"{layout.LIDAR}/scans.json"

_RGB = ("red", "green", "blue")
# Read at once; some 60 bytes each.
_LARGEST_PIECE = 2_000_000
_STEP_M = 0.001  # what surveyors read off
_SMALLEST_SIDE_M = 1.0  # a square metre is not cut further, however many points it has

Box = tuple[float, float, float, float]


def write_tile(database: Database, scan: ScanSummary, tile: str, path: Path) -> int:
    """Write a tile's points and return their number; no file where it has none.

    Coordinates are rounded to a millimetre. Colours and intensities are 16 bits wide, as LAS has them; a
    point without colour in a scan with colours is black. The order is that of levels, coarsest first, then
    of nodes and coordinates: compaction of the store does not show in the file.

    Raises:
        StoreError: the points cannot be read.
        MissingExtraError: laspy is not installed.
        OSError: the file cannot be written.
    """
    wkt = utm_wkt(scan.epsg, scan.height_datum)
    e0, n0, e1, n1 = tile_bounds(tile)
    offset = np.array([e0, n0, np.floor(scan.box.min_height)])
    written = 0
    day, colours = scan.created_at.date(), bool(scan.colour)
    with LasStream(path, wkt, offset=offset, step_m=_STEP_M, day=day, rgb=colours) as stream:
        for level in range(len(scan.level_points)):
            for piece in _pieces(database, scan, level, (e0, n0, e1, n1)):
                utm, columns, rgb = _points(database, scan, level, piece)
                if len(utm):
                    stream.write(utm, columns, rgb)
                    written += len(utm)
    return written


def _pieces(database: Database, scan: ScanSummary, level: int, box: Box) -> list[Box]:
    """The box, or quarters of it until each has few enough points; those without any are left out."""
    count = count_points(database, scan, level, box)
    e0, n0, e1, n1 = box
    if count == 0:
        return []
    if count <= _LARGEST_PIECE or e1 - e0 <= _SMALLEST_SIDE_M:
        return [box]
    e, n = (e0 + e1) / 2.0, (n0 + n1) / 2.0
    quarters = [(e0, n0, e, n), (e, n0, e1, n), (e0, n, e, n1), (e, n, e1, n1)]
    return [piece for quarter in quarters for piece in _pieces(database, scan, level, quarter)]


def _points(
    database: Database, scan: ScanSummary, level: int, box: Box
) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]], NDArray[np.uint8] | None]:
    """Coordinates (n, 3), columns by laspy's names and colours (n, 3) of the half-open box."""
    names = (*UTM_COORDINATES, *_RGB, "intensity", "classification", "node")
    table = scan_points(database, scan, level, box, names)
    utm = np.stack([table[name].to_numpy() for name in UTM_COORDINATES], axis=1)
    e0, n0, e1, n1 = box
    inside = (utm[:, 0] >= e0) & (utm[:, 0] < e1) & (utm[:, 1] >= n0) & (utm[:, 1] < n1)
    table, utm = table.filter(inside), utm[inside]
    values = {name: table[name].fill_null(0).to_numpy() for name in (*_RGB, "intensity", "classification")}
    keys = (*values.values(), utm[:, 2], utm[:, 1], utm[:, 0], table["node"].to_numpy())
    order = np.lexsort(keys)
    columns = {"classification": values["classification"][order].astype(np.uint8)}
    if scan.has_intensity:
        columns["intensity"] = values["intensity"][order].astype(np.uint16) * 257
    rgb = np.stack([values[name][order] for name in _RGB], axis=1).astype(np.uint8)
    return utm[order], columns, rgb if scan.colour else None


def write_scans(job: ExportJob, contents: Contents, folder: Path) -> list[dict[str, Any]]:
    """Write `lidar/SCAN/TILE.laz` of every tile that the box of a map's points touches, and
    `lidar/scans.json`.

    Scans of the newest version of the database, since they have versions of their own. Where photos are
    chosen by licence, scans are too.

    Returns:
        The scans, by the columns of the store's table `lidar`, with the tiles that were written.

    Raises:
        StoreError: a scan cannot be read.
    """
    written, licences = [], job.selection.licences
    for scan in list_scans(job.database):
        if licences is not None and not any(licence_is(scan.licence, wanted) for wanted in licences):
            continue
        tiles = []
        for tile in sorted(touched_tiles(scan, contents.maps)):
            name = f"{layout.LIDAR}/{layout.file_name(scan.scan_id)}/{tile}.laz"
            points = write_tile(job.database, scan, tile, folder / name)
            if points:
                tiles.append({"tile": tile, "file": name, "points": points})
        if tiles:
            known = {name: value for name, value in scan.row.items() if name not in ("write_id", "tiles")}
            written.append(known | {"created_at": scan.created_at.isoformat(), "tiles": tiles})
    if written:
        write_json(folder / SCANS, {"scans": written})
    return written


def touched_tiles(scan: ScanSummary, maps: Iterable[MapEntry]) -> set[str]:
    """Names of the scan's tiles that a map touches."""
    own = set(scan.row["tiles"])
    found: set[str] = set()
    for entry in maps:
        box = entry.plan_box
        if box and entry.partition.epsg != scan.epsg:
            box = _in_zone(box, entry.partition.epsg, scan)
        if box and scan.box.touches(*box):
            found |= own & set(tiles_touching(*box))
    return found


def _in_zone(box: list[float], epsg: int, scan: ScanSummary) -> list[float]:
    """The upright box around a map's box in the scan's zone; none where the two are far apart."""
    e0, n0, e1, n1 = box
    corners = geodetic_from_utm([(e, n, 0.0) for e in (e0, e1) for n in (n0, n1)], epsg)
    middle = geodetic_from_utm([scan.box.min_easting, scan.box.min_northing, 0.0], scan.epsg)
    apart = np.abs((corners[:, 1] - middle[1] + 180.0) % 360.0 - 180.0)
    if apart.max() > 3.0 or np.abs(corners[:, 0] - middle[0]).max() > 3.0:
        return []
    plan = utm_from_geodetic(corners, scan.epsg)[:, :2]
    return [*plan.min(axis=0).tolist(), *plan.max(axis=0).tolist()]
