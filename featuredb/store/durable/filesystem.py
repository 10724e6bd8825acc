"""A table's folder as Arrow sees it, on a local disk or in an object store."""

import atexit
import hashlib
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.fs as fs
from deltalake.exceptions import DeltaError
from deltalake.fs import DeltaStorageHandler

from featuredb.errors import StoreError

_BLOCK_BYTES = 2**20


def table_files(url: str, storage_options: dict[str, str] | None, opened: Any = None) -> fs.FileSystem:
    """The files of the table at a URL; paths are relative to it.

    Args:
        opened: the `DeltaTable`, if it is open: without it deltalake reads the log of an object store again.
    """
    if "://" not in url:
        return fs.SubTreeFileSystem(str(Path(url).absolute()), fs.LocalFileSystem())
    _let_arrow_finish_at_exit()
    if opened is not None:  # as deltalake's own `to_pyarrow_dataset` does
        return fs.PyFileSystem(DeltaStorageHandler.from_table(opened._table, storage_options))
    return fs.PyFileSystem(DeltaStorageHandler(url, storage_options))


def blocks_of(files: fs.FileSystem, path: str) -> Iterator[bytes]:
    """The bytes of a file, piece by piece.

    Raises:
        OSError: it cannot be read.
    """
    with files.open_input_file(path) as stream:
        while block := stream.read(_BLOCK_BYTES):
            yield block


def sha256_of(files: fs.FileSystem, path: str) -> str:
    """SHA-256 of a file's bytes, in hex digits.

    Raises:
        OSError: it cannot be read.
    """
    digest = hashlib.sha256()
    for block in blocks_of(files, path):  # each is a request to an object store
        digest.update(block)
    return digest.hexdigest()


def object_writer(files: fs.PyFileSystem, path: str) -> Any:
    """A stream of bytes to an object, which is there when the stream has been closed.

    Not through Arrow, which hands deltalake's stream buffers of its own: it takes bytes alone.
    """
    return files.handler._handler.open_output_stream(path, None)


@contextmanager
def store_errors(what: str) -> Iterator[None]:
    """What deltalake and Arrow raise of a store, as `StoreError` in one line."""
    try:
        yield
    except (DeltaError, OSError, pa.ArrowException) as error:
        raise StoreError(f"{what}: {one_line(error)}") from error


@contextmanager
def read_errors(what: str) -> Iterator[None]:
    """What Arrow raises of files that are lost or damaged, as `StoreError`; `what` says what was read."""
    try:
        yield
    except (OSError, ValueError, pa.ArrowException) as error:
        raise StoreError(f"{what} ({error}); run `featuredb verify`") from error


def one_line(error: Exception) -> str:
    """A message without line ends, and without the colours that deltalake gives some."""
    return " ".join(re.sub(r"\x1b\[\d*m", "", str(error)).split())


@cache
def _let_arrow_finish_at_exit() -> None:
    """Give Arrow's reading threads a moment at the interpreter's end.

    deltalake's filesystem hands them Python's buffers, and one that is released after the interpreter has
    ended aborts the process: 12 of 360 short programs on two busy cores, none of 720 with this pause. Local
    tables are read by Arrow's own filesystem, which holds none (0 of 360).
    """
    atexit.register(time.sleep, 0.1)
