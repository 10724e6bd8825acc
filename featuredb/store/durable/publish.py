"""Commits to a local table that survive a power cut.

deltalake writes data files and log entries without flushing them, and in one call. So an operation runs in a
scratch folder inside the table, whose log has one entry: the state of the table. What it has written is then
published: data files flushed and moved to their places, their folders flushed, the log entry flushed and
linked, the log's folder flushed. An entry that can be seen is whole, and so is all that it names. `link`
fails where a file is, as deltalake's own commit does: one writer makes a version.
"""

import json
import logging
import os
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import unquote

import pyarrow as pa
from deltalake import DeltaTable
from deltalake.exceptions import DeltaError

from featuredb.atomic import file_sha256
from featuredb.errors import StoreError
from featuredb.store.durable.log import (
    DIGEST,
    LAST_CHECKPOINT,
    LOG,
    Action,
    actions_digest,
    entry_name,
    named_checkpoint,
    paths_of,
    read_actions,
)
from featuredb.store.retry import StaleVersionError

logger = logging.getLogger(__name__)
T = TypeVar("T")

SCRATCH = "_scratch-"
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


@contextmanager
def scratch(table: Path, state: Iterable[Action] = (), links: Iterable[str] = ()) -> Iterator[Path]:
    """A folder for an operation on a table.

    Args:
        state: what its log says: protocol, columns, files; none for a table that is not there yet.
        links: files of the table that are read, paths relative to it.
    """
    work = table / f"{SCRATCH}{uuid.uuid4().hex}"
    (work / LOG).mkdir(parents=True)
    try:
        if text := "".join(json.dumps(action) + "\n" for action in state):
            (work / LOG / entry_name(0)).write_text(text)
        for path in links:
            (work / path).parent.mkdir(parents=True, exist_ok=True)
            (work / path).symlink_to(table / path)
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def publish(entries: Iterable[Path], work: Path, table: Path, version: int, *, rebase: bool = False) -> int:
    """Make what was committed in a scratch folder a part of the table; returns the new version.

    Args:
        entries: the new entries of the scratch folder's log, in order.
        version: of the table that the operation saw; -1 for one that was not there.
        rebase: let commits that came meanwhile go before, where both hold whichever is first.

    Raises:
        StaleVersionError: others have committed; nothing of this entry can be seen.
    """
    for entry in entries:
        actions = read_actions(entry.read_bytes())
        paths = [path for path in paths_of("add", actions) if not (work / path).is_symlink()]
        _note_digests(work, entry, actions, paths)
        for path in paths:
            flush(work / path)
            make_folder((table / path).parent)
            (work / path).replace(table / path)
        for folder in {(table / path).parent for path in paths}:
            flush(folder)
        flush(entry)
        try:
            version = _link(entry, actions, table / LOG, version + 1, rebase)
        except StaleVersionError:
            for path in paths:
                (table / path).unlink()
            raise
        flush(table / LOG)
    return version


def links_of_log(table: Path, version: int) -> list[str]:
    """The files of a table's log, relative to the table, from which deltalake reads a version."""
    start, names = -1, []
    last = table / LOG / LAST_CHECKPOINT
    found = named_checkpoint(last.read_bytes()) if last.exists() else None
    if found is not None and found <= version:
        start = found
        names = [last.name, *(p.name for p in last.parent.glob(f"{start:020d}.checkpoint*.parquet"))]
    names += [entry_name(v) for v in range(start + 1, version + 1)]
    return [f"{LOG}/{name}" for name in names]


def publish_checkpoint(work: Path, table: Path) -> None:
    """Take over the checkpoint that was made in a scratch folder, and then the file that names it."""
    made = [p for p in (work / LOG).glob("*.checkpoint*.parquet") if not p.is_symlink()]
    for path in (*made, work / LOG / LAST_CHECKPOINT):
        flush(path)
        path.replace(table / LOG / path.name)
        flush(table / LOG)


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, each entered durably in the one above."""
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in missing:
        flush(made.parent)


def flush(path: Path) -> None:
    """Wait until a file, or what a folder lists, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _note_digests(work: Path, entry: Path, actions: list[Action], paths: list[str]) -> None:
    """Let the entry say what bytes its files have, and it itself: neither has a checksum."""
    for action in actions:
        if "add" in action and (path := unquote(action["add"]["path"])) in paths:
            action["add"]["tags"] = {**(action["add"].get("tags") or {}), DIGEST: file_sha256(work / path)}
    next(a["commitInfo"] for a in actions if "commitInfo" in a)[DIGEST] = actions_digest(actions)
    entry.write_text("".join(json.dumps(action, separators=(",", ":")) + "\n" for action in actions))


def _link(entry: Path, actions: list[Action], log: Path, version: int, rebase: bool) -> int:
    """Give the entry the first free place from `version` on; returns it."""
    while True:
        place = log / entry_name(version)
        try:
            os.link(entry, place)
        except FileExistsError as error:
            if not rebase or not _independent(actions, place):
                raise StaleVersionError(f"version {version} of {log.parent} is there already") from error
            version += 1
        else:
            return version


def _independent(mine: list[Action], entry: Path) -> bool:
    """Whether a commit holds beside another: columns are as they were, no file was removed by both."""
    try:
        theirs = read_actions(entry.read_bytes())
    except ValueError as error:
        raise StoreError(f"cannot commit: log entry {entry}: {error}; run `featuredb repair`") from error
    changed = any("metaData" in action or "protocol" in action for action in theirs)
    return not changed and not set(paths_of("remove", mine)) & set(paths_of("remove", theirs))


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
