"""The Delta tables of a database: names, columns, partitions.

`maps` has one row per map and decides what is visible. The child tables hold the rows of images, points and
observations; each row names the `write_id` of the commit attempt that wrote it, and counts only when a row of
`maps` names that `write_id`. `lidar` and `lidar_points` hold scans in the same way, and are made when the
first scan is added. `candidates` and `candidate_images` hold contributed photos, `canaries` known queries;
they, too, are made on first use. See docs/store.md.
"""

from dataclasses import dataclass

import pyarrow as pa

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
    """One Delta table.

    Attributes:
        name: folder below the database's URL.
        schema: Arrow schema of the rows, in Delta's types (signed integers, no fixed-size lists).
        partition_by: partition columns, () for none.
        statistics: columns whose minimum and maximum go into the log; the others would only bloat it.
        plain_bytes: columns of bytes without repetition, for which a dictionary and statistics are a waste.
        row_group_rows: rows that are read together.
    """

    name: str
    schema: pa.Schema
    partition_by: tuple[str, ...] = ()
    statistics: tuple[str, ...] = ()
    plain_bytes: tuple[str, ...] = ()
    row_group_rows: int = ROW_GROUP_ROWS


def required(kind: pa.DataType, *names: str) -> list[pa.Field]:
    """Columns of a type that are never null."""
    return [pa.field(name, kind, nullable=False) for name in names]


def nullable(kind: pa.DataType, *names: str) -> list[pa.Field]:
    """Columns of a type that may be null."""
    return [pa.field(name, kind) for name in names]


def _list(element: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("element", element, nullable=False))


_TEXT, _TIME = pa.string(), pa.timestamp("us", tz="UTC")
_INT, _LONG, _SHORT = pa.int32(), pa.int64(), pa.int16()
_FLOAT, _DOUBLE, DOUBLES = pa.float32(), pa.float64(), _list(pa.float64())
CAMERA = [*required(_TEXT, "model"), *required(_INT, "width", "height"), *required(DOUBLES, "params")]
UTM_COORDINATES = ("easting", "northing", "height")
_UTM = required(_DOUBLE, *UTM_COORDINATES)
_PARTITION = [*required(_INT, "zone"), *required(_TEXT, "tile")]

BOUNDS = ("min_easting", "min_northing", "min_height", "max_easting", "max_northing", "max_height")
OWN_COORDINATES = ("x", "y", "z")  # of points of maps without a place, in their own frame
NO_PLACE_COLUMNS = ("frame_is_metric", "frame_is_upright", "no_place")  # that only a map without a place has
POINT_COVARIANCE = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")

_MAPS_SCHEMA = pa.schema(
    [
        *required(_TEXT, "map_id", "write_id", "content_digest", "name", "status", "status_reason"),
        *required(_TIME, "created_at"),
        *nullable(_INT, "epsg"),
        *nullable(_TEXT, "height_datum"),
        *nullable(_DOUBLE, *BOUNDS),
        *required(_list(_TEXT), "tiles"),
        *required(_LONG, "images", "points", "observations", "descriptors"),
        *nullable(_TEXT, "method"),
        *required(_INT, "generation"),
        *required(_list(_TEXT), "parents"),
        *nullable(_DOUBLE, "residual_rms_m"),
        *nullable(_DOUBLE, "origin_latitude_deg", "origin_longitude_deg", "origin_height_m"),
        *nullable(_DOUBLE, "local_from_sfm_scale"),
        *nullable(DOUBLES, "local_from_sfm_rotation", "local_from_sfm_translation", "placement_covariance"),
        *nullable(_TEXT, "placement_evidence"),
        *required(_list(_TEXT), "camera_keys"),
        *required(_list(pa.struct(CAMERA)), "cameras"),
        *required(_TEXT, "extractor_fingerprint", "source", "licence", "provenance"),
        *nullable(pa.bool_(), "frame_is_metric", "frame_is_upright"),
        *nullable(_TEXT, "no_place"),
    ]
)
# Columns of `maps` that are null for a map without a place, besides BOUNDS.
PLACE_COLUMNS = tuple(
    field.name for field in _MAPS_SCHEMA if field.nullable and field.name not in (*BOUNDS, *NO_PLACE_COLUMNS)
)

_IMAGES_SCHEMA = pa.schema(
    [
        *required(_TEXT, "write_id", "map_id"),
        *required(_INT, "image_id"),
        *required(_LONG, "image_index"),
        *required(_TEXT, "name", "sha256"),
        *required(_INT, "camera_id"),
        *required(DOUBLES, "cam_from_local_rotation", "cam_from_local_translation"),
        *nullable(DOUBLES, "covariance"),
        *_UTM,
        *nullable(_TEXT, "capture_time"),
        *nullable(_DOUBLE, "gps_latitude_deg", "gps_longitude_deg", "gps_height_m"),
        *nullable(_DOUBLE, "gps_sigma_horizontal_m", "gps_sigma_vertical_m"),
        *required(_TEXT, "owner", "licence"),
        *_PARTITION,
    ]
)

_POINTS_SCHEMA = pa.schema(
    [
        *required(_TEXT, "write_id", "map_id"),
        *required(_LONG, "point_index"),
        *_UTM,
        *required(_SHORT, "red", "green", "blue"),
        *required(_INT, "track_length"),
        *required(_FLOAT, "error_px", *POINT_COVARIANCE),
        *_PARTITION,
        *nullable(_DOUBLE, *OWN_COORDINATES),
    ]
)

_OBSERVATIONS_SCHEMA = pa.schema(
    [
        *required(_TEXT, "write_id", "map_id"),
        *required(_LONG, "observation_index", "point_index"),
        *required(_INT, "image_id"),
        *required(_FLOAT, "x", "y", "scale", "angle"),
        *nullable(pa.binary(), "descriptor"),
        *_PARTITION,
    ]
)

_SCAN_FILE = pa.struct(
    [
        *required(_TEXT, "name", "sha256"),
        *required(_LONG, "size_bytes", "points"),
        *required(_TEXT, "crs", "transformation"),
        *nullable(_DOUBLE, "transformation_accuracy_m"),
    ]
)
_CLASS_COUNT = pa.struct([*required(_INT, "classification"), *required(_LONG, "points")])

_LIDAR_SCHEMA = pa.schema(
    [
        *required(_TEXT, "scan_id", "write_id", "points_checksum", "name", "status", "status_reason"),
        *required(_TIME, "created_at"),
        *required(_list(_SCAN_FILE), "files"),
        *required(_INT, "epsg"),
        *required(_TEXT, "height_datum"),
        *required(_DOUBLE, *BOUNDS),
        *required(_list(_TEXT), "tiles"),
        *required(_LONG, "points", "points_in_files"),
        *required(_LONG, "dropped_noise", "dropped_withheld", "dropped_outliers"),
        *required(_list(_LONG), "level_points"),
        *required(_DOUBLE, "spacing_m"),
        *required(_list(_CLASS_COUNT), "classes"),
        *required(_TEXT, "colour", "ortho"),
        *required(pa.bool_(), "has_intensity"),
        *nullable(_DOUBLE, "intensity_low", "intensity_high"),
        *required(_TEXT, "crs_source", "horizontal_unit", "vertical_crs", "height_unit"),
        *required(_DOUBLE, "height_unit_m"),
        *required(_TEXT, "height_unit_reason"),
        *required(_list(_TEXT), "notes"),
        *required(_TEXT, "options", "source", "licence"),
    ]
)

_LIDAR_POINTS_SCHEMA = pa.schema(
    [
        *required(_TEXT, "write_id"),
        *_UTM,
        *nullable(_SHORT, "red", "green", "blue", "intensity"),
        *required(_SHORT, "classification"),
        *required(_LONG, "node"),
        *required(_FLOAT, "node_spacing_m"),
        *_PARTITION,
        *required(_INT, "level"),
    ]
)

_CANDIDATES_SCHEMA = pa.schema(
    [
        *required(_TEXT, "candidate_id", "write_id"),
        *required(_INT, "event_index"),
        *required(_TEXT, "event"),
        *required(_TIME, "happened_at"),
        *nullable(_TEXT, "owner", "licence", "client_id", "sha256"),
        *nullable(_LONG, "size_bytes"),
        *nullable(_INT, "width", "height"),
        *nullable(_LONG, "snapshot"),
        *nullable(_TEXT, "answer_status", "request", "answer", "map_id", "reason_code", "reason"),
    ]
)

_CANDIDATE_IMAGES_SCHEMA = pa.schema(
    [*required(_TEXT, "candidate_id", "write_id"), *required(pa.binary(), "image")]
)

_CANARIES_SCHEMA = pa.schema(
    [
        *required(_TEXT, "canary_id", "write_id", "name"),
        *required(_TIME, "created_at"),
        *required(_TEXT, "sha256", "request", "expected"),
        *nullable(_INT, "epsg"),
        *nullable(_DOUBLE, *UTM_COORDINATES),
        *nullable(DOUBLES, "cam_from_utm_xyzw"),
        *nullable(_TEXT, "height_datum"),
        *nullable(_DOUBLE, "tolerance_m", "tolerance_deg"),
        *required(_TEXT, "origin"),
        *nullable(_LONG, "snapshot"),
        *required(_TEXT, "note"),
        *required(pa.binary(), "image"),
    ]
)

SPECS: dict[str, TableSpec] = {
    spec.name: spec
    for spec in (
        TableSpec(name=MAPS, schema=_MAPS_SCHEMA, statistics=("map_id", "write_id")),
        TableSpec(
            name=IMAGES,
            schema=_IMAGES_SCHEMA,
            partition_by=("zone", "tile"),
            statistics=("write_id", "image_index"),
        ),
        TableSpec(
            name=POINTS,
            schema=_POINTS_SCHEMA,
            partition_by=("zone", "tile"),
            statistics=("write_id", "point_index"),
        ),
        TableSpec(
            name=OBSERVATIONS,
            schema=_OBSERVATIONS_SCHEMA,
            partition_by=("zone", "tile"),
            statistics=("write_id", "observation_index"),
            plain_bytes=("descriptor",),
        ),
        TableSpec(name=LIDAR, schema=_LIDAR_SCHEMA, statistics=("scan_id", "write_id")),
        TableSpec(
            name=LIDAR_POINTS,
            schema=_LIDAR_POINTS_SCHEMA,
            partition_by=("zone", "tile", "level"),
            statistics=("write_id", "easting", "northing"),
        ),
        TableSpec(name=CANDIDATES, schema=_CANDIDATES_SCHEMA, statistics=("candidate_id", "write_id")),
        TableSpec(
            name=CANDIDATE_IMAGES,
            schema=_CANDIDATE_IMAGES_SCHEMA,
            statistics=("candidate_id", "write_id"),
            plain_bytes=("image",),
            row_group_rows=1,  # a photo has megabytes and is read alone
        ),
        TableSpec(
            name=CANARIES,
            schema=_CANARIES_SCHEMA,
            statistics=("canary_id", "write_id"),
            plain_bytes=("image",),
            row_group_rows=1,
        ),
    )
}
