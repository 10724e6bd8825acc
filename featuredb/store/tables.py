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
TABLES = (MAPS, *CHILD_TABLES)
LIDAR = "lidar"
LIDAR_POINTS = "lidar_points"
LIDAR_TABLES = (LIDAR, LIDAR_POINTS)
CANDIDATES = "candidates"
CANDIDATE_IMAGES = "candidate_images"
CANDIDATE_TABLES = (CANDIDATES, CANDIDATE_IMAGES)
CANARIES = "canaries"
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


def _required(name: str, kind: pa.DataType) -> pa.Field:
    return pa.field(name, kind, nullable=False)


_DOUBLES = pa.list_(pa.field("element", pa.float64(), nullable=False))
_STRINGS = pa.list_(pa.field("element", pa.string(), nullable=False))
_CAMERA = pa.struct(
    [
        _required("model", pa.string()),
        _required("width", pa.int32()),
        _required("height", pa.int32()),
        _required("params", _DOUBLES),
    ]
)
_UTM = [_required(name, pa.float64()) for name in ("easting", "northing", "height")]
_PARTITION = [_required("zone", pa.int32()), _required("tile", pa.string())]

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
        _required("map_id", pa.string()),
        _required("write_id", pa.string()),
        _required("content_digest", pa.string()),
        _required("name", pa.string()),
        _required("status", pa.string()),
        _required("status_reason", pa.string()),
        _required("created_at", pa.timestamp("us", tz="UTC")),
        pa.field("epsg", pa.int32()),
        pa.field("height_datum", pa.string()),
        *(pa.field(name, pa.float64()) for name in BOUNDS),
        _required("tiles", _STRINGS),
        _required("images", pa.int64()),
        _required("points", pa.int64()),
        _required("observations", pa.int64()),
        _required("descriptors", pa.int64()),
        pa.field("method", pa.string()),
        _required("generation", pa.int32()),
        _required("parents", _STRINGS),
        pa.field("residual_rms_m", pa.float64()),
        pa.field("origin_latitude_deg", pa.float64()),
        pa.field("origin_longitude_deg", pa.float64()),
        pa.field("origin_height_m", pa.float64()),
        pa.field("local_from_sfm_scale", pa.float64()),
        pa.field("local_from_sfm_rotation", _DOUBLES),
        pa.field("local_from_sfm_translation", _DOUBLES),
        pa.field("placement_covariance", _DOUBLES),
        pa.field("placement_evidence", pa.string()),
        _required("camera_keys", _STRINGS),
        _required("cameras", pa.list_(pa.field("element", _CAMERA, nullable=False))),
        _required("extractor_fingerprint", pa.string()),
        _required("source", pa.string()),
        _required("licence", pa.string()),
        _required("provenance", pa.string()),
        pa.field("frame_is_metric", pa.bool_()),
        pa.field("frame_is_upright", pa.bool_()),
        pa.field("no_place", pa.string()),
    ]
)

_IMAGES_SCHEMA = pa.schema(
    [
        _required("write_id", pa.string()),
        _required("map_id", pa.string()),
        _required("image_id", pa.int32()),
        _required("image_index", pa.int64()),
        _required("name", pa.string()),
        _required("sha256", pa.string()),
        _required("camera_id", pa.int32()),
        _required("cam_from_local_rotation", _DOUBLES),
        _required("cam_from_local_translation", _DOUBLES),
        pa.field("covariance", _DOUBLES),
        *_UTM,
        pa.field("capture_time", pa.string()),
        pa.field("gps_latitude_deg", pa.float64()),
        pa.field("gps_longitude_deg", pa.float64()),
        pa.field("gps_height_m", pa.float64()),
        pa.field("gps_sigma_horizontal_m", pa.float64()),
        pa.field("gps_sigma_vertical_m", pa.float64()),
        _required("owner", pa.string()),
        _required("licence", pa.string()),
        *_PARTITION,
    ]
)

_POINTS_SCHEMA = pa.schema(
    [
        _required("write_id", pa.string()),
        _required("map_id", pa.string()),
        _required("point_index", pa.int64()),
        *_UTM,
        *(_required(name, pa.int16()) for name in ("red", "green", "blue")),
        _required("track_length", pa.int32()),
        _required("error_px", pa.float32()),
        *(_required(name, pa.float32()) for name in POINT_COVARIANCE),
        *_PARTITION,
        *(pa.field(name, pa.float64()) for name in OWN_COORDINATES),
    ]
)

_OBSERVATIONS_SCHEMA = pa.schema(
    [
        _required("write_id", pa.string()),
        _required("map_id", pa.string()),
        _required("observation_index", pa.int64()),
        _required("point_index", pa.int64()),
        _required("image_id", pa.int32()),
        *(_required(name, pa.float32()) for name in ("x", "y", "scale", "angle")),
        pa.field("descriptor", pa.binary()),
        *_PARTITION,
    ]
)

_SCAN_FILE = pa.struct(
    [
        _required("name", pa.string()),
        _required("sha256", pa.string()),
        _required("size_bytes", pa.int64()),
        _required("points", pa.int64()),
        _required("crs", pa.string()),
        _required("transformation", pa.string()),
        pa.field("transformation_accuracy_m", pa.float64()),
    ]
)
_CLASS_COUNT = pa.struct([_required("classification", pa.int32()), _required("points", pa.int64())])

_LIDAR_SCHEMA = pa.schema(
    [
        _required("scan_id", pa.string()),
        _required("write_id", pa.string()),
        _required("points_checksum", pa.string()),
        _required("name", pa.string()),
        _required("status", pa.string()),
        _required("status_reason", pa.string()),
        _required("created_at", pa.timestamp("us", tz="UTC")),
        _required("files", pa.list_(pa.field("element", _SCAN_FILE, nullable=False))),
        _required("epsg", pa.int32()),
        _required("height_datum", pa.string()),
        *(_required(name, pa.float64()) for name in BOUNDS),
        _required("tiles", _STRINGS),
        _required("points", pa.int64()),
        _required("points_in_files", pa.int64()),
        _required("dropped_noise", pa.int64()),
        _required("dropped_withheld", pa.int64()),
        _required("dropped_outliers", pa.int64()),
        _required("level_points", pa.list_(pa.field("element", pa.int64(), nullable=False))),
        _required("spacing_m", pa.float64()),
        _required("classes", pa.list_(pa.field("element", _CLASS_COUNT, nullable=False))),
        _required("colour", pa.string()),
        _required("ortho", pa.string()),
        _required("has_intensity", pa.bool_()),
        pa.field("intensity_low", pa.float64()),
        pa.field("intensity_high", pa.float64()),
        _required("crs_source", pa.string()),
        _required("horizontal_unit", pa.string()),
        _required("vertical_crs", pa.string()),
        _required("height_unit", pa.string()),
        _required("height_unit_m", pa.float64()),
        _required("height_unit_reason", pa.string()),
        _required("notes", _STRINGS),
        _required("options", pa.string()),
        _required("source", pa.string()),
        _required("licence", pa.string()),
    ]
)

_LIDAR_POINTS_SCHEMA = pa.schema(
    [
        _required("write_id", pa.string()),
        *_UTM,
        *(pa.field(name, pa.int16()) for name in ("red", "green", "blue", "intensity")),
        _required("classification", pa.int16()),
        _required("node", pa.int64()),
        _required("node_spacing_m", pa.float32()),
        *_PARTITION,
        _required("level", pa.int32()),
    ]
)

_CANDIDATES_SCHEMA = pa.schema(
    [
        _required("candidate_id", pa.string()),
        _required("write_id", pa.string()),
        _required("event_index", pa.int32()),
        _required("event", pa.string()),
        _required("happened_at", pa.timestamp("us", tz="UTC")),
        pa.field("owner", pa.string()),
        pa.field("licence", pa.string()),
        pa.field("client_id", pa.string()),
        pa.field("sha256", pa.string()),
        pa.field("size_bytes", pa.int64()),
        pa.field("width", pa.int32()),
        pa.field("height", pa.int32()),
        pa.field("snapshot", pa.int64()),
        pa.field("answer_status", pa.string()),
        pa.field("request", pa.string()),
        pa.field("answer", pa.string()),
        pa.field("map_id", pa.string()),
        pa.field("reason_code", pa.string()),
        pa.field("reason", pa.string()),
    ]
)

_CANDIDATE_IMAGES_SCHEMA = pa.schema(
    [
        _required("candidate_id", pa.string()),
        _required("write_id", pa.string()),
        _required("image", pa.binary()),
    ]
)

_CANARIES_SCHEMA = pa.schema(
    [
        _required("canary_id", pa.string()),
        _required("write_id", pa.string()),
        _required("name", pa.string()),
        _required("created_at", pa.timestamp("us", tz="UTC")),
        _required("sha256", pa.string()),
        _required("request", pa.string()),
        _required("expected", pa.string()),
        pa.field("epsg", pa.int32()),
        *(pa.field(name, pa.float64()) for name in ("easting", "northing", "height")),
        pa.field("cam_from_utm_xyzw", _DOUBLES),
        pa.field("height_datum", pa.string()),
        pa.field("tolerance_m", pa.float64()),
        pa.field("tolerance_deg", pa.float64()),
        _required("origin", pa.string()),
        pa.field("snapshot", pa.int64()),
        _required("note", pa.string()),
        _required("image", pa.binary()),
    ]
)

SPECS: dict[str, TableSpec] = {
    MAPS: TableSpec(name=MAPS, schema=_MAPS_SCHEMA, statistics=("map_id", "write_id")),
    IMAGES: TableSpec(
        name=IMAGES,
        schema=_IMAGES_SCHEMA,
        partition_by=("zone", "tile"),
        statistics=("write_id", "image_index"),
    ),
    POINTS: TableSpec(
        name=POINTS,
        schema=_POINTS_SCHEMA,
        partition_by=("zone", "tile"),
        statistics=("write_id", "point_index"),
    ),
    OBSERVATIONS: TableSpec(
        name=OBSERVATIONS,
        schema=_OBSERVATIONS_SCHEMA,
        partition_by=("zone", "tile"),
        statistics=("write_id", "observation_index"),
        plain_bytes=("descriptor",),
    ),
    LIDAR: TableSpec(name=LIDAR, schema=_LIDAR_SCHEMA, statistics=("scan_id", "write_id")),
    LIDAR_POINTS: TableSpec(
        name=LIDAR_POINTS,
        schema=_LIDAR_POINTS_SCHEMA,
        partition_by=("zone", "tile", "level"),
        statistics=("write_id", "easting", "northing"),
    ),
    CANDIDATES: TableSpec(
        name=CANDIDATES, schema=_CANDIDATES_SCHEMA, statistics=("candidate_id", "write_id")
    ),
    CANDIDATE_IMAGES: TableSpec(
        name=CANDIDATE_IMAGES,
        schema=_CANDIDATE_IMAGES_SCHEMA,
        statistics=("candidate_id", "write_id"),
        plain_bytes=("image",),
        row_group_rows=1,  # a photo has megabytes and is read alone
    ),
    CANARIES: TableSpec(
        name=CANARIES,
        schema=_CANARIES_SCHEMA,
        statistics=("canary_id", "write_id"),
        plain_bytes=("image",),
        row_group_rows=1,
    ),
}
