"""The maps of a dataset, exactly as they were exported."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from featuredb.errors import ExportError, FeatureDbError
from featuredb.export.dataset import layout
from featuredb.export.dataset.columns import CAMERAS, MAPS
from featuredb.export.dataset.layout import check_sums
from featuredb.export.dataset.partitions import COLUMNS
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import MapKind, UnplacedMap
from featuredb.store import tables as store
from featuredb.store.decode import decode_map
from featuredb.store.encode import content_digest

Row = dict[str, Any]


def read_dataset(folder: Path) -> Iterator[FeatureMap]:
    """The maps of a dataset, in the order of its `maps.parquet`, one in memory at a time.

    Every file is compared with SHA256SUMS before the first map comes, and every map with its own digest.

    Raises:
        ExportError: not a dataset, of an unknown version, damaged, or with contents that contradict each
        other.
    """
    rows, listed = open_dataset(folder)
    return (load_map(folder, row, listed) for row in rows)


def open_dataset(folder: Path) -> tuple[list[Row], frozenset[str]]:
    """What is known of the maps, by the store's columns, and the files that SHA256SUMS vouches for.

    Raises:
        ExportError: as `read_dataset`.
    """
    listed = check_sums(folder)
    for name in (layout.DESCRIPTION, layout.MAPS, layout.CAMERAS):
        check_listed(name, listed, folder)
    layout.read_description(folder)
    wanted = [name for name in MAPS.schema.names if name not in ("created_at", "geometry", "bbox")]
    rows = read_table(folder / layout.MAPS, wanted).to_pylist()
    cameras: dict[str, list[Row]] = defaultdict(list)
    for camera in read_table(folder / layout.CAMERAS, CAMERAS.schema.names).to_pylist():
        cameras[camera["map_id"]].append(camera)
    for row in rows:
        own = sorted(cameras[row["map_id"]], key=lambda camera: int(camera["camera_id"]))
        row["cameras"] = [{name: c[name] for name in ("model", "width", "height", "params")} for c in own]
        row["camera_keys"] = [c["key"] for c in own if c["key"] is not None]
    return rows, listed


def load_map(folder: Path, row: Row, listed: frozenset[str]) -> FeatureMap:
    """One map.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    return decoded(
        folder, row, lambda: {table: _rows_of(folder, table, row, listed) for table in COLUMNS}, FeatureMap
    )


def decoded(
    folder: Path, row: Row, children: Callable[[], dict[str, list[pa.RecordBatch]]], kind: type[MapKind]
) -> MapKind:
    """The map of a row and of the rows of its tables.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    map_id = row["map_id"]
    try:
        found = decode_map(row, children())
    except FeatureDbError as error:
        raise ExportError(f"{folder}, map {map_id}: its files do not make a map ({error})") from error
    if not isinstance(found, kind) or content_digest(found) != row["content_digest"]:
        raise ExportError(
            f"{folder}, map {map_id}: the files hold another map than the one that was exported "
            f"(its digest was {row['content_digest']}); get the dataset once more from its source"
        )
    return found


def _rows_of(
    folder: Path, table: str, row: Mapping[str, Any], listed: frozenset[str]
) -> list[pa.RecordBatch]:
    name = row[f"{table}_file"]
    if name is None:
        return []
    check_listed(name, listed, folder)
    wanted = [column for column in COLUMNS[table].schema.names if column not in ("geometry", "bbox")]
    only = ds.field("map_id") == row["map_id"]
    return list(read_table(folder / name, wanted, only).to_batches())


def read_table(path: Path, columns: list[str] | None = None, only: ds.Expression | None = None) -> pa.Table:
    """Columns (None: all) of the rows of a table that fit.

    Raises:
        ExportError: it cannot be read.
    """
    try:
        return pq.read_table(path, columns=columns, filters=only, use_threads=False, partitioning=None)
    except (OSError, pa.ArrowException, KeyError) as error:
        raise ExportError(f"{path}: expected a table of a dataset, cannot read it ({error})") from error


def check_listed(name: str, listed: frozenset[str], folder: Path) -> None:
    """Raise ExportError for a file that SHA256SUMS does not vouch for."""
    if name not in listed:
        raise ExportError(
            f"{folder}: SHA256SUMS does not list {name}, which is part of a dataset; copy it again"
        )


def own_rows(folder: Path, listed: frozenset[str]) -> list[Row]:
    """What is known of the maps without a place, by the store's columns; none where the dataset has none.

    Args:
        listed: files that SHA256SUMS vouches for.

    Raises:
        ExportError: the table cannot be read.
    """
    if layout.own_path(store.MAPS) not in listed:
        return []
    return list(read_table(folder / layout.own_path(store.MAPS)).to_pylist())


def load_own(folder: Path, row: Mapping[str, Any], listed: frozenset[str]) -> UnplacedMap:
    """One map without a place.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    for table in store.CHILD_TABLES:
        check_listed(layout.own_path(table), listed, folder)
    only = ds.field("map_id") == row["map_id"]
    return decoded(
        folder,
        dict(row),
        lambda: {
            t: read_table(folder / layout.own_path(t), only=only).to_batches() for t in store.CHILD_TABLES
        },
        UnplacedMap,
    )
