"""README.md of a dataset: every figure in it is computed from what was written."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from featuredb.export.dataset import columns, layout
from featuredb.export.dataset.contents import Contents
from featuredb.export.dataset.layout import SUMS
from featuredb.export.job import ATTRIBUTION
from featuredb.geo.crs.wkt import utm_projjson

_WIDTH = 110
_METHODS = {
    "gps": "by the photos' GPS",
    "lidar": "on a LiDAR scan",
    "gcp": "by ground control points",
    "map": "by other maps",
}
_TABLES = {
    f"{layout.MAPS}: a row for each map": columns.MAPS,
    f"{layout.CAMERAS}: a row for each camera of a map": columns.CAMERAS,
    f"{layout.IMAGES}/*.parquet: a row for each image": columns.IMAGES,
    f"{layout.POINTS}/*.parquet: a row for each 3D point": columns.POINTS,
    f"{layout.OBSERVATIONS}/*.parquet: a row for each keypoint of a point": columns.OBSERVATIONS,
}


def write_datasheet(contents: Contents, description: Mapping[str, Any], folder: Path) -> None:
    """Write README.md into the folder, whose data files are there already."""
    sections = [
        _title(contents, description),
        _places(contents),
        _licences(contents),
        _made(contents, description),
        _files(),
        _reading(contents),
        "## Columns\n" + "\n".join(_columns(title, table) for title, table in _TABLES.items()),
    ]
    (folder / layout.DATASHEET).write_text("\n".join(sections), encoding="utf-8")


def _title(contents: Contents, description: Mapping[str, Any]) -> str:
    taken = contents.taken()
    west, south, east, north = contents.bbox()
    rows = [
        ("maps", f"{len(contents.maps):,}"),
        *(
            (name, f"{contents.total(name):,}")
            for name in ("images", "points", "observations", "descriptors")
        ),
        ("status of the maps", ", ".join(f"{n:,} {s}" for s, n in sorted(contents.count("status").items()))),
        ("west, south, east, north", f"{west:.6f}, {south:.6f}, {east:.6f}, {north:.6f} (WGS84 degrees)"),
        (
            "photos taken",
            "not known" if taken is None else f"{taken[0].isoformat()} to {taken[1].isoformat()}",
        ),
        ("snapshot", f"{description['snapshot']} of the database, {description['snapshot_time']}"),
    ]
    about = _prose(
        "Sparse 3D maps made of photos, each placed on Earth, with the pose of every photo and SIFT "
        f"descriptors to localise others by. Written by featuredb {description['featuredb']}, "
        f"format {description['format']} {description['format_version']}."
    )
    title = f"# {_plain(description['name'])}\n\n{about}\n"
    return f"{title}{_table(('', ''), rows)}"


def _places(contents: Contents) -> str:
    rows = []
    for partition in contents.partitions():
        here = [e for e in contents.maps if e.partition == partition]
        name = utm_projjson(partition.epsg, partition.height_datum)["name"]
        counts = [f"{sum(int(e.row[c]) for e in here):,}" for c in ("images", "points")]
        rows.append((f"EPSG:{partition.epsg}", partition.height_datum, name, f"{len(here):,}", *counts))
    return _section(
        "Where",
        _prose(
            "Coordinates are UTM on WGS84, in metres; heights are counted from what is named here, and "
            "nothing has been converted."
        ),
        _table(("zone", "heights", "CRS of the files", "maps", "images", "points"), rows),
    )


def _licences(contents: Contents) -> str:
    rows = [
        (_plain(name) or "not stated", f"{count:,}") for name, count in sorted(contents.licences().items())
    ]
    return _section(
        "Licences",
        _prose(
            "Of the photos that the maps were made of; owner, licence and capture time of each are in "
            f"`{ATTRIBUTION}`. The photos themselves are not part of the dataset."
        ),
        _table(("licence", "photos"), rows),
    )


def _made(contents: Contents, description: Mapping[str, Any]) -> str:
    methods = [(_METHODS[name], f"{count:,}") for name, count in sorted(contents.count("method").items())]
    extractors = [
        (f"`{_plain(name)}`", f"{count:,}")
        for name, count in sorted(contents.count("extractor_fingerprint").items())
    ]
    chosen = "; ".join(f"{k}: {_words(v)}" for k, v in description["selection"].items() if v)
    return _section(
        "How it was made",
        _prose(
            "SIFT keypoints were matched between photos, reconstructed by structure from motion and placed "
            "on Earth. What was placed by other maps hangs on them (`parents`, `lineage`). Options, versions "
            f"and the figures behind each placement are in `{layout.MAPS}` (`provenance`, "
            "`placement_evidence`)."
        ),
        _table(("placed", "maps"), methods),
        _table(("descriptors of", "maps"), extractors),
        f"Selected of the snapshot: {chosen}.\n",
    )


def _files() -> str:
    return _section(
        "Files",
        _prose(
            f"`{layout.STAC}/collection.json` is a STAC 1.0 catalogue with an item for each map, "
            f"`{layout.DESCRIPTION}` says what this is for programs, `{SUMS}` lists every file: "
            f"`sha256sum --check {SUMS}`. Scans, if any, are in `{layout.LIDAR}/scans.json`, maps "
            f"without a place in `{layout.OWN_FRAME}`."
        ),
        _prose(
            "Files of points and images are named by zone, height datum and number, since a GeoParquet "
            "column has one reference system. A map is in one file of each table, which its row in "
            f"`{layout.MAPS}` names."
        ),
    )


def _reading(contents: Contents) -> str:
    example = next((e.row["points_file"] for e in contents.maps if e.row["points_file"]), None)
    lines = ["## Reading it\n```\nfeaturedb import DB .              # back into a database, bit for bit"]
    if example is not None:
        lines.append(f"duckdb -c \"select map_id, count(*) from '{layout.POINTS}/*.parquet' group by 1\"")
        lines.append(f"python -c \"import geopandas; print(geopandas.read_parquet('{example}'))\"")
    return "\n".join(lines) + "\n```\n"


def _columns(title: str, table: columns.Columns) -> str:
    rows = [(f"`{n}`", str(table.schema.field(n).type), text) for n, text in table.meaning().items()]
    return f"\n### {title}\n" + _table(("column", "type", "what"), rows)


def _section(title: str, *parts: str) -> str:
    return f"## {title}\n" + "\n".join(parts)


def _prose(text: str) -> str:
    return textwrap.fill(text, _WIDTH, break_long_words=False, break_on_hyphens=False) + "\n"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def _words(value: Any) -> str:
    return _plain(", ".join(map(str, value)) if isinstance(value, tuple) else str(value))


def _plain(text: str) -> str:
    """Names that people have given, so that they do not break a table."""
    return " ".join(text.replace("|", "/").replace("`", "'").replace("<", "(").replace(">", ")").split())
