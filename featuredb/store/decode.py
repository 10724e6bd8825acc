"""Rows of the tables back to the map that was committed."""

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from featuredb.errors import FeatureDbError, StoreError
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.unplaced_map import AnyMap, NoPlace, OwnFrame, OwnPoints, UnplacedMap
from featuredb.store.encode import Row
from featuredb.store.tables import IMAGES, OBSERVATIONS, OWN_COORDINATES, POINT_COVARIANCE, POINTS


def decode_map(row: Row, children: Mapping[str, Iterable[pa.RecordBatch]]) -> AnyMap:
    """The map of a row of `maps` and the batches of its child rows, in any order.

    Raises:
        StoreError: rows are missing, double or do not fit together.
    """
    try:
        shared: dict[str, Any] = {
            "map_id": row["map_id"],
            "name": row["name"],
            "cameras": tuple(Camera(**{**c, "params": tuple(c["params"])}) for c in row["cameras"]),
            "camera_keys": tuple(row["camera_keys"]),
            "images": _decode_images(children[IMAGES], row["images"]),
            "observations": _decode_observations(children[OBSERVATIONS], row["observations"]),
            "extractor_fingerprint": row["extractor_fingerprint"],
            "status": row["status"],
            "parents": tuple(row["parents"]),
            "source": row["source"],
            "licence": row["licence"],
            "provenance": json.loads(row["provenance"]),
        }
        points = _decode_points(children[POINTS], row["points"], _coordinate_columns(row))
        if not has_place(row):
            return UnplacedMap(
                frame=OwnFrame(metric=row["frame_is_metric"], upright=row["frame_is_upright"]),
                points=OwnPoints(xyz=points.pop("coordinates"), **points),
                no_place=decode_no_place(row),
                **shared,
            )
        return FeatureMap(
            epsg=row["epsg"],
            height_datum=row["height_datum"],
            frame=LocalFrame(
                latitude_deg=row["origin_latitude_deg"],
                longitude_deg=row["origin_longitude_deg"],
                height_m=row["origin_height_m"],
            ),
            points=MapPoints(utm=points.pop("coordinates"), **points),
            placement=_decode_placement(row),
            generation=row["generation"],
            **shared,
        )
    except (FeatureDbError, ValueError, TypeError, KeyError) as error:
        raise StoreError(
            f"map {row['map_id']}: stored rows do not make a map ({error}); run `featuredb verify`"
        ) from error


def has_place(row: Row) -> bool:
    """Whether a row of `maps` is of a map with a place."""
    return row["epsg"] is not None


def decode_no_place(row: Row) -> NoPlace:
    """Why the map of a row without a place has none."""
    said = json.loads(row["no_place"])
    return NoPlace(**{**said, "ways": tuple(said["ways"])})


def _coordinate_columns(row: Row) -> tuple[str, ...]:
    return ("easting", "northing", "height") if has_place(row) else OWN_COORDINATES


def _decode_placement(row: Row) -> Placement:
    return Placement(
        method=row["method"],
        local_from_sfm=Sim3(
            scale=row["local_from_sfm_scale"],
            rotation=np.reshape(row["local_from_sfm_rotation"], (3, 3)),
            translation=np.array(row["local_from_sfm_translation"]),
        ),
        covariance=np.reshape(row["placement_covariance"], (7, 7)),
        residual_rms_m=row["residual_rms_m"],
        evidence=json.loads(row["placement_evidence"]),
    )


def _decode_images(batches: Iterable[pa.RecordBatch], count: int) -> tuple[MapImage, ...]:
    rows = sorted((row for batch in batches for row in batch.to_pylist()), key=lambda r: r["image_index"])
    if [row["image_index"] for row in rows] != list(range(count)):
        raise StoreError(f"images: expected rows 0 to {count - 1}, found {len(rows)} rows")
    return tuple(_decode_image(row) for row in rows)


def _decode_image(row: Row) -> MapImage:
    gps = None
    if row["gps_latitude_deg"] is not None:
        gps = GeoPrior(
            latitude_deg=row["gps_latitude_deg"],
            longitude_deg=row["gps_longitude_deg"],
            height_m=row["gps_height_m"],
            sigma_horizontal_m=row["gps_sigma_horizontal_m"],
            sigma_vertical_m=row["gps_sigma_vertical_m"],
        )
    return MapImage(
        image_id=row["image_id"],
        name=row["name"],
        sha256=row["sha256"],
        camera_id=row["camera_id"],
        cam_from_local=Rigid3(
            rotation=np.reshape(row["cam_from_local_rotation"], (3, 3)),
            translation=np.array(row["cam_from_local_translation"]),
        ),
        covariance=None if row["covariance"] is None else np.reshape(row["covariance"], (6, 6)),
        capture_time=None if row["capture_time"] is None else datetime.fromisoformat(row["capture_time"]),
        gps=gps,
        owner=row["owner"],
        licence=row["licence"],
    )


class _Scatter:
    """Puts the rows of batches at their index; notices missing and double rows."""

    def __init__(self, table: str, index_column: str, count: int) -> None:
        self._table, self._column, self._count = table, index_column, count
        self._seen = np.zeros(count, dtype=np.bool_)
        self._rows = 0

    def index(self, batch: pa.RecordBatch) -> NDArray[np.int64]:
        index: NDArray[np.int64] = batch.column(self._column).to_numpy()
        if len(index) and (index.min() < 0 or index.max() >= self._count):
            raise StoreError(f"{self._table}: {self._column} outside 0..{self._count - 1}")
        self._seen[index] = True
        self._rows += len(index)
        return index

    def check(self) -> None:
        if self._rows != self._count or not self._seen.all():
            raise StoreError(
                f"{self._table}: expected {self._count} rows, found {self._rows} of which "
                f"{int(self._seen.sum())} different ones"
            )


def _decode_points(
    batches: Iterable[pa.RecordBatch], count: int, coordinate_columns: Sequence[str]
) -> dict[str, Any]:
    """Arrays of PointColumns by name, and `coordinates` (count, 3)."""
    coordinates: FloatArray = np.empty((count, 3))
    rgb, track = np.empty((count, 3), np.uint8), np.empty(count, np.int32)
    error, covariance = np.empty(count, np.float32), np.empty((count, 6), np.float32)
    scatter = _Scatter(POINTS, "point_index", count)
    for batch in batches:
        index = scatter.index(batch)
        for axis, name in enumerate(coordinate_columns):
            coordinates[index, axis] = batch.column(name).to_numpy()
        for axis, name in enumerate(("red", "green", "blue")):
            rgb[index, axis] = batch.column(name).to_numpy()
        for axis, name in enumerate(POINT_COVARIANCE):
            covariance[index, axis] = batch.column(name).to_numpy()
        track[index] = batch.column("track_length").to_numpy()
        error[index] = batch.column("error_px").to_numpy()
    scatter.check()
    return {
        "coordinates": coordinates,
        "rgb": rgb,
        "track_length": track,
        "error_px": error,
        "covariance": covariance,
    }


def _decode_observations(batches: Iterable[pa.RecordBatch], count: int) -> MapObservations:
    columns: dict[str, NDArray[Any]] = {
        "point_index": np.empty(count, np.int64),
        "image_id": np.empty(count, np.int32),
        "scale": np.empty(count, np.float32),
        "angle": np.empty(count, np.float32),
    }
    xy, has = np.empty((count, 2), np.float32), np.zeros(count, np.bool_)
    descriptors = np.zeros((count, DESCRIPTOR_SIZE), np.uint8)
    scatter = _Scatter(OBSERVATIONS, "observation_index", count)
    for batch in batches:
        index = scatter.index(batch)
        for name, column in columns.items():
            column[index] = batch.column(name).to_numpy()
        xy[index, 0], xy[index, 1] = batch.column("x").to_numpy(), batch.column("y").to_numpy()
        valid, packed = _unpack_descriptors(batch.column("descriptor"))
        has[index[valid]] = True
        descriptors[index[valid]] = packed
    scatter.check()
    return MapObservations(xy=xy, has_descriptor=has, descriptors=descriptors, **columns)


def _unpack_descriptors(column: pa.Array) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Which rows have a descriptor, and those descriptors (k, 128)."""
    valid = column.is_valid().to_numpy(zero_copy_only=False)
    packed = np.frombuffer(b"".join(column.drop_null().to_pylist()), np.uint8)
    if packed.size != valid.sum() * DESCRIPTOR_SIZE:
        raise StoreError(f"observations: a descriptor is not of {DESCRIPTOR_SIZE} bytes")
    return valid, packed.reshape(-1, DESCRIPTOR_SIZE)
