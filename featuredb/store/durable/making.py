"""How tables are made, and what their Parquet files are written like."""

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
from deltalake import ColumnProperties, DeltaTable, WriterProperties
from deltalake.exceptions import DeltaError, TableNotFoundError

from featuredb.errors import DatabaseNotFoundError, SnapshotNotFoundError, StoreError
from featuredb.store.durable.filesystem import one_line, table_files
from featuredb.store.durable.log import damaged, log_problems
from featuredb.store.tables import FORMAT_VERSION, READABLE_FORMATS, SPECS, TableSpec

# The log is the history that `as_of` reads; it is small, so it is kept until `vacuum` is told otherwise.
LOG_RETENTION = "interval 36500 days"
_WORK = "_work"  # where jobs keep what is unfinished, before there are tables


def create_table(url: str, spec: TableSpec, storage_options: dict[str, str] | None) -> None:
    """Make an empty table; harmless where there is one."""
    DeltaTable.create(
        url,
        spec.schema,
        mode="ignore",
        partition_by=list(spec.partition_by) or None,
        name=f"featuredb.{spec.name}",
        description=description(),
        configuration={
            "delta.logRetentionDuration": LOG_RETENTION,
            "delta.dataSkippingStatsColumns": ",".join(spec.statistics),
        },
        storage_options=storage_options,
    )


def description() -> str:
    """What a table says about its format."""
    return json.dumps({"featuredb_format": FORMAT_VERSION})


def writer_properties(spec: TableSpec) -> WriterProperties:
    """Compression, row groups, encodings and statistics."""
    # Lengths apart from bytes: 128-byte descriptors take 108 bytes a row instead of 111, and write faster.
    # Statistics of a column of photos would be two more copies of each: its minimum and its maximum.
    plain = ColumnProperties(
        dictionary_enabled=False, encoding="DELTA_LENGTH_BYTE_ARRAY", statistics_enabled="NONE"
    )
    return WriterProperties(
        compression="ZSTD",
        max_row_group_size=spec.row_group_rows,
        column_properties=dict.fromkeys(spec.plain_bytes, plain) or None,
    )


def check_format(url: str, spec: TableSpec, delta: Any) -> None:
    """Is it a table of this system, of a format that can be read, with its columns?

    Raises:
        DatabaseNotFoundError: another Delta table.
        StoreError: another format, or a log that names other columns.
    """
    metadata = delta.metadata()
    if metadata.name != f"featuredb.{spec.name}":
        raise DatabaseNotFoundError(f"{url} is a Delta table named {metadata.name!r}, not one of featuredb")
    found = format_of(metadata)
    if found not in READABLE_FORMATS:
        raise StoreError(
            f"{url} has featuredb format {found}, expected {READABLE_FORMATS[-1]} or older; "
            "use a newer featuredb"
        )
    unknown = {field.name for field in delta.schema().fields} - set(spec.schema.names)
    if unknown:
        raise StoreError(
            f"{url}: its log is damaged: it names columns that no format has ({', '.join(sorted(unknown))}); "
            "restore the database from a backup"
        )


def format_of(metadata: Any) -> Any:
    """Format of a table of this system, None where it does not say."""
    try:
        return json.loads(metadata.description or "{}").get("featuredb_format")
    except (ValueError, AttributeError):
        return None


def why_not_opened(
    url: str, storage_options: dict[str, str] | None, version: int | None, error: Exception
) -> StoreError:
    """The error for a table that deltalake cannot open, in words."""
    try:
        problem = next(log_problems(table_files(url, storage_options)), None)
    except (OSError, pa.ArrowException):
        problem = None
    if problem is not None:
        return damaged(url, problem)
    if isinstance(error, TableNotFoundError):
        return DatabaseNotFoundError(
            f"no featuredb table at {url}; check the path, or create the database with `featuredb init`"
        )
    if version is not None and isinstance(error, DeltaError):  # an OSError: the store does not answer
        return SnapshotNotFoundError(f"{url} has no version {version}: {error}")
    return StoreError(f"cannot open {url}: {one_line(error)}")


def check_place(url: str) -> None:
    """Before hours of work for a new database: is there one, or a place for one? Makes nothing.

    Args:
        url: of a `Database`.

    Raises:
        StoreError: a local path that is mistyped: in no folder, a file, or a folder of other things.
    """
    if "://" in url:
        return
    folder = Path(url)
    if not folder.parent.is_dir():
        raise StoreError(
            f"{folder}: there is no folder {folder.parent} to make a database in; check the path, or make "
            "that folder first"
        )
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file, and a database is a folder; name another one")
    there = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    if there and not there & {*SPECS, _WORK}:
        raise StoreError(f"{folder} is a folder of other things, and no database; name one that is free")
