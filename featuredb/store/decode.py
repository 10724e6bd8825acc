"""Rows of the tables read, and back to the map that was committed."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import DTypeLike, NDArray

from featuredb.errors import FeatureDbError, SnapshotNotFoundError, StoreError
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, GeoPrior, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.unplaced_map import AnyMap, NoPlace, OwnFrame, OwnPoints, UnplacedMap
from featuredb.store import tables
from featuredb.store.delta import Condition, Table
from featuredb.store.durable.filesystem import read_errors
from featuredb.store.encode import AS_IN_MAP, Row

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Value = TypeVar("Value", bound="DataclassInstance")


def read_rows(
    table: Table, columns: Sequence[str] | None = None, where: Sequence[Condition] = ()
) -> list[Row]:
    """Rows of a version of a table, times in UTC; what an older format does not have is None.

    Raises:
        SnapshotNotFoundError: files of an earlier version are gone.
        StoreError: they cannot be read, or rows lack what no row lacks.
    """
    spec = table.spec
    try:
        with read_errors(f"cannot read the table {spec.name}"):
            found = table.dataset(where).to_table(columns and list(columns))
    except StoreError as error:
        if spec.name == tables.MAPS and isinstance(error.__cause__, FileNotFoundError):
            raise SnapshotNotFoundError(
                f"version {table.version} is gone, vacuum removed its files ({error.__cause__}); "
                "choose a newer one"
            ) from error
        raise
    for field in spec.schema:
        if field.name not in found.column_names:
            if columns is None:
                found = found.append_column(field.name, pa.nulls(len(found), field.type))
        elif not field.nullable and found[field.name].null_count:
            raise StoreError(
                f"the table {spec.name} is damaged: rows without {field.name}; run `featuredb verify`"
            )
    times = [field.name for field in found.schema if pa.types.is_timestamp(field.type)]
    rows = plain_times(found).to_pylist()
    return [{**row, **{name: row[name].replace(tzinfo=UTC) for name in times}} for row in rows]


def plain_times(rows: pa.Table) -> pa.Table:
    """Times of UTC without their zone, which Arrow and DuckDB look up and small machines do not have."""
    for index, field in enumerate(rows.schema):
        if pa.types.is_timestamp(field.type):
            rows = rows.set_column(index, field.name, rows[field.name].cast(pa.timestamp("us")))
    return rows


def read_image(table: Table, column: str, value: str, whose: str) -> bytes | None:
    """The photo in the row with this value of a column; None where there is no such row.

    Args:
        whose: what the photo is of, in words.

    Raises:
        StoreError: it cannot be read.
    """
    with read_errors(f"{whose}: cannot read its image"):
        found = table.dataset([(column, "=", value)]).to_table(["image"], use_threads=False)["image"]
    return found[0].as_py() if len(found) else None


def decode_map(row: Row, children: Mapping[str, Iterable[pa.RecordBatch]]) -> AnyMap:
    """The map of a row of `maps` and the batches of its child rows, in any order.

    Raises:
        StoreError: rows are missing, double or do not fit together.
    """
    try:
        shared: dict[str, Any] = {
            **{name: row[name] for name in AS_IN_MAP},
            "cameras": tuple(Camera(**{**c, "params": tuple(c["params"])}) for c in row["cameras"]),
            "camera_keys": tuple(row["camera_keys"]),
            "images": decode_images(children[tables.IMAGES], row["images"]),
            "observations": _decode_observations(children[tables.OBSERVATIONS], row["observations"]),
            "parents": tuple(row["parents"]),
            "provenance": json.loads(row["provenance"]),
        }
        here = tables.UTM_COORDINATES if has_place(row) else tables.OWN_COORDINATES
        points = _decode_points(children[tables.POINTS], row["points"], here)
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
            frame=frame_of(row),
            points=MapPoints(utm=points.pop("coordinates"), **points),
            placement=placement_of(row),
            generation=row["generation"],
            **shared,
        )
    except (FeatureDbError, ValueError, TypeError, KeyError) as error:
        raise StoreError(
            f"map {row['map_id']}: stored rows do not make a map ({error}); run `featuredb verify`"
        ) from error


def of_columns(kind: type[Value], values: Mapping[str, Any], prefix: str = "") -> Value:
    """A dataclass of the columns that are called like its fields, after a prefix."""
    return kind(**{field.name: values[prefix + field.name] for field in fields(kind)})


def frame_of(row: Row) -> LocalFrame:
    """Of a map with a place."""
    return of_columns(LocalFrame, row, "origin_")


def has_place(row: Row) -> bool:
    """Whether a row of `maps` is of a map with a place."""
    return row["epsg"] is not None


def decode_no_place(row: Row) -> NoPlace:
    """Why the map of a row without a place has none."""
    said = json.loads(row["no_place"])
    return NoPlace(**{**said, "ways": tuple(said["ways"])})


def placement_of(row: Row) -> Placement:
    """Of a map with a place."""
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


def decode_images(batches: Iterable[pa.RecordBatch], count: int) -> tuple[MapImage, ...]:
    """Images of the rows of a map, which has so many.

    Raises:
        StoreError: rows are missing or double.
    """
    rows = sorted((row for batch in batches for row in batch.to_pylist()), key=lambda r: r["image_index"])
    if [row["image_index"] for row in rows] != list(range(count)):
        raise StoreError(f"images: expected rows 0 to {count - 1}, found {len(rows)} rows")
    return tuple(_decode_image(row) for row in rows)


def _decode_image(row: Row) -> MapImage:
    return MapImage(
        **{name: row[name] for name in ("image_id", "name", "sha256", "camera_id", "owner", "licence")},
        cam_from_local=Rigid3(
            rotation=np.reshape(row["cam_from_local_rotation"], (3, 3)),
            translation=np.array(row["cam_from_local_translation"]),
        ),
        covariance=None if row["covariance"] is None else np.reshape(row["covariance"], (6, 6)),
        capture_time=None if row["capture_time"] is None else datetime.fromisoformat(row["capture_time"]),
        gps=None if row["gps_latitude_deg"] is None else of_columns(GeoPrior, row, "gps_"),
    )


def _gathered(
    batches: Iterable[pa.RecordBatch], name: str, index_column: str, count: int
) -> tuple[pa.Table, NDArray[np.int64]]:
    """The rows of a child table, and the index (count,) of each."""
    parts = list(batches)
    table = pa.Table.from_batches(parts) if parts else tables.SPECS[name].schema.empty_table()
    index: NDArray[np.int64] = table[index_column].to_numpy()
    if len(table) != count or not np.array_equal(np.sort(index), np.arange(count)):
        raise StoreError(
            f"{name}: expected {count} rows, {index_column} being each of 0 to {count - 1}, found "
            f"{len(table)} of which {len(np.unique(index))} are different"
        )
    return table, index


def _placed(
    table: pa.Table, index: NDArray[np.int64], names: Sequence[str], dtype: DTypeLike
) -> NDArray[Any]:
    """Columns of numbers (n, len(names)), each row at its index."""
    placed = np.empty((len(table), len(names)), dtype)
    for axis, name in enumerate(names):
        placed[index, axis] = table[name].to_numpy()
    return placed


def _decode_points(
    batches: Iterable[pa.RecordBatch], count: int, coordinate_columns: Sequence[str]
) -> dict[str, Any]:
    """Arrays of PointColumns by name, and `coordinates` (count, 3)."""
    table, index = _gathered(batches, tables.POINTS, "point_index", count)
    return {
        "coordinates": _placed(table, index, coordinate_columns, np.float64),
        "rgb": _placed(table, index, ("red", "green", "blue"), np.uint8),
        "track_length": _placed(table, index, ["track_length"], np.int32)[:, 0],
        "error_px": _placed(table, index, ["error_px"], np.float32)[:, 0],
        "covariance": _placed(table, index, tables.POINT_COVARIANCE, np.float32),
    }


def _decode_observations(batches: Iterable[pa.RecordBatch], count: int) -> MapObservations:
    table, index = _gathered(batches, tables.OBSERVATIONS, "observation_index", count)
    has, descriptors = np.zeros(count, np.bool_), np.zeros((count, DESCRIPTOR_SIZE), np.uint8)
    start = 0
    for chunk in table["descriptor"].chunks:
        valid, packed = _unpack_descriptors(chunk)
        rows = index[start : start + len(chunk)][valid]
        has[rows], descriptors[rows] = True, packed
        start += len(chunk)
    return MapObservations(
        point_index=_placed(table, index, ["point_index"], np.int64)[:, 0],
        image_id=_placed(table, index, ["image_id"], np.int32)[:, 0],
        xy=_placed(table, index, ("x", "y"), np.float32),
        scale=_placed(table, index, ["scale"], np.float32)[:, 0],
        angle=_placed(table, index, ["angle"], np.float32)[:, 0],
        has_descriptor=has,
        descriptors=descriptors,
    )


def _unpack_descriptors(column: pa.Array) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Which rows have a descriptor, and those descriptors (k, 128)."""
    valid = column.is_valid().to_numpy(zero_copy_only=False)
    packed = np.frombuffer(b"".join(column.drop_null().to_pylist()), np.uint8)
    if packed.size != valid.sum() * DESCRIPTOR_SIZE:
        raise StoreError(f"observations: a descriptor is not of {DESCRIPTOR_SIZE} bytes")
    return valid, packed.reshape(-1, DESCRIPTOR_SIZE)
