"""The folder of an unfinished job: for one process, kept when killed, gone when finished or hopeless."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from featuredb.errors import ConflictError, ScanError
from featuredb.store import Database

# Spilled and finished points take 36 and 55 bytes, and both lie here at the end.
_BYTES_PER_POINT = 100


@dataclass(slots=True)
class WorkFolder:
    """A job's folder.

    Attributes:
        path: of the folder.
        keep: whether it stays when the job ends with an error; set when there is something to go on from.
    """

    path: Path
    keep: bool = False

    def read(self, name: str) -> Any | None:
        """What `write` has written, or None."""
        file = self.path / name
        return json.loads(file.read_text()) if file.is_file() else None

    def write(self, name: str, value: Any) -> None:
        """Write JSON so that it is there whole or not at all."""
        temporary = self.path / f"{name}.tmp"
        temporary.write_text(json.dumps(value))
        temporary.replace(self.path / name)


@contextmanager
def work_folder(database: Database, work: Path | None, name: str, points: int) -> Iterator[WorkFolder]:
    """The folder of one job, locked; removed at the end unless `keep` is set.

    Args:
        work: where jobs have their folders; by default `_work` in a local database, or a cache folder.
        name: of the job.
        points: how many it has to hold.

    Raises:
        ConflictError: another process works on the same job.
        ScanError: the folder cannot be made, or the disk is too small.
    """
    parent = work or _default_parent(database)
    path = parent / name
    try:
        path.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path).free + sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
    except OSError as error:
        raise ScanError(f"cannot use the work folder {path} ({error}); choose another by --work") from error
    folder = WorkFolder(path=path)
    lock = _lock(path)
    try:
        if free < points * _BYTES_PER_POINT:
            raise ScanError(
                f"expected {points * _BYTES_PER_POINT / 1e9:.1f} GB free for the work folder {path}, found "
                f"{free / 1e9:.1f} GB; choose another by --work"
            )
        folder.keep = (path / "spill.json").is_file()
        yield folder
    finally:
        if not folder.keep:
            shutil.rmtree(path, ignore_errors=True)
            if work is None and parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
        os.close(lock)


def _default_parent(database: Database) -> Path:
    if "://" not in database.url:
        return Path(database.url) / "_work"
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "featuredb" / "lidar"


def _lock(path: Path) -> int:
    """A lock that the system gives up when the process ends, however it ends."""
    import fcntl

    lock = os.open(path / "lock", os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        raise ConflictError(f"another process is adding the same scan, in {path}; wait for it") from error
    return lock
