"""The scans that the maps lie on: their tiles as LAZ, and what is known of them."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.export.dataset import layout
from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.export.job import ExportJob, write_json
from featuredb.export.selection import licence_is
from featuredb.extras import require
from featuredb.geo.tiles import tiles_touching
from featuredb.geo.utm import geodetic_from_utm, utm_from_geodetic
from featuredb.store.scans import ScanSummary, list_scans

SCANS = f"{layout.LIDAR}/scans.json"


def check_lidar() -> None:
    """Refuse early where no tile could be written.

    Raises:
        MissingExtraError: laspy or its LAZ backend is not installed.
    """
    require("lidar", "A dataset with LiDAR tiles", "laspy", "lazrs")


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
    from featuredb.lidar.tile_files import write_tile

    written = []
    for scan in list_scans(job.database):
        if job.selection.licences is not None and not any(
            licence_is(scan.licence, wanted) for wanted in job.selection.licences
        ):
            continue
        tiles = []
        for tile in sorted(touched_tiles(scan, contents.maps)):
            name = f"{layout.LIDAR}/{layout.file_name(scan.scan_id)}/{tile}.laz"
            points = write_tile(job.database, scan, tile, folder / name)
            if points:
                tiles.append({"tile": tile, "file": name, "points": points})
        if tiles:
            written.append(_known(scan) | {"tiles": tiles})
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


def _known(scan: ScanSummary) -> dict[str, Any]:
    row = {name: value for name, value in scan.row.items() if name not in ("write_id", "tiles")}
    return row | {"created_at": scan.created_at.isoformat()}
