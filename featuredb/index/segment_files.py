"""Segments as files in the user's cache: a map is laid out once for each of its states, not at each start.

A file is an Arrow file with one row, whose columns are the arrays' bytes. It is mapped and not read: what
nobody asks for takes no memory.
"""

import hashlib
import json
import logging
import os
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from featuredb.atomic import atomic_file, user_cache
from featuredb.index.segment import Segment

_LOG = logging.getLogger(__name__)
_LAYOUT = "1"  # of what a segment is made of, and how: another one makes all anew
_SUFFIX = ".arrow"
_NAMES = tuple(field.name for field in fields(Segment))
_MOST_BYTES = 20 * 2**30


class SegmentFiles:
    """A folder of segments, bounded; those that were not used for longest go first.

    A file that cannot be read is as one that is not there; where none can be written, nothing is kept.
    """

    def __init__(self, folder: Path | None = None, most_bytes: int = _MOST_BYTES) -> None:
        """`folder`: default `segments` in the user's cache."""
        self._folder = user_cache() / "segments" if folder is None else folder
        self._most_bytes = most_bytes

    def get(self, database: str, write_id: str, make: Callable[[], Segment]) -> Segment:
        """The segment of a map's state, kept or made now.

        Args:
            database: its address: what one database calls a state says nothing of another's.
        """
        name = hashlib.sha256(f"{_LAYOUT} {database} {write_id}".encode()).hexdigest()
        path = self._folder / name[:2] / f"{name}{_SUFFIX}"
        kept = _read(path)
        if kept is not None:
            return kept
        made = make()
        try:
            with atomic_file(path) as temporary:
                _write(temporary, made)
            self._prune(path)
        except OSError as error:
            _LOG.info("cannot keep what is laid out for searching in %s: %s", self._folder, error)
        return made

    def _prune(self, newest: Path) -> None:
        """Remove files until what is left fits; the newest stays."""
        found = [(path.stat(), path) for path in self._folder.glob(f"*/*{_SUFFIX}")]
        total = sum(stat.st_size for stat, _ in found)
        for stat, path in sorted(found, key=lambda one: one[0].st_mtime):
            if total <= self._most_bytes:
                return
            if path != newest:
                path.unlink(missing_ok=True)
                total -= stat.st_size


def _write(path: Path, segment: Segment) -> None:
    arrays = {name: np.ascontiguousarray(getattr(segment, name)) for name in _NAMES}
    kinds = {name: [array.dtype.str, array.shape] for name, array in arrays.items()}
    schema = pa.schema(
        [pa.field(name, pa.large_binary()) for name in _NAMES], metadata={"arrays": json.dumps(kinds)}
    )
    columns = [
        pa.Array.from_buffers(
            pa.large_binary(),
            1,
            [None, pa.py_buffer(np.array([0, array.nbytes], np.int64)), pa.py_buffer(array)],
        )
        for array in arrays.values()
    ]
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))


def _read(path: Path) -> Segment | None:
    """The segment of a file, marked as used now; None where there is none, or it is broken."""
    try:
        os.utime(path)
        with pa.ipc.open_file(pa.memory_map(str(path))) as reader:
            batch = reader.get_batch(0)
            kinds = json.loads(reader.schema.metadata[b"arrays"])
        segment = Segment(**{name: _array(batch.column(name), *kinds[name]) for name in _NAMES})
    except FileNotFoundError:
        return None
    except (OSError, pa.ArrowException, ValueError, KeyError, TypeError, IndexError) as error:
        _LOG.warning("%s is broken and made anew: %s", path, error)
        return None
    return segment


def _array(column: pa.Array, dtype: str, shape: list[int]) -> NDArray[Any]:
    data = column.buffers()[2]
    flat = np.frombuffer(data, dtype=np.dtype(dtype)) if data is not None else np.empty(0, np.dtype(dtype))
    return flat[: int(np.prod(shape))].reshape(shape)
