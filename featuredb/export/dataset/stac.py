"""The STAC 1.0 catalogue: a collection, and an item for each map, with the projection extension."""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from featuredb.errors import MissingExtraError
from featuredb.export.attribution import ATTRIBUTION
from featuredb.export.dataset import layout
from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.extras import require
from featuredb.geo.crs.wkt import utm_projjson
from featuredb.store.tables import BOUNDS

STAC_VERSION = "1.0.0"
COLLECTION = f"{layout.STAC}/collection.json"
_PARQUET = "application/vnd.apache.parquet"
_LAZ = "application/vnd.laszip"
_BOX = [BOUNDS[i] for i in (0, 1, 3, 4)]  # min easting, min northing, max easting, max northing
_PARTS = {
    "points": "points, GeoParquet; the map's rows have its map_id",
    "images": "images with their poses, GeoParquet; the map's rows have its map_id",
    "observations": "keypoints and descriptors, Parquet; the map's rows have its map_id",
}


def check_stac() -> None:
    """Refuse early where the catalogue could not be made.

    Raises:
        MissingExtraError: pystac is not installed, or one that writes another version of STAC.
    """
    require("dataset", "A dataset's catalogue", "pystac")
    import pystac

    found = pystac.get_stac_version()
    if found != STAC_VERSION:
        raise MissingExtraError(
            f"expected a pystac that writes STAC {STAC_VERSION}, found one that writes {found}; "
            "install it by: pip install 'featuredb[dataset]'"
        )


def write_catalogue(contents: Contents, description: Mapping[str, Any], folder: Path) -> None:
    """Write `stac/collection.json` and `stac/items/*.json`, with relative links to the files beside them."""
    import pystac

    collection = pystac.Collection(
        id=description["name"],
        title=description["name"],
        description=_about(description),
        extent=_extent(contents, description),
        license=_licence(contents),
        href=str(folder / COLLECTION),
    )
    for name, title, kind in (
        (layout.MAPS, "the maps", _PARQUET),
        (layout.CAMERAS, "the cameras", _PARQUET),
        (ATTRIBUTION, "owner and licence of every photo", "text/csv"),
        (layout.DATASHEET, "datasheet", "text/markdown"),
        (layout.PICTURE, "coverage", "image/png"),
    ):
        role = "thumbnail" if kind == "image/png" else "metadata"
        collection.add_asset(name, pystac.Asset(f"../{name}", title=title, media_type=kind, roles=[role]))
    for scan in contents.scans:
        for tile in scan["tiles"]:
            collection.add_asset(
                tile["file"],
                pystac.Asset(f"../{tile['file']}", title="LiDAR tile", media_type=_LAZ, roles=["data"]),
            )
    items = [_item(entry) for entry in contents.maps]
    for item in items:
        item.set_self_href(str(folder / layout.STAC / "items" / f"{layout.file_name(item.id)}.json"))
        collection.add_link(pystac.Link(pystac.RelType.ITEM, _item_href(item.id), pystac.MediaType.JSON))
        item.add_links(
            [
                pystac.Link(rel, "../collection.json", pystac.MediaType.JSON)
                for rel in (pystac.RelType.ROOT, pystac.RelType.PARENT, pystac.RelType.COLLECTION)
            ]
        )
        item.collection_id = collection.id
        _write(item, folder / layout.STAC / "items" / f"{layout.file_name(item.id)}.json")
    _write(collection, folder / COLLECTION)


def _item_href(map_id: str) -> str:
    return f"./items/{layout.file_name(map_id)}.json"


def _write(thing: Any, path: Path) -> None:
    """As JSON. Links say where things are from here, so that the folder may lie anywhere; none to itself."""
    document = thing.to_dict(include_self_link=False, transform_hrefs=False)
    if document["type"] == "Collection":
        document["links"] = [link for link in document["links"] if link["rel"] != "root"] + [
            {"rel": "root", "href": "./collection.json", "type": "application/json"}
        ]
    layout.write_json(path, document)


def _item(entry: MapEntry) -> Any:
    import pystac
    from pystac.extensions.projection import ProjectionExtension

    row, taken = entry.row, entry.taken
    single = (
        None if taken is not None and taken[0] != taken[1] else (taken[0] if taken else row["created_at"])
    )
    item = pystac.Item(
        id=entry.map_id,
        geometry=entry.footprint.geometry,
        bbox=list(entry.footprint.bbox),
        datetime=single,
        properties=_properties(entry),
        start_datetime=taken[0] if taken and single is None else None,
        end_datetime=taken[1] if taken and single is None else None,
    )
    projection = ProjectionExtension.ext(item, add_if_missing=True)
    projection.epsg = row["epsg"]
    projection.projjson = utm_projjson(row["epsg"], row["height_datum"])
    if row["points"]:
        projection.bbox = [row[name] for name in _BOX]
    for table, title in _PARTS.items():
        name = row[f"{table}_file"]
        if name is not None:
            item.add_asset(
                table, pystac.Asset(f"../../{name}", title=title, media_type=_PARQUET, roles=["data"])
            )
    return item


def _properties(entry: MapEntry) -> dict[str, Any]:
    row = entry.row
    names = ("status", "method", "generation", "parents", "images", "points", "observations", "height_datum")
    licences = {licence or "not stated": count for licence, count in sorted(entry.licences.items())}
    return {
        "title": row["name"],
        "created": _time(row["created_at"]),
        **{f"featuredb:{name}": row[name] for name in names},
        "featuredb:licences": licences,
        "featuredb:descriptors": row["extractor_fingerprint"],
    }


def _extent(contents: Contents, description: Mapping[str, Any]) -> Any:
    import pystac

    taken = contents.taken()
    time = datetime.fromisoformat(description["snapshot_time"])
    first, last = taken or (time, time)
    boxes = [list(contents.bbox())]
    return pystac.Extent(pystac.SpatialExtent(boxes), pystac.TemporalExtent([[first, last]]))


def _licence(contents: Contents) -> str:
    """The photos' licence where all have one; STAC 1.0 says "various" otherwise, "proprietary" for none."""
    found = contents.licences()
    if len(found) > 1:
        return "various"
    return next(iter(found), "") or "proprietary"


def _about(description: Mapping[str, Any]) -> str:
    return (
        f"{description['maps']} geo-registered feature maps with {description['images']} photos' poses, "
        f"{description['points']} points and {description['descriptors']} descriptors; see README.md"
    )


def _time(time: datetime) -> str:
    return time.isoformat().replace("+00:00", "Z")
