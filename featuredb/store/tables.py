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


def _required(kind: pa.DataType, *names: str) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=False) for name in names]


def _nullable(kind: pa.DataType, *names: str) -> list[pa.Field]:
    return [pa.field(name, kind) for name in names]


def _list(element: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("element", element, nullable=False))


_TEXT, _TIME = pa.string(), pa.timestamp("us", tz="UTC")
_INT, _LONG, _SHORT = pa.int32(), pa.int64(), pa.int16()
_FLOAT, _DOUBLE, _DOUBLES = pa.float32(), pa.float64(), _list(pa.float64())
_CAMERA = pa.struct(
    [*_required(_TEXT, "model"), *_required(_INT, "width", "height"), *_required(_DOUBLES, "params")]
)
UTM_COORDINATES = ("easting", "northing", "height")
_UTM = _required(_DOUBLE, *UTM_COORDINATES)
_PARTITION = [*_required(_INT, "zone"), *_required(_TEXT, "tile")]

BOUNDS = ("min_easting", "min_northing", "min_height", "max_easting", "max_northing", "max_height")
OWN_COORDINATES = ("x", "y", "z")  # of points of maps without a place, in their own frame
# Columns of `maps` that are null for a map without a place, besides BOUNDS; those that only such a map has.
PLACE_COLUMNS = (
    "epsg",
    "height_datum",
    "method",
    "residual_rms_m",
    "origin_latitude_deg",
    "origin_longitude_deg",
    "origin_height_m",
    "local_from_sfm_scale",
    "local_from_sfm_rotation",
    "local_from_sfm_translation",
    "placement_covariance",
    "placement_evidence",
)
NO_PLACE_COLUMNS = ("frame_is_metric", "frame_is_upright", "no_place")
POINT_COVARIANCE = ("cov_ee", "cov_en", "cov_eu", "cov_nn", "cov_nu", "cov_uu")

_MAPS_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "map_id", "write_id", "content_digest", "name", "status", "status_reason"),
        *_required(_TIME, "created_at"),
        *_nullable(_INT, "epsg"),
        *_nullable(_TEXT, "height_datum"),
        *_nullable(_DOUBLE, *BOUNDS),
        *_required(_list(_TEXT), "tiles"),
        *_required(_LONG, "images", "points", "observations", "descriptors"),
        *_nullable(_TEXT, "method"),
        *_required(_INT, "generation"),
        *_required(_list(_TEXT), "parents"),
        *_nullable(_DOUBLE, "residual_rms_m"),
        *_nullable(_DOUBLE, "origin_latitude_deg", "origin_longitude_deg", "origin_height_m"),
        *_nullable(_DOUBLE, "local_from_sfm_scale"),
        *_nullable(_DOUBLES, "local_from_sfm_rotation", "local_from_sfm_translation", "placement_covariance"),
        *_nullable(_TEXT, "placement_evidence"),
        *_required(_list(_TEXT), "camera_keys"),
        *_required(_list(_CAMERA), "cameras"),
        *_required(_TEXT, "extractor_fingerprint", "source", "licence", "provenance"),
        *_nullable(pa.bool_(), "frame_is_metric", "frame_is_upright"),
        *_nullable(_TEXT, "no_place"),
    ]
)

_IMAGES_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "write_id", "map_id"),
        *_required(_INT, "image_id"),
        *_required(_LONG, "image_index"),
        *_required(_TEXT, "name", "sha256"),
        *_required(_INT, "camera_id"),
        *_required(_DOUBLES, "cam_from_local_rotation", "cam_from_local_translation"),
        *_nullable(_DOUBLES, "covariance"),
        *_UTM,
        *_nullable(_TEXT, "capture_time"),
        *_nullable(_DOUBLE, "gps_latitude_deg", "gps_longitude_deg", "gps_height_m"),
        *_nullable(_DOUBLE, "gps_sigma_horizontal_m", "gps_sigma_vertical_m"),
        *_required(_TEXT, "owner", "licence"),
        *_PARTITION,
    ]
)

_POINTS_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "write_id", "map_id"),
        *_required(_LONG, "point_index"),
        *_UTM,
        *_required(_SHORT, "red", "green", "blue"),
        *_required(_INT, "track_length"),
        *_required(_FLOAT, "error_px", *POINT_COVARIANCE),
        *_PARTITION,
        *_nullable(_DOUBLE, *OWN_COORDINATES),
    ]
)

_OBSERVATIONS_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "write_id", "map_id"),
        *_required(_LONG, "observation_index", "point_index"),
        *_required(_INT, "image_id"),
        *_required(_FLOAT, "x", "y", "scale", "angle"),
        *_nullable(pa.binary(), "descriptor"),
        *_PARTITION,
    ]
)

_SCAN_FILE = pa.struct(
    [
        *_required(_TEXT, "name", "sha256"),
        *_required(_LONG, "size_bytes", "points"),
        *_required(_TEXT, "crs", "transformation"),
        *_nullable(_DOUBLE, "transformation_accuracy_m"),
    ]
)
_CLASS_COUNT = pa.struct([*_required(_INT, "classification"), *_required(_LONG, "points")])

_LIDAR_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "scan_id", "write_id", "points_checksum", "name", "status", "status_reason"),
        *_required(_TIME, "created_at"),
        *_required(_list(_SCAN_FILE), "files"),
        *_required(_INT, "epsg"),
        *_required(_TEXT, "height_datum"),
        *_required(_DOUBLE, *BOUNDS),
        *_required(_list(_TEXT), "tiles"),
        *_required(_LONG, "points", "points_in_files"),
        *_required(_LONG, "dropped_noise", "dropped_withheld", "dropped_outliers"),
        *_required(_list(_LONG), "level_points"),
        *_required(_DOUBLE, "spacing_m"),
        *_required(_list(_CLASS_COUNT), "classes"),
        *_required(_TEXT, "colour", "ortho"),
        *_required(pa.bool_(), "has_intensity"),
        *_nullable(_DOUBLE, "intensity_low", "intensity_high"),
        *_required(_TEXT, "crs_source", "horizontal_unit", "vertical_crs", "height_unit"),
        *_required(_DOUBLE, "height_unit_m"),
        *_required(_TEXT, "height_unit_reason"),
        *_required(_list(_TEXT), "notes"),
        *_required(_TEXT, "options", "source", "licence"),
    ]
)

_LIDAR_POINTS_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "write_id"),
        *_UTM,
        *_nullable(_SHORT, "red", "green", "blue", "intensity"),
        *_required(_SHORT, "classification"),
        *_required(_LONG, "node"),
        *_required(_FLOAT, "node_spacing_m"),
        *_PARTITION,
        *_required(_INT, "level"),
    ]
)

_CANDIDATES_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "candidate_id", "write_id"),
        *_required(_INT, "event_index"),
        *_required(_TEXT, "event"),
        *_required(_TIME, "happened_at"),
        *_nullable(_TEXT, "owner", "licence", "client_id", "sha256"),
        *_nullable(_LONG, "size_bytes"),
        *_nullable(_INT, "width", "height"),
        *_nullable(_LONG, "snapshot"),
        *_nullable(_TEXT, "answer_status", "request", "answer", "map_id", "reason_code", "reason"),
    ]
)

_CANDIDATE_IMAGES_SCHEMA = pa.schema(
    [*_required(_TEXT, "candidate_id", "write_id"), *_required(pa.binary(), "image")]
)

_CANARIES_SCHEMA = pa.schema(
    [
        *_required(_TEXT, "canary_id", "write_id", "name"),
        *_required(_TIME, "created_at"),
        *_required(_TEXT, "sha256", "request", "expected"),
        *_nullable(_INT, "epsg"),
        *_nullable(_DOUBLE, *UTM_COORDINATES),
        *_nullable(_DOUBLES, "cam_from_utm_xyzw"),
        *_nullable(_TEXT, "height_datum"),
        *_nullable(_DOUBLE, "tolerance_m", "tolerance_deg"),
        *_required(_TEXT, "origin"),
        *_nullable(_LONG, "snapshot"),
        *_required(_TEXT, "note"),
        *_required(pa.binary(), "image"),
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
