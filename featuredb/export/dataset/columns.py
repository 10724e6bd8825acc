"""The columns of a dataset's tables: type, what they mean. The datasheet prints them.

They are the columns of the store's tables, without what only the store needs (write ids, tiles), with a
geometry and its box, and for images with their poses on Earth. So the way back is the store's own
`decode_map`. What the store's columns mean, `schemas/tables` says.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import pyarrow as pa

from featuredb.export.dataset.geoparquet import AREA_BBOX, BBOX, GEOMETRY, POINT_BBOX
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.store import tables as store
from schemas import load_schema


@dataclass(frozen=True, slots=True, kw_only=True)
class Columns:
    """A table.

    Attributes:
        stored: the store's table of whose columns it has some, None for none. more: further columns.
        words: what columns mean that the store does not have, or that mean something else there.
        repeating: columns whose values repeat.
    """

    stored: str | None
    more: tuple[pa.Field, ...]
    words: Mapping[str, str]
    repeating: tuple[str, ...]

    @property
    def schema(self) -> pa.Schema:
        """Arrow schema: the store's columns, retyped, and more."""
        fields = []
        for field in () if self.stored is None else store.SPECS[self.stored].schema:
            own = self.stored == store.POINTS and field.name in store.OWN_COORDINATES
            if field.name not in _STORE_ONLY and not own:
                nullable = field.nullable and field.name not in store.PLACE_COLUMNS
                fields.append(field.with_type(_TYPES.get(field.name, field.type)).with_nullable(nullable))
        return pa.schema([*fields, *self.more])

    def meaning(self) -> dict[str, str]:
        """A sentence for each column."""
        stored = {} if self.stored is None else load_schema(f"tables/{self.stored}")["properties"]
        return {n: self.words[n] if n in self.words else stored[n]["description"] for n in self.schema.names}


_STORE_ONLY = (
    *("write_id", "tiles", "zone", "tile", "cameras", "camera_keys"),
    *store.NO_PLACE_COLUMNS,  # a dataset has maps with a place only
)
_TYPES = {
    **dict.fromkeys(("red", "green", "blue"), pa.uint8()),
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

_MAPS_WORDS = {
    "content_digest": "SHA-256 over everything in the map but its status, by `featuredb.store.encode`",
    "status": "active: answers queries; quarantined: kept aside; retired: out of service",
    "created_at": "when it was committed to the database that this is from, UTC",
    "epsg": "UTM zone of its points and images, 326zz or 327zz",
    "lineage": "JSON: chain of maps to its nearest anchor, anchors, drift and budget in metres",
    "points_file": "where its points are; null without any",
    "images_file": "where its images are; null without any",
    "observations_file": "where its observations are; null without any",
    GEOMETRY: "hull of its points and cameras in plan, WGS84 longitude and latitude",
    BBOX: "box around the geometry, degrees; from -180 to 180 where it crosses the antimeridian",
}

_CAMERAS_WORDS = {
    "map_id": "the map",
    "camera_id": "number in the map, from 0; images name it",
    "model": "COLMAP's name of the lens model",
    "width": "pixels",
    "height": "pixels",
    "params": "COLMAP's parameters of the model, pixels; the top-left pixel's centre is (0.5, 0.5)",
    "key": "EXIF make, model, size and focal length that other photos may share; null: not kept",
}

_IMAGES_WORDS = {
    "camera_id": "number of its camera in cameras.parquet",
    **_UTM,
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

_OBSERVATIONS_WORDS = {
    "descriptor": "128 bytes of RootSIFT, or null where the track is too short to be matched or has enough "
    "of them elsewhere",
}


def _fields(kind: pa.DataType, *names: str, nullable: bool = False) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=nullable) for name in names]


_NUMBERS = pa.list_(pa.field("element", pa.float64(), nullable=False))
_POINT_GEOMETRY = (*_fields(pa.binary(), GEOMETRY), *_fields(POINT_BBOX, BBOX))
_FILES = ("points_file", "images_file", "observations_file")

MAPS = Columns(
    stored=store.MAPS,
    words=_MAPS_WORDS,
    more=(
        *_fields(pa.string(), "lineage"),
        *_fields(pa.string(), *_FILES, nullable=True),
        *_fields(pa.binary(), GEOMETRY),
        *_fields(AREA_BBOX, BBOX),
    ),
    repeating=("status", "height_datum", "method", "extractor_fingerprint", "licence", *_FILES),
)
CAMERAS = Columns(
    stored=None,
    words=_CAMERAS_WORDS,
    more=(
        *_fields(pa.string(), "map_id"),
        *_fields(pa.int32(), "camera_id"),
        *_fields(pa.string(), "model"),
        *_fields(pa.int32(), "width", "height"),
        *_fields(_NUMBERS, "params"),
        *_fields(pa.string(), "key", nullable=True),
    ),
    repeating=(),
)
IMAGES = Columns(
    stored=store.IMAGES,
    words=_IMAGES_WORDS,
    more=(
        *_fields(_NUMBERS, "cam_from_utm_xyzw"),
        *_fields(pa.float64(), "latitude_deg", "longitude_deg"),
        *_fields(_NUMBERS, "geopose_xyzw"),
        *_fields(pa.float64(), "yaw_deg", "pitch_deg", "roll_deg"),
        *_fields(_NUMBERS, "earth_covariance"),
        *_POINT_GEOMETRY,
    ),
    repeating=("map_id", "owner", "licence"),
)
POINTS = Columns(
    stored=store.POINTS,
    words=_UTM | _GEOMETRY,
    more=_POINT_GEOMETRY,
    repeating=("map_id", "red", "green", "blue", "track_length"),
)
OBSERVATIONS = Columns(
    stored=store.OBSERVATIONS,
    words=_OBSERVATIONS_WORDS,
    more=(),
    repeating=("map_id", "image_id"),
)
