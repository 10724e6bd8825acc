"""Files of a database copied to another place, and the list of them that says what a copy holds.

The list is `backup.json` at the top of the copy. It is there before the first file, and says so until the
last one is in its place: what was cut off is known for it, and goes on where it was.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pyarrow.fs as fs

from featuredb.errors import StoreError
from featuredb.store.durable.filesystem import blocks_of, object_writer, one_line, table_files
from featuredb.store.durable.log import ACKNOWLEDGED
from featuredb.store.durable.publish import flush, make_folder
from featuredb.store.tables import SPECS

LIST = "backup.json"
PART = ".part"  # end of the name of a file that is being written
_FORMAT = 1


class DamagedFileError(StoreError):
    """A file that shall be copied has not the bytes that were written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CopiedFile:
    """Bytes of a file: how many, and their SHA-256 in hex digits."""

    size_bytes: int
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CopyList:
    """What a copy of a database holds.

    Attributes:
        source: URL of what was copied.
        began: when, UTC.
        attempt: a name of the run that makes the copy.
        whole: False while files come and go: `files` are then those of the last whole copy.
        files: by path relative to the database.
    """

    purpose: str
    source: str
    began: datetime
    attempt: str
    whole: bool
    files: Mapping[str, CopiedFile]


class CopyPlace:
    """A database's files, for reading and for writing so that each is whole or not there."""

    def __init__(self, url: str, storage_options: dict[str, str] | None) -> None:
        self.url = url
        self.local = "://" not in url
        self._root = Path(url) if self.local else None
        self.files = table_files(url, storage_options)

    def sizes(self) -> dict[str, int]:
        """The bytes of each file, by path; none where the place does not exist."""
        found = self.files.get_file_info(fs.FileSelector("", recursive=True, allow_not_found=True))
        return {info.path: info.size for info in found if info.type == fs.FileType.File}

    def take(self, path: str, source: "CopyPlace", expected: str | None) -> CopiedFile:
        """Copy a file from another place.

        Args:
            expected: SHA-256 that its bytes must have, where that is known.

        Raises:
            FileNotFoundError: it is not there.
            DamagedFileError: its bytes are others; nothing of them stays.
            StoreError: another copy to this place is at work.
        """
        digest, size = hashlib.sha256(), 0
        try:
            with self._writer(path) as out:
                for block in blocks_of(source.files, path):
                    digest.update(block)
                    size += len(block)
                    out.write(block)
            if expected is not None and digest.hexdigest() != expected:
                raise DamagedFileError(f"{source.url}/{path}: its bytes are not those that were written")
        except BaseException:
            with suppress(FileNotFoundError):
                self.files.delete_file(path if self._root is None else path + PART)
            raise
        self._show(path)
        return CopiedFile(size_bytes=size, sha256=digest.hexdigest())

    def read_list(self) -> CopyList | None:
        """What the copy at this place holds; None where there is none.

        Raises:
            StoreError: its list is damaged, or of a newer release.
        """
        try:
            content = b"".join(blocks_of(self.files, LIST))
        except FileNotFoundError:
            return None
        try:
            found: dict[str, Any] = json.loads(content)
            if found.pop("featuredb_backup") != _FORMAT:
                raise StoreError(f"{self.url}/{LIST} is of a newer release: use a newer featuredb")
            files = {path: CopiedFile(**file) for path, file in found.pop("files").items()}
            began = datetime.fromisoformat(found.pop("began"))
            return CopyList(**found, began=began, files=files)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(
                f"{self.url}/{LIST} is damaged ({error}): use another backup, or make a new one"
            ) from error

    def write_list(self, copied: CopyList) -> None:
        """Say what the copy at this place holds."""
        values = {**asdict(copied), "began": copied.began.isoformat()}
        with self._writer(LIST) as out:
            out.write(json.dumps({"featuredb_backup": _FORMAT, **values}, indent=0).encode())
        self._show(LIST)
        if self._root is not None:
            flush(self._root)

    def remove(self, paths: Iterable[str]) -> None:
        """Delete files, for good."""
        removed = list(paths)
        for path in removed:
            with suppress(FileNotFoundError):
                self.files.delete_file(path)
        self.flush_folders(removed)

    def flush_folders(self, paths: Iterable[str]) -> None:
        """Wait until the names of files are on a local disk, and those of their folders."""
        if self._root is not None:
            for folder in sorted({(self._root / path).parent for path in paths}):
                if folder.exists():
                    flush(folder)

    def _writer(self, path: str) -> closing[Any]:
        if self._root is None:
            return closing(object_writer(self.files, path))
        make_folder((self._root / path).parent)
        return closing((self._root / (path + PART)).open("wb"))

    def _show(self, path: str) -> None:
        if self._root is not None:
            part = self._root / (path + PART)
            try:
                flush(part)
                part.replace(self._root / path)
            except FileNotFoundError as error:
                raise others_at_work(self.url) from error


def cut_off(url: str, storage_options: dict[str, str] | None) -> str | None:
    """What is wrong with the list of a copy, or why that copy is not whole; None where neither is so."""
    try:
        found = CopyPlace(url, storage_options).read_list()
    except StoreError as error:
        return str(error)
    return None if found is None or found.whole else _unfinished(found)


def check_restored(url: str, storage_options: dict[str, str] | None) -> None:
    """Refuse a place where a restore is not done: what is there may be an older state.

    Raises:
        StoreError: so it is, or the store does not answer.
    """
    try:
        found = CopyPlace(url, storage_options).read_list()
    except StoreError:  # `verify` tells of a damaged list
        return
    except OSError as error:
        if "://" not in url:  # whoever opens the tables is told of the disk
            return
        raise StoreError(f"cannot open {url}: {one_line(error)}") from error
    if found is not None and found.purpose == "restore" and not found.whole:
        raise StoreError(f"cannot open {url}: {_unfinished(found)}")


def _unfinished(found: CopyList) -> str:
    what = f"a {found.purpose} from {found.source} to here was cut off, or is at work"
    return f"{what}: run the same {found.purpose} again"


def others_at_work(url: str) -> StoreError:
    """The error for a place to which two copies are made at once."""
    return StoreError(f"another copy to {url} is at work: let it finish, and run this again")


def superfluous(paths: Iterable[str], files: Mapping[str, CopiedFile]) -> list[str]:
    """Files in the tables of a copy that are no part of it."""
    return sorted(
        path
        for path in paths
        if path not in files and path.split("/")[0] in SPECS and f"/{ACKNOWLEDGED}/" not in path
    )
