"""An operation of deltalake on a local table, so that what it commits survives a power cut."""

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import unquote

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import DeltaError

from featuredb.store.durable.log import LOG, Action
from featuredb.store.durable.publish import links_of_log, make_folder, publish, publish_checkpoint, scratch

T = TypeVar("T")

logger = logging.getLogger(__name__)

# What an operation looks at: columns; also the list of files; also the rows in them.
Sight = Literal["columns", "files", "rows"]
CHECKPOINT_INTERVAL = 100  # deltalake's own: a reader has at most so many entries to read


def create_locally(table: Path, create: Callable[[str], None]) -> None:
    """Run what makes a table at a place.

    Raises:
        StaleVersionError: there is one already.
    """
    make_folder(table / LOG)
    with scratch(table) as work:
        create(str(work))
        publish(_entries(work, 0), work, table, -1)


def commit_locally(
    table: Path, delta: Any, operation: Callable[[Any], T], sight: Sight, *, rebase: bool
) -> tuple[int, T]:
    """Run an operation on a table as it was loaded; returns the new version and what the operation gave.

    Args:
        rebase: let commits that came meanwhile go before, where both hold whichever is first.

    Raises:
        StaleVersionError: others have committed; nothing of this can be seen.
    """
    files = [] if sight == "columns" else pa.table(delta.get_add_actions()).to_pylist()
    links = [unquote(file["path"]) for file in files] if sight == "rows" else []
    with scratch(table, [*_columns(delta), *map(_add, files)], links) as work:
        result = operation(DeltaTable(work))
        version = publish(_entries(work, 1), work, table, delta.version(), rebase=rebase)
    if version > delta.version() and version % CHECKPOINT_INTERVAL == 0:
        try:  # the commit is done, with or without
            with scratch(table, links=links_of_log(table, version)) as work:
                DeltaTable(work).create_checkpoint()
                publish_checkpoint(work, table)
        except (OSError, DeltaError) as error:
            logger.warning("%s: no checkpoint of version %d: %s", table, version, error)
    return version, result


def _entries(work: Path, first: int) -> list[Path]:
    return sorted(path for path in (work / LOG).glob("*.json") if int(path.stem) >= first)


def _columns(delta: Any) -> list[Action]:
    """Protocol and metadata, as a log has them."""
    protocol, metadata = delta.protocol(), delta.metadata()
    return [
        {
            "protocol": {
                "minReaderVersion": protocol.min_reader_version,
                "minWriterVersion": protocol.min_writer_version,
            }
        },
        {
            "metaData": {
                "id": metadata.id,
                "name": metadata.name,
                "description": metadata.description,
                "format": {"provider": "parquet", "options": {}},
                "schemaString": delta.schema().to_json(),
                "partitionColumns": metadata.partition_columns,
                "createdTime": metadata.created_time,
                "configuration": metadata.configuration,
            }
        },
    ]


def _add(file: Mapping[str, Any]) -> Action:
    """A live file, as a log has it; its statistics only help to find rows, and are left out."""
    partition = file.get("partition") or {}
    return {
        "add": {
            "path": file["path"],
            "partitionValues": {name: None if v is None else str(v) for name, v in partition.items()},
            "size": file["size_bytes"],
            "modificationTime": file["modification_time"],
            "dataChange": True,
        }
    }
