"""A map as rows of the tables, without loss: float64 stays float64, order stays order."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geo.tiles import tile_of
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapImage, MapObservations
from featuredb.maps.unplaced_map import AnyMap, UnplacedMap
from featuredb.store import tables

Row = dict[str, Any]
AS_IN_MAP = ("map_id", "name", "status", "extractor_fingerprint", "source", "licence")


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedMap:
    """A map as rows: one of `maps`, and an Arrow table for each child table."""

    row: Row
    children: dict[str, pa.Table]


def encode_map(feature_map: AnyMap, write_id: str, created_at: datetime) -> EncodedMap:
    """The rows of a map under the given write id.

    Raises:
        InvalidValueError: provenance or evidence that JSON cannot hold.
    """
    zone, point_tiles, camera_utm, camera_tiles = _where(feature_map)
    ids = {"write_id": write_id, "map_id": feature_map.map_id, "zone": zone}
    children = {
        tables.IMAGES: _image_rows(feature_map, ids, camera_utm, camera_tiles),
        tables.POINTS: _point_rows(feature_map, ids, point_tiles),
        tables.OBSERVATIONS: _observation_rows(feature_map, ids, point_tiles),
    }
    found = {tile for table in children.values() for tile in table["tile"].unique().to_pylist()}
    tiles = sorted(found - {tables.NO_TILE})
    return EncodedMap(row=_map_row(feature_map, write_id, created_at, tiles), children=children)


def content_digest(feature_map: AnyMap) -> str:
    """SHA-256 over everything in the map but its status: equal digests are equal maps."""
    digest = hashlib.sha256()
    row = _map_row(feature_map, "", datetime.fromtimestamp(0, tz=UTC), [], digest="")
    # A placed map has the digest that format 1 gave it.
    new = tables.NO_PLACE_COLUMNS if isinstance(feature_map, FeatureMap) else ()
    for name in ("status", "status_reason", *new):
        row.pop(name)
    row["created_at"] = ""
    digest.update(json.dumps(row, sort_keys=True).encode())
    digest.update(json.dumps([_image_row(image) for image in feature_map.images]).encode())
    points, seen = feature_map.points, feature_map.observations
    for array in (
        _coordinates(feature_map), points.rgb, points.track_length, points.error_px, points.covariance,
        seen.point_index, seen.image_id, seen.xy, seen.scale, seen.angle, seen.has_descriptor,
        np.where(seen.has_descriptor[:, None], seen.descriptors, np.uint8(0)),
    ):  # fmt: skip
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _coordinates(feature_map: AnyMap) -> FloatArray:
    """(n, 3): UTM of a map with a place, those of the own frame of one without."""
    return feature_map.points.xyz if isinstance(feature_map, UnplacedMap) else feature_map.points.utm


def _where(feature_map: AnyMap) -> tuple[int, NDArray[Any], FloatArray, NDArray[Any]]:
    """Zone, tiles of points (n,), UTM of cameras (i, 3), NaN without a place, and their tiles (i,)."""
    images = len(feature_map.images)
    if isinstance(feature_map, UnplacedMap):
        tiles, nowhere = (
            np.full(len(feature_map.points), tables.NO_TILE, object),
            np.full((images, 3), np.nan),
        )
        return tables.NO_ZONE, tiles, nowhere, np.full(images, tables.NO_TILE, object)
    centers = np.array([i.cam_from_local.center for i in feature_map.images], dtype=np.float64).reshape(-1, 3)
    utm = feature_map.frame.utm_from_enu(centers, feature_map.epsg)
    return feature_map.epsg, np.asarray(tile_of(feature_map.points.utm), dtype=object), utm, tile_of(utm)


def _place_columns(feature_map: AnyMap) -> Row:
    """Where the map lies, or why nobody knows."""
    if isinstance(feature_map, UnplacedMap):
        no_place = dataclasses.asdict(feature_map.no_place)
        return {
            **dict.fromkeys((*tables.PLACE_COLUMNS, *tables.BOUNDS)),
            "generation": 0,
            "frame_is_metric": feature_map.frame.metric,
            "frame_is_upright": feature_map.frame.upright,
            "no_place": _json(feature_map, "no_place", no_place),
        }
    utm, placement, frame = feature_map.points.utm, feature_map.placement, feature_map.frame
    bounds = [*utm.min(axis=0).tolist(), *utm.max(axis=0).tolist()] if len(utm) else [None] * 6
    return {
        **dict.fromkeys(tables.NO_PLACE_COLUMNS),
        "epsg": feature_map.epsg,
        "height_datum": feature_map.height_datum,
        **dict(zip(tables.BOUNDS, bounds, strict=True)),
        "method": placement.method,
        "generation": feature_map.generation,
        "residual_rms_m": float(placement.residual_rms_m),
        **{f"origin_{field.name}": getattr(frame, field.name) for field in dataclasses.fields(frame)},
        "local_from_sfm_scale": placement.local_from_sfm.scale,
        "local_from_sfm_rotation": placement.local_from_sfm.rotation.ravel().tolist(),
        "local_from_sfm_translation": placement.local_from_sfm.translation.tolist(),
        "placement_covariance": placement.covariance.ravel().tolist(),
        "placement_evidence": _json(feature_map, "placement.evidence", placement.evidence),
    }


def _map_row(
    feature_map: AnyMap, write_id: str, created_at: datetime, tiles: list[str], digest: str | None = None
) -> Row:
    return {
        **{name: getattr(feature_map, name) for name in AS_IN_MAP},
        "write_id": write_id,
        "content_digest": content_digest(feature_map) if digest is None else digest,
        "status_reason": "",
        "created_at": created_at,
        **_place_columns(feature_map),
        "tiles": tiles,
        "images": len(feature_map.images),
        "points": len(feature_map.points),
        "observations": len(feature_map.observations),
        "descriptors": int(feature_map.observations.has_descriptor.sum()),
        "parents": list(feature_map.parents),
        "camera_keys": list(feature_map.camera_keys),
        "cameras": [
            {"model": c.model, "width": c.width, "height": c.height, "params": list(c.params)}
            for c in feature_map.cameras
        ],
        "provenance": _json(feature_map, "provenance", feature_map.provenance),
    }


def _json(feature_map: AnyMap, field: str, value: dict[str, Any]) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(
            f"{type(feature_map).__name__} {feature_map.map_id}.{field}: expected values that JSON can hold: "
            f"{error}"
        ) from error


def _image_row(image: MapImage) -> Row:
    gps = {f"gps_{f.name}": image.gps and getattr(image.gps, f.name) for f in dataclasses.fields(GeoPrior)}
    return {
        "image_id": image.image_id,
        "name": image.name,
        "sha256": image.sha256,
        "camera_id": image.camera_id,
        "cam_from_local_rotation": image.cam_from_local.rotation.ravel().tolist(),
        "cam_from_local_translation": image.cam_from_local.translation.tolist(),
        "covariance": None if image.covariance is None else image.covariance.ravel().tolist(),
        "capture_time": None if image.capture_time is None else image.capture_time.isoformat(),
        **gps,
        "owner": image.owner,
        "licence": image.licence,
    }


def _image_rows(feature_map: AnyMap, ids: Row, utm: FloatArray, tiles: NDArray[Any]) -> pa.Table:
    placed = zip(feature_map.images, utm.tolist(), tiles.tolist(), strict=True)
    rows = [
        {
            **ids,
            **_image_row(image),
            "image_index": index,
            **dict(zip(tables.UTM_COORDINATES, place, strict=True)),
            "tile": tile,
        }
        for index, (image, place, tile) in enumerate(placed)
    ]
    return rows_table(tables.IMAGES, rows)


def _point_rows(feature_map: AnyMap, ids: Row, tiles: NDArray[Any]) -> pa.Table:
    points = feature_map.points
    columns: dict[str, Any] = {
        "point_index": np.arange(len(points), dtype=np.int64),
        "track_length": points.track_length,
        "error_px": points.error_px,
        "tile": tiles,
    }
    here = tables.UTM_COORDINATES
    if isinstance(feature_map, UnplacedMap):
        here = tables.OWN_COORDINATES
        columns |= {name: np.full(len(points), np.nan) for name in tables.UTM_COORDINATES}
    columns |= dict(zip(here, _coordinates(feature_map).T, strict=True))
    for axis, name in enumerate(("red", "green", "blue")):
        columns[name] = points.rgb[:, axis].astype(np.int16)
    for axis, name in enumerate(tables.POINT_COVARIANCE):
        columns[name] = points.covariance[:, axis]
    return table_of(tables.POINTS, ids, columns, len(points))


def _observation_rows(feature_map: AnyMap, ids: Row, point_tiles: NDArray[Any]) -> pa.Table:
    seen = feature_map.observations
    columns = {
        "observation_index": np.arange(len(seen), dtype=np.int64),
        "point_index": seen.point_index,
        "image_id": seen.image_id,
        "x": seen.xy[:, 0],
        "y": seen.xy[:, 1],
        "scale": seen.scale,
        "angle": seen.angle,
        "descriptor": _descriptor_column(seen),
        # An observation lies with its point, so that a tile's points come with all their descriptors.
        "tile": point_tiles[seen.point_index],
    }
    return table_of(tables.OBSERVATIONS, ids, columns, len(seen))


def table_of(name: str, constants: Row, columns: dict[str, Any], count: int) -> pa.Table:
    """`count` rows in the order and types of a table's schema: values that all share, columns, else null."""
    arrays = []
    for field in tables.SPECS[name].schema:
        if field.name in constants:
            arrays.append(pa.repeat(pa.scalar(constants[field.name], type=field.type), count))
        elif field.name in columns:
            arrays.append(pa.array(columns[field.name], type=field.type))
        else:
            arrays.append(pa.nulls(count, type=field.type))
    return pa.Table.from_arrays(arrays, schema=tables.SPECS[name].schema)


def _descriptor_column(seen: MapObservations) -> pa.Array:
    """Binary column; null where there is no descriptor."""
    packed = np.ascontiguousarray(seen.descriptors)
    mask = pa.array(~seen.has_descriptor)
    fixed = pa.FixedSizeBinaryArray.from_buffers(
        pa.binary(DESCRIPTOR_SIZE), len(seen), [None, pa.py_buffer(packed)]
    )
    return pc.if_else(mask, pa.scalar(None, type=fixed.type), fixed).cast(pa.binary())


def rows_table(name: str, rows: Sequence[Row]) -> pa.Table:
    """Rows of a table as an Arrow table."""
    return pa.Table.from_pylist(list(rows), schema=tables.SPECS[name].schema)
