"""Maps without a place in a dataset: rows as the store has them, in a folder of their own.

They have no coordinates on Earth, so neither GeoParquet nor the catalogue has room for them.
"""

from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pyarrow.dataset as ds

from featuredb.export.dataset.geoparquet import TableFile
from featuredb.export.dataset.read import check_listed, decoded, read_table
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store.encode import encode_map, rows_table
from featuredb.store.snapshot import MapSummary, UnplacedSummary
from featuredb.store.tables import CHILD_TABLES, MAPS, SPECS

FOLDER = "own_frame"


def table_path(table: str) -> str:
    """Where a table's rows are in the dataset."""
    return f"{FOLDER}/{table}.parquet"


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
        tables = {MAPS: rows_table(MAPS, [row]), **encoded.children}
        for table, rows in tables.items():
            if table not in self._open:
                path = self._folder / table_path(table)
                self._open[table] = TableFile(path, SPECS[table].schema, ("map_id",))
            if len(rows):
                self._open[table].write(rows.cast(SPECS[table].schema))

    def __exit__(self, *failed: object) -> None:
        for file in self._open.values():
            file.close()


def own_rows(folder: Path, listed: frozenset[str]) -> list[dict[str, Any]]:
    """What is known of the maps without a place, by the store's columns; none where the dataset has none.

    Args:
        listed: files that SHA256SUMS vouches for.

    Raises:
        ExportError: the table cannot be read.
    """
    if table_path(MAPS) not in listed:
        return []
    return list(read_table(folder / table_path(MAPS)).to_pylist())


def load_own(folder: Path, row: Mapping[str, Any], listed: frozenset[str]) -> UnplacedMap:
    """One map without a place.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    for table in CHILD_TABLES:
        check_listed(table_path(table), listed, folder)
    only = ds.field("map_id") == row["map_id"]
    return decoded(
        folder,
        dict(row),
        lambda: {t: read_table(folder / table_path(t), only=only).to_batches() for t in CHILD_TABLES},
        UnplacedMap,
    )
