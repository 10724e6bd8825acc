"""Copies of a database that is in use, and databases made of them.

A copy has each table at one version: its log up to there, and the files that this version needs, of `maps`
those of all kept versions. Children are looked at after the table that names them, and that one again: where
it has not moved on, they are what it needs. Files never change, so one that is there is not copied again.
"""

import hashlib
import uuid
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from urllib.parse import unquote

import pyarrow.fs as fs

from featuredb.errors import StoreError
from featuredb.store.commits import oldest_kept_version
from featuredb.store.database import Database, normal_url
from featuredb.store.delta import Table
from featuredb.store.durable.copies import (
    LIST,
    PART,
    CopiedFile,
    CopyList,
    CopyPlace,
    DamagedFileError,
    others_at_work,
    superfluous,
)
from featuredb.store.durable.filesystem import sha256_of, store_errors
from featuredb.store.durable.log import DIGEST, LOG, acknowledge, entry_name, paths_of, whole_entry
from featuredb.store.retry import StaleVersionError, retry_stale
from featuredb.store.tables import CHILDREN, MAPS


@dataclass(frozen=True, slots=True, kw_only=True)
class CopyReport:
    """What a backup or a restore did.

    Attributes:
        kept: files that were there already.
        removed: files of the backup before that this one does not need.
    """

    version: int
    files: int
    bytes: int
    kept: int
    removed: int


def backup(database: Database, target: str, storage_options: Mapping[str, str] | None = None) -> CopyReport:
    """Copy a database, while others read and write it, to a new place or over its own earlier backup.

    Until it is done, the backup before is what `restore` takes. A run that was cut off goes on.

    Args:
        target: an empty folder or prefix, or one that a backup of the same database has made.

    Raises:
        ConflictError: others changed the database too many times while it was looked at.
        StoreError: the target holds something else, a file is lost or damaged, or a store failed.
    """
    url = normal_url(target)
    if url == database.url:
        raise StoreError(f"cannot back up {url} to itself: choose another folder or URL")
    place = CopyPlace(url, dict(storage_options or {}) or None)
    source = CopyPlace(database.url, database.storage_options)
    with store_errors(f"cannot back up {database.url} to {url}"):
        before = _list_of(place, "backup", database.url)
        return retry_stale(f"backup of {database.url}", lambda: _back_up(database, source, place, before))


def restore(source: str, target: Database, storage_options: Mapping[str, str] | None = None) -> CopyReport:
    """Make a database of a backup at a place where nothing is. A run that was cut off goes on.

    Args:
        source: URL of the backup; `storage_options` are its.

    Raises:
        StoreError: there is no whole backup, one of its files is lost or damaged, the target is not empty, or
            a store failed.
    """
    url = normal_url(source)
    backup_place = CopyPlace(url, dict(storage_options or {}) or None)
    place = CopyPlace(target.url, target.storage_options)
    with store_errors(f"cannot restore {url} to {target.url}"):
        found = backup_place.read_list()
        if found is None or found.purpose != "backup":
            raise StoreError(f"no backup at {url}: expected a folder or URL that `featuredb backup` has made")
        if not found.files:
            raise StoreError(f"the backup at {url} was never finished: run `featuredb backup` again")
        begun = _list_of(place, "restore", url)
        wanted = {path: file.sha256 for path, file in found.files.items()}
        try:
            report = _copy(wanted, backup_place, place, begun)
        except (FileNotFoundError, DamagedFileError) as error:
            raise StoreError(
                f"the backup at {url} is damaged ({error}): delete the named file and back up again, or use "
                "another one"
            ) from error
        place.remove([LIST])
    return report


def _back_up(database: Database, source: CopyPlace, place: CopyPlace, before: CopyList) -> CopyReport:
    tables = list(_consistent(database))
    wanted: dict[str, str | None] = {}
    for table in tables:
        wanted |= {f"{table.spec.name}/{path}": digest for path, digest in _files_of(table).items()}
    try:
        return _copy(wanted, source, place, before)
    except FileNotFoundError as error:
        if all(database.table(table.spec.name).version == table.version for table in tables):
            raise StoreError(
                f"a file of the database is lost ({error}); `featuredb verify {database.url}` says which"
            ) from error
        raise StaleVersionError(f"a vacuum has removed files of {database.url}") from error
    except DamagedFileError as error:
        raise StoreError(f"{error}; `featuredb verify {database.url}` says what is damaged") from error


def _consistent(database: Database) -> Iterator[Table]:
    """All tables that there are, each at a version: children that hold what the table above them names."""
    for name, children in reversed(CHILDREN.items()):
        if name != MAPS and not database.has(name):
            continue
        table = database.table(name)
        yield from [database.table(child) for child in children]
        if database.table(name).version != table.version:
            raise StaleVersionError(f"{name} has moved on")
        yield table


def _files_of(table: Table) -> dict[str, str | None]:
    """The files of a table at its version, relative to it, with the SHA-256 of those whose log has it."""
    kept_from = oldest_kept_version(table.commits()) if table.spec.name == MAPS else table.version
    files: dict[str, str | None] = {}
    for version in range(table.version + 1):
        content, actions = whole_entry(table.storage, version)
        if version <= kept_from:
            for path in paths_of("remove", actions):
                files.pop(path, None)
        for add in (a["add"] for a in actions if "add" in a):
            files[unquote(add["path"])] = (add.get("tags") or {}).get(DIGEST)
        files[f"{LOG}/{entry_name(version)}"] = hashlib.sha256(content).hexdigest()
    return files


def _list_of(place: CopyPlace, purpose: str, source: str) -> CopyList:
    """What is at a place where a copy shall be made: nothing, or an earlier copy."""
    found = place.read_list()
    if found is not None and found.purpose == purpose:
        return found
    if found is not None or place.sizes().keys() - {LIST + PART}:
        what = "a copy of another kind" if found is not None else "files"
        raise StoreError(
            f"{place.url} holds {what}, and a {purpose} overwrites nothing: choose an empty folder or URL"
        )
    return CopyList(
        purpose=purpose, source=source, began=datetime.now(UTC), attempt="", whole=False, files={}
    )


def _copy(
    wanted: Mapping[str, str | None], source: CopyPlace, place: CopyPlace, before: CopyList
) -> CopyReport:
    """Make a place hold these files and no others; what it held stays whole until they are there.

    Args:
        wanted: the SHA-256 of each file, where it is known, by path.
        before: what the place holds.
    """
    sizes = place.sizes()
    kept = {path: file for path in wanted if (file := _there(path, wanted[path], place, sizes, before))}
    same = {path for path, file in before.files.items() if file.sha256 == wanted.get(path)}
    _check_same_history(same.union(kept), place, sizes)
    mine = replace(before, source=source.url, began=datetime.now(UTC), attempt=uuid.uuid4().hex, whole=False)
    place.write_list(mine)
    order = sorted(wanted, key=_turn)
    copied = {path: place.take(path, source, wanted[path]) for path in order if path not in kept}
    place.flush_folders(wanted)
    now = place.read_list()
    if now is None or now.attempt != mine.attempt:
        raise others_at_work(place.url)
    version = _acknowledge(place, wanted)
    done = replace(mine, files={path: (kept | copied)[path] for path in order})
    place.write_list(done)
    removed = superfluous(place.sizes(), done.files)
    place.remove(removed)
    place.write_list(replace(done, whole=True))
    return CopyReport(
        version=version,
        files=len(copied),
        bytes=sum(file.size_bytes for file in copied.values()),
        kept=len(kept),
        removed=len(removed),
    )


def _turn(path: str) -> tuple[bool, bool, int, str]:
    """When a file is copied: data before logs, `maps` last.

    A log is copied backwards: before its first entry there is no table.
    """
    table, *_, name = path.split("/")
    log = f"/{LOG}/" in path
    return table == MAPS, log, -int(Path(name).stem) if log else 0, path


def _there(
    path: str, expected: str | None, place: CopyPlace, sizes: Mapping[str, int], before: CopyList
) -> CopiedFile | None:
    """A file that need not be copied, since it is at the place with the right bytes.

    In an object store, where reading costs as much as copying, one of the right size is taken for whole.
    """
    known = before.files.get(path)
    if path not in sizes:
        return None
    if expected is None and known is not None:
        expected = known.sha256
    if place.local or known is None or known.size_bytes != sizes[path]:
        if expected is None:
            return None
        known = CopiedFile(size_bytes=sizes[path], sha256=sha256_of(place.files, path))
    return known if expected == known.sha256 else None


def _check_same_history(same: Collection[str], place: CopyPlace, sizes: Iterable[str]) -> None:
    """Refuse to overwrite commits that the source does not have.

    Args:
        same: files that are the source's, or were when they were copied.
    """
    for path in sorted(sizes):
        if f"/{LOG}/" in path and path.endswith(".json") and path not in same:
            raise StoreError(
                f"{place.url}/{path} is not what the source has there: it is damaged, or of another "
                "database or a later state; choose another folder or URL"
            )


def _acknowledge(place: CopyPlace, paths: Iterable[str]) -> int:
    """Note which version of each table is committed; returns that of `maps`."""
    entries = [path.split(f"/{LOG}/") for path in paths if f"/{LOG}/" in path]
    newest = {name: max(int(Path(e).stem) for n, e in entries if n == name) for name, _ in entries}
    for name, version in newest.items():
        acknowledge(fs.SubTreeFileSystem(name, place.files), version)
    return newest[MAPS]
