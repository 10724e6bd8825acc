"""How old things are by the store's own time: no writer's clock decides what a vacuum takes."""

import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

import pyarrow.fs as fs

from featuredb.store.durable.log import list_entries, paths_of, utc, whole_entry
from featuredb.store.durable.publish import SCRATCH, flush


def store_time(files: fs.FileSystem) -> datetime:
    """What time it is where the files lie, UTC: that of a file which is made for this, and removed.

    Of a store that can only be read, as in a dry run, the time of its newest file: nothing seems older.
    """
    probe = f"_time-{uuid.uuid4().hex}"
    try:
        files.open_output_stream(probe).close()
    except OSError:
        return max(file_times(files).values())
    try:
        (info,) = files.get_file_info([probe])
        return utc(info.mtime)
    finally:
        files.delete_file(probe)


def file_times(files: fs.FileSystem) -> dict[str, datetime]:
    """When the store got each file of a table, UTC, by path relative to the table."""
    found = files.get_file_info(fs.FileSelector("", recursive=True))
    return {info.path: utc(info.mtime) for info in found if info.type == fs.FileType.File}


def write_times(writes: Mapping[str, set[str]], files: fs.FileSystem) -> dict[str, datetime]:
    """When the store got the rows of each write id: the newest of the files that hold them, if all are there.

    Args:
        writes: the paths of those files, by write id.
    """
    times = file_times(files) if writes else {}
    # A file that is lost (`verify` says so) is no reason to take the rows of a write away.
    return {
        write_id: max(times[path] for path in paths)
        for write_id, paths in writes.items()
        if all(path in times for path in paths)
    }


def old_files(files: fs.FileSystem, unused: Iterable[str], grace: timedelta) -> list[str]:
    """Those of the unused files that were made and dropped from the log longer ago than `grace`."""
    now, times = store_time(files), file_times(files)
    dropped = {
        path
        for version, written in list_entries(files).items()
        if now - written < grace
        for path in paths_of("remove", whole_entry(files, version)[1])
    }
    candidates = {path for path in unused if path in times} - dropped
    return sorted(path for path in candidates if now - times[path] >= grace)


def old_scratch_folders(files: fs.FileSystem, grace: timedelta) -> list[str]:
    """Scratch folders in which nothing has been written for `grace`: left by writers that died."""
    newest: dict[str, datetime] = {}
    for info in files.get_file_info(fs.FileSelector("", recursive=True)):
        if info.path.startswith(SCRATCH):
            folder = info.path.split("/")[0]
            newest[folder] = max(newest.get(folder, utc(info.mtime)), utc(info.mtime))
    if not newest:
        return []
    now = store_time(files)
    return sorted(folder for folder, time in newest.items() if now - time >= grace)


def remove_files(url: str, files: fs.FileSystem, paths: Iterable[str], folders: Iterable[str]) -> None:
    """Remove files and folders of a table; those of a local one are gone for good."""
    for path in paths:
        with suppress(FileNotFoundError):  # another vacuum was faster
            files.delete_file(path)
    for folder in folders:
        with suppress(FileNotFoundError):
            files.delete_dir(folder)
    if "://" not in url:
        for parent in {Path(url, path).parent for path in paths}:
            flush(parent)
