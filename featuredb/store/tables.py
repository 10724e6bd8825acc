"""The Delta tables of a database: their names; `schemas/tables` has columns, types and partitions.

`maps` has one row per map and decides what is visible. The child tables hold the rows of images, points and
observations; each row names the `write_id` of the commit attempt that wrote it, and counts only when a row of
`maps` names that `write_id`. `lidar` and `lidar_points` hold scans in the same way, and are made when the
first scan is added. `candidates` and `candidate_images` hold contributed photos, `canaries` known queries;
they, too, are made on first use. See docs/store.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import pyarrow as pa

from schemas import load_schema

# Format 2 holds maps without a place: what says where a map lies may be null in `maps`, and `points` have
# coordinates in the map's own frame. Format 1 is read and written, and becomes 2 by `featuredb upgrade`.
FORMAT_VERSION = 2
READABLE_FORMATS = (1, 2)
# Partition of rows of maps without a place; their easting, northing and height are NaN.
NO_ZONE, NO_TILE = 0, "unplaced"

MAPS = "maps"
IMAGES = "images"
POINTS = "points"
OBSERVATIONS = "observations"
CHILD_TABLES = (IMAGES, POINTS, OBSERVATIONS)
LIDAR = "lidar"
LIDAR_POINTS = "lidar_points"
CANDIDATES = "candidates"
CANDIDATE_IMAGES = "candidate_images"
CANARIES = "canaries"
# Each table that names rows of others, and those; where it is, they are, too.
CHILDREN = {MAPS: CHILD_TABLES, LIDAR: (LIDAR_POINTS,), CANDIDATES: (CANDIDATE_IMAGES,), CANARIES: ()}
# Compaction puts maps one after the other into a file; reading one skips the row groups of the others.
# 32768 observations are 4 MB, large enough to be read in one go.
ROW_GROUP_ROWS = 32_768


@dataclass(frozen=True, slots=True, kw_only=True)
class TableSpec:
    """One Delta table; what `schemas/tables` says of it.

    Attributes:
        name: folder below the database's URL.
        statistics: columns whose minimum and maximum go into the log; the others would only bloat it.
        plain_bytes: columns of bytes without repetition, for which a dictionary and statistics are a waste.
        row_group_rows: rows that are read together.
    """

    name: str
    statistics: tuple[str, ...] = ()
    plain_bytes: tuple[str, ...] = ()
    row_group_rows: int = ROW_GROUP_ROWS

    @property
    def schema(self) -> pa.Schema:
        """Arrow schema of the rows, in Delta's types (signed integers, no fixed-size lists)."""
        return _published(self.name)[0]

    @property
    def partition_by(self) -> tuple[str, ...]:
        """Partition columns, () for none."""
        return _published(self.name)[1]


_TYPES = {
    "string": pa.string(), "timestamp": pa.timestamp("us", tz="UTC"), "boolean": pa.bool_(),
    "short": pa.int16(), "integer": pa.int32(), "long": pa.int64(), "float": pa.float32(),
    "double": pa.float64(), "binary": pa.binary(),
}  # fmt: skip


@cache
def _published(name: str) -> tuple[pa.Schema, tuple[str, ...]]:
    """Schema and partition columns of a table, by its JSON Schema."""
    said = load_schema(f"tables/{name}")
    columns = pa.schema([_field(*column) for column in said["properties"].items()])
    return columns, tuple(said["x-partition-by"])


def _field(name: str, said: Mapping[str, Any]) -> pa.Field:
    """The column that a JSON Schema describes."""
    if "x-delta-type" in said:
        kind = _TYPES[said["x-delta-type"]]
    elif "items" in said:
        kind = pa.list_(_field("element", said["items"]))
    else:
        kind = pa.struct([_field(*member) for member in said["properties"].items()])
    return pa.field(name, kind, nullable="null" in said["type"])


UTM_COORDINATES = ("easting", "northing", "height")
BOUNDS = ("min_easting", "min_northing", "min_height", "max_easting", "max_northing", "max_height")
OWN_COORDINATES = ("x", "y", "z")  # of points of maps without a place, in their own frame
NO_PLACE_COLUMNS = ("frame_is_metric", "frame_is_upright", "no_place")  # that only a map without a place has
POINT_COVARIANCE = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")

# Columns of `maps` that are null for a map without a place, besides BOUNDS.
PLACE_COLUMNS = (
    *("epsg", "height_datum", "method", "residual_rms_m"),
    *("origin_latitude_deg", "origin_longitude_deg", "origin_height_m"),
    *("local_from_sfm_scale", "local_from_sfm_rotation", "local_from_sfm_translation"),
    *("placement_covariance", "placement_evidence"),
)

SPECS: dict[str, TableSpec] = {
    spec.name: spec
    for spec in (
        TableSpec(name=MAPS, statistics=("map_id", "write_id")),
        TableSpec(name=IMAGES, statistics=("write_id", "image_index")),
        TableSpec(name=POINTS, statistics=("write_id", "point_index")),
        TableSpec(
            name=OBSERVATIONS, statistics=("write_id", "observation_index"), plain_bytes=("descriptor",)
        ),
        TableSpec(name=LIDAR, statistics=("scan_id", "write_id")),
        TableSpec(name=LIDAR_POINTS, statistics=("write_id", "easting", "northing")),
        TableSpec(name=CANDIDATES, statistics=("candidate_id", "write_id")),
        # A photo has megabytes and is read alone.
        TableSpec(
            name=CANDIDATE_IMAGES,
            statistics=("candidate_id", "write_id"),
            plain_bytes=("image",),
            row_group_rows=1,
        ),
        TableSpec(
            name=CANARIES, statistics=("canary_id", "write_id"), plain_bytes=("image",), row_group_rows=1
        ),
    )
}
