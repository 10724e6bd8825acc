"""Files by their bytes; files and folders that are whole or not there; a place for what can be made again."""

import hashlib
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from featuredb.errors import InvalidValueError


def file_sha256(path: Path) -> str:
    """Hex digest of a file's bytes, read piece by piece.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


TEMPORARY = ".tmp-"  # names of files that are being written begin so


def user_cache() -> Path:
    """The user's folder for what can be made again.

    Raises:
        RuntimeError: the user has no home, and `XDG_CACHE_HOME` names no folder.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "featuredb"


def check_output(option: str, path: Path, *sources: str | Path | None) -> None:
    """Before an hour of work, not after it; `sources`: what the work reads, files or not.

    Raises:
        InvalidValueError: the file cannot be written there, or it is one of the sources.
    """
    folder = next(folder for folder in path.absolute().parents if folder.exists())
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        found = f"the folder {path}" if path.is_dir() else f"{path} in {folder}"
        raise InvalidValueError(f"{option}: expected a file in a folder that can be written, found {found}")
    for source in (Path(source) for source in sources if source is not None):
        if path.exists() and source.exists() and path.samefile(source):
            raise InvalidValueError(
                f"{option}: expected another file than {source}, which is read, found {path}"
            )


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path in the same folder; on success it is flushed and takes the name `path`.

    Raises:
        OSError: it cannot be written; its `filename` is `path`.
    """
    temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        os.replace(temporary, path)  # noqa: PTH105 (the name says what it does)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error  # a full disk names no file
    finally:
        temporary.unlink(missing_ok=True)
    _flush(path.parent)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder; on success its files are flushed and it takes the name `path`.

    Another process that finishes the same folder first wins: both made it of the same inputs.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{TEMPORARY}{uuid.uuid4().hex}-{path.name}")
    temporary.mkdir()
    try:
        yield temporary
        for file in sorted(temporary.rglob("*")):
            _flush(file)
        try:
            temporary.rename(path)
        except OSError:
            if not path.is_dir():
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    _flush(path.parent)


def _flush(path: Path) -> None:
    """Force a file's or folder's content to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:  # some file systems cannot flush a folder; the rename is still atomic
        if not path.is_dir():
            raise
    finally:
        os.close(handle)
