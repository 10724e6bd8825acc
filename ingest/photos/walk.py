"""The files of a folder, in an order that depends on their names only, and what a scan found out of them."""

import json
import logging
import os
import stat
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass
from pathlib import Path

from pydantic import TypeAdapter

from featuredb.errors import IngestError
from featuredb.features.exif.read import ExifInfo
from ingest.workspace import write_json


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundFile:
    """One entry of the folder.

    Attributes:
        name: path within the folder, with forward slashes.
        path: where it lies.
        size, mtime_ns: of a regular file.
        reason_code, reason: why it is not looked into; "" for a regular file.
    """

    name: str
    path: Path
    size: int = 0
    mtime_ns: int = 0
    reason_code: str = ""
    reason: str = ""


def walk(folder: Path) -> tuple[FoundFile, ...]:
    """All entries of the folder and of the folders in it, sorted by name; nothing is opened.

    Links are followed, each folder is entered once. Hidden entries, special files, unreadable folders and
    names that are not text come with a reason.

    Raises:
        IngestError: `folder` is not a folder that can be listed.
    """
    try:
        info = folder.stat()
        names = os.listdir(folder)  # noqa: PTH208 (raises here, before anything is done)
    except OSError as error:
        raise IngestError(
            f"{folder}: expected a folder of photos that can be listed, found: {error.strerror or error}"
        ) from error
    seen = {(info.st_dev, info.st_ino)}
    found = list(_entries(folder, sorted(names), "", seen))
    return tuple(sorted(found, key=lambda file: file.name))


def _entries(folder: Path, names: list[str], prefix: str, seen: set[tuple[int, int]]) -> Iterator[FoundFile]:
    for raw in names:
        path = folder / raw
        text = os.fsencode(raw).decode("utf-8", "backslashreplace")
        name = prefix + text
        if text != raw:
            yield refused(name, path, "bad_name", "the name is not valid UTF-8; rename the file")
            continue
        if raw.startswith("."):
            yield refused(name, path, "hidden", "hidden: the name begins with a dot")
            continue
        try:
            info = path.stat()
        except OSError as error:
            yield refused(name, path, "unreadable", f"cannot be read: {error.strerror or error}")
            continue
        if stat.S_ISDIR(info.st_mode):
            yield from _subfolder(path, name, (info.st_dev, info.st_ino), seen)
        elif stat.S_ISREG(info.st_mode):
            yield FoundFile(name=name, path=path, size=info.st_size, mtime_ns=info.st_mtime_ns)
        else:
            yield refused(name, path, "unreadable", "not a regular file (a pipe, socket or device)")


def _subfolder(
    path: Path, name: str, identity: tuple[int, int], seen: set[tuple[int, int]]
) -> Iterator[FoundFile]:
    if identity in seen:
        yield refused(name, path, "folder_again", "a link to a folder that was entered already")
        return
    seen.add(identity)
    try:
        names = sorted(os.listdir(path))  # noqa: PTH208
    except OSError as error:
        yield refused(name, path, "unreadable", f"the folder cannot be listed: {error.strerror or error}")
        return
    yield from _entries(path, names, name + "/", seen)


def refused(name: str, path: Path, code: str, reason: str) -> FoundFile:
    """An entry that is not looked into."""
    return FoundFile(name=name, path=path, reason_code=code, reason=reason)


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ExaminedFile:
    """One file after reading it.

    Attributes:
        size, mtime_ns: of the file that was read; another pair means another file.
        sha256: of its bytes, "" where they were not read.
        reason_code, reason: why it is not a usable photo, "" where it is one.
        picture_hash: see ingest.photos.duplicates.
        exif: metadata; None where it is not a usable photo.
    """

    size: int
    mtime_ns: int
    sha256: str = ""
    _: KW_ONLY
    reason_code: str = ""
    reason: str = ""
    picture_hash: str = ""
    exif: ExifInfo | None = None


_EXAMINED = TypeAdapter(dict[str, ExaminedFile])


def write_cache(path: Path, key: str, examined: dict[str, ExaminedFile]) -> None:
    """Write atomically.

    Args:
        path: of the cache.
        key: of the options that matter to it.
        examined: by name within the folder.
    """
    write_json(path, {"key": key, "files": _EXAMINED.dump_python(examined, mode="json")})


def read_cache(path: Path, key: str) -> dict[str, ExaminedFile]:
    """What `write_cache` wrote under the same key; empty where there is none or it cannot be used."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["key"] != key:
            return {}
        return _EXAMINED.validate_python(content["files"])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        _log.warning("%s: scan cache not used, every file is read again: %r", path, error)
        return {}
