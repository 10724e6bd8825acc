"""Segments as files in the user's cache: a map is laid out once for each of its states, not at each start.

A file is an Arrow file with one row, whose columns are the arrays' bytes. It is mapped and not read: what
nobody asks for takes no memory, and what only the index asked for gives it back (`SegmentFiles.settle`).
"""

import ctypes
import hashlib
import logging
import mmap
import os
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from featuredb.atomic import atomic_file, user_cache
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.index.descriptor_index import CODE_BYTES, LISTS, trained_digest
from featuredb.index.segment import Segment, row_type

_LOG = logging.getLogger(__name__)
_LAYOUT = "3"  # raised where the same arrays come to mean something else
_SUFFIX = ".arrow"
# Of each array of a segment, the type and the shape of a row.
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "origin": ("<f8", (3,)),
    "points": ("<f4", (3,)),
    "point_row": ("<i4", ()),
    "covariance_root": ("<f2", (6,)),
    "view_direction": ("<f2", (3,)),
    "view_spread": ("<f2", ()),
    "view_distance": ("<f2", ()),
    "descriptors": ("|u1", (DESCRIPTOR_SIZE,)),
    "lists": ("<i2", ()),
    "codes": ("|u1", (CODE_BYTES,)),
    "image_id": ("<i4", ()),
    "image_camera": ("<i4", ()),
    "image_pose": ("<f8", (3, 4)),
    "image_covariance": ("<f8", (6, 6)),
    "image_start": ("<i8", ()),
    "see_point": ("<i4", ()),  # "<u2" of few points
    "image_center": ("<f8", (3,)),
    "image_scene": ("<f8", (3,)),
    "image_reach": ("<f8", ()),
    "shared_start": ("<i8", ()),
    "shared_image": ("<i4", ()),
    "shared_count": ("<i4", ()),
}
_OF_POINTS = (*list(_ARRAYS)[2:8], "lists", "codes")
_OF_IMAGES = ("image_camera", "image_pose", "image_covariance", "image_center", "image_scene", "image_reach")
_MOST_BYTES = 20 * 2**30


class SegmentFiles:
    """The segments of one database in a folder that all databases share.

    The folder is bounded: `prune` removes what was not used for longest, but nothing that this object has
    used; what does not fit beside that is not kept. A file that cannot be read is as one that is not there.
    """

    def __init__(self, database: str, folder: Path | None = None, most_bytes: int = _MOST_BYTES) -> None:
        """
        Args:
            database: its address: what one database calls a state says nothing of another's.
            folder: default `segments` in the user's cache.
        """
        self._database, self._most_bytes = database, most_bytes
        self._folder = _default_folder() if folder is None else folder
        self._used: dict[Path, int] = {}
        self._read: list[mmap.mmap] = []
        self._told = self._written = False

    def get(self, write_id: str, make: Callable[[], Segment]) -> Segment:
        """The segment of a map's state, kept or made now."""
        if self._folder is None:
            return make()
        key = f"{_layout()} {self._database} {write_id}"
        name = hashlib.sha256(key.encode()).hexdigest()
        path = self._folder / name[:2] / f"{name}{_SUFFIX}"
        kept = self._mapped(path)
        if kept is None:
            made = make()
            kept = self._mapped(path) if self._keep(path, made) else None
            return made if kept is None else kept
        with suppress(OSError):
            os.utime(path)
            self._used[path] = path.stat().st_size
        return kept

    def _mapped(self, path: Path) -> Segment | None:
        """The segment of a file; None where there is none that may be read, or it is broken."""
        try:
            with path.open("rb") as file:
                content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            segment = _segment_of(content)
        except (FileNotFoundError, PermissionError, NotADirectoryError):
            return None
        except (OSError, pa.ArrowException, ValueError, KeyError, TypeError, IndexError) as error:
            _LOG.warning("%s is broken and made anew: %s", path, error)
            return None
        self._read.append(content)
        return segment

    def _keep(self, path: Path, segment: Segment) -> bool:
        """Whether there is a file of it now."""
        size = sum(getattr(segment, name).nbytes for name in _ARRAYS)
        try:
            if sum(self._used.values()) + size > self._most_bytes:
                raise OSError(f"{self._most_bytes / 2**30:.0f} GiB are full of what is used now")
            with atomic_file(path) as temporary:
                _write(temporary, segment)
            self._used[path] = size
            self._written = True
            return True
        except OSError as error:
            if not self._told:
                _LOG.warning(
                    "what is laid out for searching is not kept in %s, and made anew at each start: %s",
                    self._folder,
                    error,
                )
            self._told = True
            return False

    def settle(self) -> None:
        """Once all is indexed: memory that only this took is given back; files go until what is left fits.

        Files that were used or written here stay.
        """
        with suppress(OSError, AttributeError):  # not every system has these
            for content in self._read:
                content.madvise(mmap.MADV_DONTNEED)
            ctypes.CDLL(None).malloc_trim(0)  # of glibc: what is free between what is used
        self._read.clear()
        self._prune()

    def _prune(self) -> None:
        if self._folder is None or not self._written:
            return
        found = []
        for path in self._folder.glob(f"*/*{_SUFFIX}"):
            with suppress(OSError):  # another process prunes, too
                found.append((path.stat(), path))
        total = sum(stat.st_size for stat, _ in found)
        for stat, path in sorted(found, key=lambda one: one[0].st_mtime):
            if total <= self._most_bytes:
                return
            if path not in self._used:
                with suppress(OSError):
                    path.unlink(missing_ok=True)
                total -= stat.st_size


def _default_folder() -> Path | None:
    try:
        return user_cache() / "segments"
    except RuntimeError as error:
        _LOG.warning("what is laid out for searching is made anew at each start: %s", error)
        return None


@cache
def _layout() -> str:
    """Names what segments are made of, and with what; another one makes all anew."""
    return " ".join((_LAYOUT, trained_digest(), *_ARRAYS))


def _write(path: Path, segment: Segment) -> None:
    schema = pa.schema([pa.field(name, pa.large_binary()) for name in _ARRAYS])
    columns = []
    for name, (dtype, _) in _kinds(len(segment)).items():
        array = np.ascontiguousarray(getattr(segment, name), dtype)
        offsets = pa.py_buffer(np.array([0, array.nbytes], np.int64))
        columns.append(pa.Array.from_buffers(pa.large_binary(), 1, [None, offsets, pa.py_buffer(array)]))
    with pa.OSFile(str(path), "wb") as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))


def _segment_of(content: mmap.mmap) -> Segment:
    """Raises ValueError, KeyError, TypeError, IndexError, ArrowException: it is none."""
    with pa.ipc.open_file(pa.BufferReader(pa.py_buffer(content))) as reader:
        batch = reader.get_batch(0)
    kinds = _kinds(len(_array(batch.column("points"), *_ARRAYS["points"])))
    segment = Segment(**{name: _array(batch.column(name), *kind) for name, kind in kinds.items()})
    _check(segment)
    return segment


def _kinds(points: int) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Types and shapes of the arrays of a segment of so many points."""
    return _ARRAYS | {"see_point": (row_type(points).str, ())}


def _array(column: pa.Array, dtype: str, tail: tuple[int, ...]) -> NDArray[Any]:
    _, offsets, data = column.buffers()  # as they lie in the file; Arrow's scalars are copies
    size = int(np.frombuffer(offsets, np.int64)[1])
    count = size // np.dtype(dtype).itemsize
    flat: NDArray[Any] = np.frombuffer(data, dtype, count) if count else np.empty(0, dtype)
    return flat.reshape(-1, *tail)


def _check(segment: Segment) -> None:
    """Raises ValueError where arrays do not fit together, or name a row that is not there."""
    points, images = len(segment.points), len(segment.image_id)
    counts = dict.fromkeys(_OF_POINTS, points) | dict.fromkeys(_OF_IMAGES, images)
    counts |= {
        "origin": 1,
        "image_start": images + 1,
        "shared_start": images + 1,
        "shared_count": len(segment.shared_image),
    }
    for name, count in counts.items():
        if len(getattr(segment, name)) != count:
            raise ValueError(f"{name}: expected {count} rows, found {len(getattr(segment, name))}")
    for starts, rows, most in (
        (segment.image_start, segment.see_point, points),
        (segment.shared_start, segment.shared_image, images),
        (np.array([0, points]), segment.lists, LISTS),
    ):
        if starts[0] != 0 or starts[-1] != len(rows) or (np.diff(starts) < 0).any():
            raise ValueError("slices do not cover their rows")
        if len(rows) and not 0 <= rows.min() <= rows.max() < most:
            raise ValueError(f"expected rows from 0 to {most - 1}, found {rows.min()} to {rows.max()}")
