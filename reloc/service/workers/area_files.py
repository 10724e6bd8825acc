"""Areas as files that worker processes map into memory: one copy for all, and a new worker has it at once.

A file has no name, so that nothing is left behind; whoever has a descriptor or a mapping of it keeps it.
"""

import io
import itertools
import mmap
import os
import pickle
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import IO, Any

from featuredb.errors import StoreError
from featuredb.index.area import Area
from featuredb.index.descriptor_index import DescriptorIndex
from featuredb.index.segment import Segment
from featuredb.index.segment_index import SegmentIndex
from reloc.localiser import Localiser, OnDemand

_ALIGNMENT = 64
_LENGTH_BYTES = 8


class AreaFile:
    """A file without a name in any folder, closed with its last user; its key names it once and for all."""

    def __init__(self, key: int) -> None:
        self.key = key
        self.file: IO[bytes] = tempfile.TemporaryFile(prefix="featuredb-area-")  # noqa: SIM115  # see above
        weakref.finalize(self, self.file.close)


# A localiser as files: those of its areas, then the one that refers to them.
LocaliserFiles = tuple[AreaFile, ...]


class AreaFiles:
    """Writes localisers; areas that one has taken over from another are not written again."""

    def __init__(self) -> None:
        self._keys = itertools.count()
        # With the files of what is within, before its own.
        self._written: weakref.WeakKeyDictionary[object, LocaliserFiles] = weakref.WeakKeyDictionary()

    def of(self, localiser: Localiser) -> LocaliserFiles:
        """The files of a localiser. Raises StoreError: the folder of temporary files has no room for them."""
        try:
            return self._files(localiser)
        except OSError as error:
            raise StoreError(
                f"cannot write the maps into {tempfile.gettempdir()} for the worker processes: {error}. They "
                "need as much room as in memory; free it, or set TMPDIR to another folder"
            ) from error

    def _files(self, value: object) -> LocaliserFiles:
        """The files of all that is within a value and has one of its own, each once, and its own file."""
        within: dict[int, AreaFile] = {}

        def key_of(part: object) -> int:
            if part not in self._written:
                self._written[part] = self._files(part)
            within.update({file.key: file for file in self._written[part]})
            return self._written[part][-1].key

        made = AreaFile(next(self._keys))
        _write(value, made.file, key_of)
        return (*within.values(), made)


class MappedAreas:
    """The other side: localisers out of the files, mapped."""

    def __init__(self) -> None:
        self._parts: dict[int, object] = {}

    def localiser(self, keys: Sequence[int], receive: Callable[[], int]) -> Any:
        """The localiser of some files, by key in the order of `LocaliserFiles`; known ones are kept.

        `receive` gives the descriptor of the next file, which is closed here: one is open at a time.
        """
        found: dict[int, object] = {}
        localiser: object = None
        for key in keys:
            descriptor = receive()
            try:
                if key == keys[-1]:
                    localiser = _read(descriptor, found)
                else:
                    known = self._parts.get(key)
                    found[key] = _read(descriptor, found) if known is None else known
            finally:
                os.close(descriptor)
        self._parts = found
        return localiser


# What has a file of its own: the next localiser may have it as well.
_SHARED = (Area, Segment, DescriptorIndex, SegmentIndex, OnDemand)


class _Pickler(pickle.Pickler):
    whole: object  # that is written
    key_of: Callable[[object], int]

    def persistent_id(self, obj: object) -> int | None:
        if obj is self.whole or not isinstance(obj, _SHARED):
            return None
        return self.key_of(obj)


class _Unpickler(pickle.Unpickler):
    parts: Mapping[int, object]  # what is within, by key

    def persistent_load(self, pid: int) -> object:
        return self.parts[pid]


def _write(value: object, file: IO[bytes], key_of: Callable[[object], int]) -> None:
    """Arrays, then the rest pickled, then where each lies; `key_of` what within has a file of its own."""
    stream, buffers = io.BytesIO(), list[pickle.PickleBuffer]()
    pickler = _Pickler(stream, protocol=5, buffer_callback=buffers.append)
    pickler.whole, pickler.key_of = value, key_of
    pickler.dump(value)
    places = []
    for content in (*(buffer.raw() for buffer in buffers), stream.getbuffer()):
        file.write(bytes(-file.tell() % _ALIGNMENT))
        places.append((file.tell(), content.nbytes))
        file.write(content)
    table = pickle.dumps(places)
    file.write(table + len(table).to_bytes(_LENGTH_BYTES, "little"))
    file.flush()


def _read(descriptor: int, parts: Mapping[int, object]) -> Any:
    # Private, so that nobody can change the others' copy.
    content = memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_COPY))
    length = int.from_bytes(content[-_LENGTH_BYTES:], "little")
    places = pickle.loads(content[-_LENGTH_BYTES - length : -_LENGTH_BYTES])
    *buffers, stream = [content[start : start + size] for start, size in places]
    unpickler = _Unpickler(io.BytesIO(stream), buffers=buffers)
    unpickler.parts = parts
    return unpickler.load()
