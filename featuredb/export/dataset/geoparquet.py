"""GeoParquet 1.1: geometries as WKB, their boxes, and the metadata "geo".

https://geoparquet.org/releases/v1.1.0/ is the source of every rule here.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from featuredb.geometry.arrays import FloatArray

VERSION = "1.1.0"
GEOMETRY, BBOX = "geometry", "bbox"
_PLAN = ("xmin", "ymin", "xmax", "ymax")

# ISO WKB: byte order (1: little endian), type, then what the type has.
_POINT_Z = np.dtype([("order", "u1"), ("type", "<u4"), ("xyz", "<f8", 3)])
_POINT, _POLYGON, _MULTI_POLYGON, _WITH_Z = 1, 3, 6, 1000

# Large enough for compression, small enough that a look at one place reads little.
ROW_GROUP_ROWS = 65_536
_COMPRESSION_LEVEL = 3

# Single precision, rounded outwards, finds rows as well as double does, at half the size.
POINT_BBOX = pa.struct([pa.field(name, pa.float32(), nullable=False) for name in _PLAN])
AREA_BBOX = pa.struct([pa.field(name, pa.float64(), nullable=False) for name in _PLAN])


def point_columns(xyz: FloatArray) -> tuple[pa.Array, pa.Array]:
    """Geometry (WKB Point Z) and bbox columns of points.

    Args:
        xyz: (n, 3) float64, kept exactly in the geometry.
    """
    packed = np.empty(len(xyz), _POINT_Z)
    packed["order"], packed["type"], packed["xyz"] = 1, _POINT + _WITH_Z, xyz
    offsets = np.arange(len(xyz) + 1, dtype=np.int32) * _POINT_Z.itemsize
    geometry = pa.Array.from_buffers(
        pa.binary(), len(xyz), [None, pa.py_buffer(offsets), pa.py_buffer(packed)]
    )
    near = xyz[:, :2].astype(np.float32)
    low = np.where(near > xyz[:, :2], np.nextafter(near, np.float32(-np.inf)), near)
    high = np.where(near < xyz[:, :2], np.nextafter(near, np.float32(np.inf)), near)
    columns = [pa.array(np.ascontiguousarray(c)) for c in (low[:, 0], low[:, 1], high[:, 0], high[:, 1])]
    return geometry, pa.StructArray.from_arrays(columns, fields=list(POINT_BBOX))


def wkb_of(geometry: dict[str, Any]) -> bytes:
    """ISO WKB of a GeoJSON Point, Polygon or MultiPolygon in the plane."""
    kind, coordinates = geometry["type"], geometry["coordinates"]
    if kind == "Point":
        return _head(_POINT) + np.asarray(coordinates, "<f8").tobytes()
    if kind == "Polygon":
        return _polygon(coordinates)
    return _head(_MULTI_POLYGON, len(coordinates)) + b"".join(_polygon(rings) for rings in coordinates)


class TableFile:
    """A Parquet file that is written table by table; use it in a `with` block, or close it."""

    def __init__(self, path: Path, schema: pa.Schema, repeating: Sequence[str]) -> None:
        """
        Args:
            repeating: columns whose values repeat, for which a dictionary is worth it.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self.rows = 0
        # Without Arrow's own copy of the schema, in which "geo" would be missing: it is known at the end
        # only.
        self._writer = pq.ParquetWriter(
            path,
            schema,
            compression="zstd",
            compression_level=_COMPRESSION_LEVEL,
            use_dictionary=list(repeating),
            store_schema=False,
        )

    def write(self, table: pa.Table) -> None:
        """Add rows, in row groups of their own."""
        self._writer.write_table(table, row_group_size=ROW_GROUP_ROWS)
        self.rows += len(table)

    def close(self) -> None:
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self.close()


class GeoFile(TableFile):
    """A GeoParquet file whose schema has the columns `geometry` and `bbox`."""

    def __init__(
        self, path: Path, schema: pa.Schema, repeating: Sequence[str], crs: dict[str, Any] | None
    ) -> None:
        """
        Args:
            crs: PROJJSON; None: longitude and latitude, OGC:CRS84.
        """
        super().__init__(path, schema, repeating)
        self._crs = crs
        self._kinds: set[str] = set()
        self._boxes: list[FloatArray] = []

    def covers(self, kinds: Iterable[str], low: FloatArray, high: FloatArray) -> None:
        """Note what is written: GeoParquet's geometry types, corners (2,) or (3,) of the box around it."""
        self._kinds.update(kinds)
        self._boxes.append(np.array([low, high]))

    def close(self) -> None:
        """Write what describes the geometries, and the end of the file."""
        column: dict[str, Any] = {
            "encoding": "WKB",
            "geometry_types": sorted(self._kinds),
            "edges": "planar",
            "covering": {BBOX: {name: [BBOX, name] for name in _PLAN}},
        }
        if self._boxes:
            boxes = np.array(self._boxes)
            column["bbox"] = [*boxes[:, 0].min(axis=0).tolist(), *boxes[:, 1].max(axis=0).tolist()]
        if self._crs is not None:
            column["crs"] = self._crs
        geo = {"version": VERSION, "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
        self._writer.add_key_value_metadata({"geo": json.dumps(geo, sort_keys=True)})
        super().close()


def _polygon(rings: Sequence[Sequence[Sequence[float]]]) -> bytes:
    body = b"".join(
        np.uint32(len(ring)).astype("<u4").tobytes() + np.asarray(ring, "<f8").tobytes() for ring in rings
    )
    return _head(_POLYGON, len(rings)) + body


def _head(kind: int, *count: int) -> bytes:
    return b"\x01" + np.array([kind, *count], "<u4").tobytes()
