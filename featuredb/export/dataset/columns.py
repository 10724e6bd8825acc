"""The columns of a dataset's tables: type, what they mean. The datasheet prints them.

They are the columns of the store's tables, without what only the store needs (write ids, tiles), with a
geometry and its box, and for images with their poses on Earth. So the way back is the store's own
`decode_map`.
"""

from dataclasses import dataclass

import pyarrow as pa

from featuredb.export.dataset.geoparquet import AREA_BBOX, BBOX, GEOMETRY, POINT_BBOX
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.store import tables as store


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """A table: Arrow schema, a sentence for each column, and columns whose values repeat."""

    schema: pa.Schema
    meaning: dict[str, str]
    repeating: tuple[str, ...]


_STORE_ONLY = (
    *("write_id", "tiles", "zone", "tile", "cameras", "camera_keys"),
    *store.NO_PLACE_COLUMNS,  # a dataset has maps with a place only
)
_TYPES = {
    "red": pa.uint8(),
    "green": pa.uint8(),
    "blue": pa.uint8(),
    "descriptor": pa.binary(DESCRIPTOR_SIZE),
}

_UTM = {
    "easting": "metres, UTM zone of the file",
    "northing": "metres, UTM zone of the file",
    "height": "metres, in the height datum of the file",
}
_GEOMETRY = {
    GEOMETRY: "WKB Point Z: easting, northing, height",
    BBOX: "box around it in plan, single precision rounded outwards, to find rows by",
}

_MAPS_MEANING = {
    "map_id": "names the map everywhere",
    "content_digest": "SHA-256 over everything in the map but its status, by `featuredb.store.encode`",
    "name": "for people",
    "status": "active: answers queries; quarantined: kept aside; retired: out of service",
    "status_reason": "why it has that status, where somebody said so",
    "created_at": "when it was committed to the database that this is from, UTC",
    "epsg": "UTM zone of its points",
    "height_datum": "what its heights are counted from: ellipsoidal, egm96, egm2008, navd88 or unknown",
    "min_easting": "box of its points, metres; null without points",
    "min_northing": "", "min_height": "", "max_easting": "", "max_northing": "", "max_height": "",
    "images": "their number",
    "points": "their number",
    "observations": "their number",
    "descriptors": "observations that have one",
    "method": "what placed it on Earth: gps, lidar, gcp (control points) or map (other maps)",
    "generation": "0 where gps, lidar or gcp placed it; else one more than its parents' largest",
    "parents": "ids of the maps that placed it",
    "residual_rms_m": "what the placement could not explain, root mean square, metres",
    "origin_latitude_deg": "origin of the local frame (east, north, up; metres), WGS84",
    "origin_longitude_deg": "",
    "origin_height_m": "in the map's height datum",
    "local_from_sfm_scale": "the similarity that placed the reconstruction in the local frame",
    "local_from_sfm_rotation": "3 x 3, by rows",
    "local_from_sfm_translation": "metres",
    "placement_covariance": "7 x 7 (log scale, rotation, translation), local frame: shared by the whole map",
    "placement_evidence": "JSON: figures behind the placement",
    "extractor_fingerprint": "of all its descriptors; others cannot be compared with them",
    "source": "where it came from",
    "licence": "of its photos, where a photo has none of its own",
    "provenance": "JSON: options and versions that made it",
    "lineage": "JSON: chain of maps to its nearest anchor, anchors, drift and budget in metres",
    "points_file": "where its points are; null without any",
    "images_file": "where its images are; null without any",
    "observations_file": "where its observations are; null without any",
    GEOMETRY: "hull of its points and cameras in plan, WGS84 longitude and latitude",
    BBOX: "box around the geometry, degrees; from -180 to 180 where it crosses the antimeridian",
}  # fmt: skip

_CAMERAS_MEANING = {
    "map_id": "the map",
    "camera_id": "number in the map, from 0; images name it",
    "model": "COLMAP's name of the lens model",
    "width": "pixels",
    "height": "pixels",
    "params": "COLMAP's parameters of the model, pixels; the top-left pixel's centre is (0.5, 0.5)",
    "key": "EXIF make, model, size and focal length that other photos may share; null: not kept",
}

_IMAGES_MEANING = {
    "map_id": "the map",
    "image_id": "number in the map; observations name it",
    "image_index": "its place in the map's list, from 0",
    "name": "path within the folder that was ingested",
    "sha256": "of the photo's file",
    "camera_id": "number of its camera in cameras.parquet",
    "cam_from_local_rotation": "3 x 3, by rows; camera axes: x right, y down, z forward",
    "cam_from_local_translation": "metres; x_cam = rotation x_local + translation",
    "covariance": "6 x 6 (rotation, translation) of the pose's left perturbation, against the map; or null",
    **_UTM,
    "capture_time": "ISO 8601, as the photo says, with a zone where it says so; or null",
    "gps_latitude_deg": "the photo's own position, WGS84; or null",
    "gps_longitude_deg": "",
    "gps_height_m": "in the photo's own datum",
    "gps_sigma_horizontal_m": "one standard deviation",
    "gps_sigma_vertical_m": "one standard deviation",
    "owner": "who made the photo; may be empty",
    "licence": "of the photo; empty: its map's",
    "cam_from_utm_xyzw": "rotation as a quaternion, UTM grid axes (east, north, up) to camera axes",
    "latitude_deg": "of the camera, WGS84",
    "longitude_deg": "of the camera, WGS84",
    "geopose_xyzw": "OGC GeoPose: rotation of the body (x forward, y left, z up) into true east, north, up",
    "yaw_deg": "OGC GeoPose: 0 looks east, grows towards north",
    "pitch_deg": "OGC GeoPose: positive looks down",
    "roll_deg": "OGC GeoPose: about the viewing direction",
    "earth_covariance": "6 x 6: rotation (rad) about true east, north, up, then position (m) along them; the "
    "pose's own, where it is known, and the placement's",
    **_GEOMETRY,
}

_POINTS_MEANING = {
    "map_id": "the map",
    "point_index": "its place in the map's list, from 0; observations name it",
    **_UTM,
    "red": "0 to 255", "green": "0 to 255", "blue": "0 to 255",
    "track_length": "images that see the point",
    "error_px": "mean reprojection error, pixels of the full size",
    **dict.fromkeys(store.POINT_COVARIANCE, "m^2, local frame, relative to the map"),
    **_GEOMETRY,
}  # fmt: skip

_OBSERVATIONS_MEANING = {
    "map_id": "the map",
    "observation_index": "its place in the map's list, from 0",
    "point_index": "the point in `points` of the same map",
    "image_id": "the image in `images` of the same map",
    "x": "pixels of the full size, the top-left pixel's centre is (0.5, 0.5)",
    "y": "",
    "scale": "of the keypoint, pixels",
    "angle": "of the keypoint, degrees",
    "descriptor": "RootSIFT, 128 bytes; null where the point has enough of them elsewhere",
}


def _columns(table: str | None, meaning: dict[str, str], more: list[pa.Field], *repeating: str) -> Columns:
    """The store's columns of a table, retyped, and more."""
    fields = []
    for field in () if table is None else store.SPECS[table].schema:
        own = table == store.POINTS and field.name in store.OWN_COORDINATES
        if field.name not in _STORE_ONLY and not own:
            nullable = field.nullable and field.name not in store.PLACE_COLUMNS
            fields.append(field.with_type(_TYPES.get(field.name, field.type)).with_nullable(nullable))
    schema = pa.schema([*fields, *more])
    assert schema.names == list(meaning)
    return Columns(schema=schema, meaning=meaning, repeating=repeating)


_POINT_GEOMETRY = [*store.required(pa.binary(), GEOMETRY), *store.required(POINT_BBOX, BBOX)]

MAPS = _columns(
    store.MAPS,
    _MAPS_MEANING,
    [
        *store.required(pa.string(), "lineage"),
        *store.nullable(pa.string(), "points_file", "images_file", "observations_file"),
        *store.required(pa.binary(), GEOMETRY),
        *store.required(AREA_BBOX, BBOX),
    ],
    "status", "height_datum", "method", "extractor_fingerprint", "licence", "points_file", "images_file",
    "observations_file",
)  # fmt: skip
CAMERAS = _columns(
    None,
    _CAMERAS_MEANING,
    [
        *store.required(pa.string(), "map_id"),
        *store.required(pa.int32(), "camera_id"),
        *store.CAMERA,
        *store.nullable(pa.string(), "key"),
    ],
)
IMAGES = _columns(
    store.IMAGES,
    _IMAGES_MEANING,
    [
        *store.required(store.DOUBLES, "cam_from_utm_xyzw"),
        *store.required(pa.float64(), "latitude_deg", "longitude_deg"),
        *store.required(store.DOUBLES, "geopose_xyzw"),
        *store.required(pa.float64(), "yaw_deg", "pitch_deg", "roll_deg"),
        *store.required(store.DOUBLES, "earth_covariance"),
        *_POINT_GEOMETRY,
    ],
    "map_id", "owner", "licence",
)  # fmt: skip
POINTS = _columns(
    store.POINTS, _POINTS_MEANING, _POINT_GEOMETRY, "map_id", "red", "green", "blue", "track_length"
)
OBSERVATIONS = _columns(store.OBSERVATIONS, _OBSERVATIONS_MEANING, [], "map_id", "image_id")
