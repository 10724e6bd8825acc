"""A selection of maps as one self-describing folder, made to be published.

Coordinates are in GeoParquet 1.1, whose columns have one reference system each. So the rows of points and
images are parted by UTM zone and height datum, and a file says so in its name:
`points/32632-egm2008-0000.parquet`; its CRS is that of `utm_projjson`. Nothing is transformed: easting,
northing and height are the stored float64. `maps.parquet`, with an area for each map, is in longitude and
latitude.

The same maps, selection and libraries give the same bytes: times are those of the snapshot and the photos,
and names follow from ids.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from featuredb.errors import ExportError
from featuredb.export.dataset import layout
from featuredb.export.dataset.columns import CAMERAS, MAPS
from featuredb.export.dataset.contents import Contents, MapEntry, entry_of
from featuredb.export.dataset.datasheet import write_datasheet
from featuredb.export.dataset.geoparquet import GeoFile, TableFile, wkb_of
from featuredb.export.dataset.layout import write_sums
from featuredb.export.dataset.lidar_part import write_scans
from featuredb.export.dataset.partitions import OwnFrameFiles, PartitionFiles
from featuredb.export.job import (
    ATTRIBUTION,
    Attribution,
    Exported,
    ExportJob,
    attribution_of,
    whole_or_nothing,
    write_attribution,
    write_json,
)
from featuredb.extras import require
from featuredb.geo.crs.wkt import utm_projjson
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store.encode import encode_map

# Of maps.parquet, in a row group.
_ROWS_AT_ONCE = 256

STAC_VERSION = "1.0.0"
PROJECTION = "https://stac-extensions.github.io/projection/v1.1.0/schema.json"
COLLECTION = f"{layout.STAC}/collection.json"
_PARQUET = "application/vnd.apache.parquet"
_LAZ = "application/vnd.laszip"
_PARTS = {
    "points": "points, GeoParquet; the map's rows have its map_id",
    "images": "images with their poses, GeoParquet; the map's rows have its map_id",
    "observations": "keypoints and descriptors, Parquet; the map's rows have its map_id",
}


def write_catalogue(contents: Contents, description: Mapping[str, Any], folder: Path) -> None:
    """Write `stac/collection.json` and `stac/items/*.json`.

    Links and files are said relative to the document, so that the folder may lie anywhere; none to itself.
    """
    time = datetime.fromisoformat(description["snapshot_time"])
    assets = {
        name: _asset(f"../{name}", title, kind, "metadata")
        for name, title, kind in (
            (layout.MAPS, "the maps", _PARQUET),
            (layout.CAMERAS, "the cameras", _PARQUET),
            (ATTRIBUTION, "owner and licence of every photo", "text/csv"),
            (layout.DATASHEET, "datasheet", "text/markdown"),
        )
    }
    for tile in (tile for scan in contents.scans for tile in scan["tiles"]):
        assets[tile["file"]] = _asset(f"../{tile['file']}", "LiDAR tile", _LAZ, "data")
    items = {f"items/{layout.file_name(entry.row['map_id'])}.json": entry for entry in contents.maps}
    collection = {
        "type": "Collection",
        "stac_version": STAC_VERSION,
        "id": description["name"],
        "title": description["name"],
        "description": (
            f"{description['maps']} geo-registered feature maps with {description['images']} photos' poses, "
            f"{description['points']} points and {description['descriptors']} descriptors; see README.md"
        ),
        "license": _licence(contents),
        "extent": {
            "spatial": {"bbox": [list(contents.bbox())]},
            "temporal": {"interval": [[_time(t) for t in contents.taken() or (time, time)]]},
        },
        "assets": assets,
        "links": [*(_link("item", f"./{name}") for name in items), _link("root", "./collection.json")],
    }
    for name, entry in items.items():
        write_json(folder / layout.STAC / name, _item(entry, collection["id"]))
    write_json(folder / COLLECTION, collection)


def _asset(href: str, title: str, kind: str, role: str) -> dict[str, Any]:
    return {"href": href, "title": title, "type": kind, "roles": [role]}


def _link(rel: str, href: str) -> dict[str, str]:
    return {"rel": rel, "href": href, "type": "application/json"}


def _item(entry: MapEntry, collection: str) -> dict[str, Any]:
    row = entry.row
    first, last = entry.taken or (row["created_at"], row["created_at"])
    names = ("status", "method", "generation", "parents", "images", "points", "observations", "height_datum")
    properties = {
        "title": row["name"],
        "created": _time(row["created_at"]),
        "datetime": _time(first) if first == last else None,
        **({} if first == last else {"start_datetime": _time(first), "end_datetime": _time(last)}),
        **{f"featuredb:{name}": row[name] for name in names},
        "featuredb:licences": {licence or "not stated": count for licence, count in entry.licences.items()},
        "featuredb:descriptors": row["extractor_fingerprint"],
        "proj:epsg": row["epsg"],
        "proj:projjson": utm_projjson(row["epsg"], row["height_datum"]),
        **({"proj:bbox": entry.plan_box} if row["points"] else {}),
    }
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [PROJECTION],
        "id": entry.row["map_id"],
        "collection": collection,
        "geometry": entry.footprint.geometry,
        "bbox": list(entry.footprint.bbox),
        "properties": properties,
        "assets": {
            table: _asset(f"../../{row[f'{table}_file']}", title, _PARQUET, "data")
            for table, title in _PARTS.items()
            if row[f"{table}_file"] is not None
        },
        "links": [_link(rel, "../collection.json") for rel in ("root", "parent", "collection")],
    }


def _licence(contents: Contents) -> str:
    """The photos' licence where all have one; STAC 1.0 says "various" otherwise, "proprietary" for none."""
    found = contents.licences()
    if len(found) > 1:
        return "various"
    return next(iter(found), "") or "proprietary"


def _time(time: datetime) -> str:
    return time.isoformat().replace("+00:00", "Z")


def write_dataset(job: ExportJob, *, with_lidar: bool = False) -> Exported:
    """Write the job's maps as a dataset to the folder `job.out`; whole, or nothing is there.

    Args:
        with_lidar: also the tiles of scans that touch the maps, as LAZ.

    Raises:
        ExportError: nothing is selected, or `job.out` is not free.
        MissingExtraError: with `with_lidar`, laspy (extra `lidar`) is missing.
        StoreError: the database cannot be read.
    """
    if with_lidar:  # refused early where no tile could be written
        require("lidar", "A dataset with LiDAR tiles", "laspy", "lazrs")
    with whole_or_nothing(job.out) as folder:
        folder.mkdir()
        contents, own = _write_maps(job, folder)
        if with_lidar:
            contents.scans.extend(write_scans(job, contents, folder))
        description = _description(job, contents, own)
        write_json(folder / layout.DESCRIPTION, description)
        write_datasheet(contents, description, folder)
        write_catalogue(contents, description, folder)
        write_sums(folder)
        return job.exported(folder)


def _write_maps(job: ExportJob, folder: Path) -> tuple[Contents, OwnFrameFiles]:
    """All tables and the attribution, with one map in memory at a time."""
    contents, lineages = Contents(), job.snapshot.lineages()
    credits: list[Attribution] = []
    cameras: list[dict[str, Any]] = []
    with PartitionFiles(folder) as files, OwnFrameFiles(folder) as own:
        for feature_map in job.any_maps():
            credits += attribution_of(feature_map)
            if isinstance(feature_map, UnplacedMap):
                own.add(feature_map, job.snapshot.get_any(feature_map.map_id))
                continue
            summary, lineage = job.snapshot.get(feature_map.map_id), lineages[feature_map.map_id]
            encoded = encode_map(feature_map, "", summary.created_at)
            of_files = {f"{table}_file": path for table, path in files.write(feature_map, encoded).items()}
            row = encoded.row | {"status_reason": summary.status_reason} | of_files
            stands_on = {k: v for k, v in asdict(lineage).items() if k != "map_id"} | {"steps": lineage.steps}
            row["lineage"] = json.dumps(stands_on, sort_keys=True)
            contents.maps.append(entry_of(feature_map, row))
            keys = feature_map.camera_keys or (None,) * len(feature_map.cameras)
            cameras += [
                {"map_id": feature_map.map_id, "camera_id": number, **asdict(camera), "key": key}
                for number, (camera, key) in enumerate(zip(feature_map.cameras, keys, strict=True))
            ]
            del feature_map, encoded  # before the next one is loaded
    write_attribution(folder, credits)
    if not contents.maps:
        job.summaries()  # names what has no place
        raise ExportError(
            "a dataset says where maps lie: expected one with a place in the selection, found none"
        )
    _write_areas(contents.maps, folder)
    with TableFile(folder / layout.CAMERAS, CAMERAS.schema, ()) as file:
        file.write(pa.Table.from_pylist(cameras, schema=CAMERAS.schema))
    return contents, own


def _write_areas(maps: list[MapEntry], folder: Path) -> None:
    """maps.parquet, in small row groups: provenance and evidence make rows long."""
    rows = []
    with GeoFile(folder / layout.MAPS, MAPS.schema, MAPS.repeating, None) as file:
        for entry in maps:
            west, south, east, north = entry.footprint.bbox
            if west > east:  # readers compare numbers: a box that begins in the east would never be found
                west, east = -180.0, 180.0
            geometry = entry.footprint.geometry
            file.covers([geometry["type"]], np.array([west, south]), np.array([east, north]))
            box = {"xmin": west, "ymin": south, "xmax": east, "ymax": north}
            rows.append(entry.row | {"geometry": wkb_of(geometry), "bbox": box})
        for start in range(0, len(rows), _ROWS_AT_ONCE):
            file.write(pa.Table.from_pylist(rows[start : start + _ROWS_AT_ONCE], schema=MAPS.schema))


def _description(job: ExportJob, contents: Contents, own: OwnFrameFiles) -> dict[str, Any]:
    """What `dataset.json` says, and the datasheet and the catalogue are made of."""
    return {
        "format": layout.FORMAT,
        "format_version": layout.FORMAT_VERSION,
        "name": job.database.name,
        "snapshot": job.snapshot.version,
        "snapshot_time": job.snapshot.timestamp.isoformat(),
        "featuredb": version("featuredb"),
        "selection": asdict(job.selection),
        **{name: contents.total(name) for name in ("images", "points", "observations", "descriptors")},
        "maps": len(contents.maps),
        **({"maps_without_a_place": len(own.rows)} if own.rows else {}),
        "scans": len(contents.scans),
        "bbox": list(contents.bbox()),
    }
