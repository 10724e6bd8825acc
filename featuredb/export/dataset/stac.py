"""The STAC 1.0 catalogue: a collection, and an item for each map, with the projection extension 1.1.

https://github.com/radiantearth/stac-spec/tree/v1.0.0 is the source of every field here.
"""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from featuredb.export.attribution import ATTRIBUTION
from featuredb.export.dataset import layout
from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.export.job import write_json
from featuredb.geo.crs.wkt import utm_projjson

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
        name: _asset(f"../{name}", title, kind, "thumbnail" if kind == "image/png" else "metadata")
        for name, title, kind in (
            (layout.MAPS, "the maps", _PARQUET),
            (layout.CAMERAS, "the cameras", _PARQUET),
            (ATTRIBUTION, "owner and licence of every photo", "text/csv"),
            (layout.DATASHEET, "datasheet", "text/markdown"),
            (layout.PICTURE, "coverage", "image/png"),
        )
    }
    for tile in (tile for scan in contents.scans for tile in scan["tiles"]):
        assets[tile["file"]] = _asset(f"../{tile['file']}", "LiDAR tile", _LAZ, "data")
    items = {f"items/{layout.file_name(entry.map_id)}.json": entry for entry in contents.maps}
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
        "id": entry.map_id,
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
