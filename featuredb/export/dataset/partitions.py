"""The files that hold the rows of all maps: by zone and height datum, cut before they grow too large.

Those of maps without a place are in a folder of their own, as the store has them.
"""

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from featuredb.export.dataset import columns
from featuredb.export.dataset.geoparquet import GeoFile, TableFile, point_columns
from featuredb.export.dataset.layout import IMAGES, OBSERVATIONS, POINTS, Partition, own_path
from featuredb.export.shots import pose_covariance
from featuredb.geo.crs.wkt import utm_projjson
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import tables as store
from featuredb.store.encode import EncodedMap, encode_map, rows_table
from featuredb.store.snapshot import MapSummary, UnplacedSummary

COLUMNS = {POINTS: columns.POINTS, IMAGES: columns.IMAGES, OBSERVATIONS: columns.OBSERVATIONS}

# A map after which a file has more begins the next one. Half a gigabyte of observations: few files, and none
# that a viewer or an upload chokes on.
LARGEST_ROWS = 4_000_000


class PartitionFiles(AbstractContextManager["PartitionFiles"]):
    """Writes maps one after the other; use it in a `with` block.

    A file holds maps of one zone and height datum. A map is in one file of each table, and a row group has
    rows of one map only, so that reading a map reads nothing else.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: dict[tuple[str, Partition], TableFile] = {}
        self._number: dict[tuple[str, Partition], int] = {}

    def write(self, feature_map: FeatureMap, encoded: EncodedMap) -> dict[str, str | None]:
        """Add a map's rows; the path in the folder of each table's file, None for a table without rows."""
        partition = Partition(feature_map.epsg, feature_map.height_datum)
        files: dict[str, str | None] = {}
        for table in COLUMNS:
            stored = encoded.children[table]
            files[table] = self._append(table, partition, feature_map, stored) if len(stored) else None
        return files

    def _append(self, table: str, partition: Partition, feature_map: FeatureMap, stored: pa.Table) -> str:
        key = (table, partition)
        file = self._open.get(key)
        if file is not None and file.rows >= LARGEST_ROWS:
            file.close()
            file = None
        if file is None:
            number = self._number[key] = self._number.get(key, -1) + 1
            file = self._open[key] = self._begin(table, partition, number)
        more: dict[str, pa.Array] = {}
        if isinstance(file, GeoFile):
            utm = np.stack([stored[name].to_numpy() for name in ("easting", "northing", "height")], axis=1)
            more["geometry"], more["bbox"] = point_columns(utm)
            file.covers(["Point Z"], utm.min(axis=0), utm.max(axis=0))
        if table == IMAGES:
            more |= _on_earth(feature_map)
        schema = COLUMNS[table].schema
        arrays = [more[f.name] if f.name in more else stored[f.name].cast(f.type) for f in schema]
        file.write(pa.Table.from_arrays(arrays, schema=schema))
        return partition.file(table, self._number[key])

    def _begin(self, table: str, partition: Partition, number: int) -> TableFile:
        path, what = self._folder / partition.file(table, number), COLUMNS[table]
        if table == OBSERVATIONS:
            return TableFile(path, what.schema, what.repeating)
        crs = utm_projjson(partition.epsg, partition.height_datum)
        return GeoFile(path, what.schema, what.repeating, crs)

    def __exit__(self, *failed: object) -> None:
        for file in self._open.values():
            file.close()


class OwnFrameFiles(AbstractContextManager["OwnFrameFiles"]):
    """Writes maps without a place one after the other; use it in a `with` block. No map, no folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: dict[str, TableFile] = {}
        self.rows: list[dict[str, Any]] = []

    def add(self, unplaced: UnplacedMap, summary: MapSummary | UnplacedSummary) -> None:
        """A map; a row group has rows of one map only."""
        encoded = encode_map(unplaced, "", summary.created_at)
        row = encoded.row | {"status_reason": summary.status_reason}
        self.rows.append(row)
        tables = {store.MAPS: rows_table(store.MAPS, [row]), **encoded.children}
        for table, rows in tables.items():
            if table not in self._open:
                path = self._folder / own_path(table)
                self._open[table] = TableFile(path, store.SPECS[table].schema, ("map_id",))
            if len(rows):
                self._open[table].write(rows.cast(store.SPECS[table].schema))

    def __exit__(self, *failed: object) -> None:
        for file in self._open.values():
            file.close()


def _on_earth(feature_map: FeatureMap) -> dict[str, pa.Array]:
    found = [_image_on_earth(feature_map, image) for image in feature_map.images]
    schema = columns.IMAGES.schema
    return {name: pa.array([row[name] for row in found], type=schema.field(name).type) for name in found[0]}


def _image_on_earth(feature_map: FeatureMap, image: MapImage) -> dict[str, Any]:
    """Columns of the table `images` that follow from a pose and its map's frame.

    GeoPose's height is that of the local frame: in the map's datum, which stands beside it. Yaw, pitch and
    roll are GeoPose's (body axes x forward, y left, z up; yaw 0 looks east, a positive pitch looks down).
    """
    pose, frame = image.cam_from_local, feature_map.frame
    grid_from_local = frame.grid_from_enu(pose.center, feature_map.epsg)
    geopose = geopose_from_camera(pose, frame)
    yaw, pitch, roll = geopose.yaw_pitch_roll_deg
    return {
        "cam_from_utm_xyzw": [float(q) for q in quaternion_from_matrix(pose.rotation @ grid_from_local.T)],
        "latitude_deg": geopose.latitude_deg,
        "longitude_deg": geopose.longitude_deg,
        "geopose_xyzw": list(geopose.quaternion_xyzw),
        "yaw_deg": yaw,
        "pitch_deg": pitch,
        "roll_deg": roll,
        "earth_covariance": pose_covariance(feature_map, image).ravel().tolist(),
    }
