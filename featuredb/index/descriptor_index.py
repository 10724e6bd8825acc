"""FAISS over the descriptors of areas: short codes choose neighbours, in inverted lists where there are many.

Which of them is nearest, and how near, the descriptors themselves say (`squared_distances`). The centres of
lists and codes were trained once and come with featuredb: an index costs no training, and a map's part of it
is worked out once and kept with the map.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from io import BytesIO
from typing import Any, Self

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module, mapped, opencv_threads
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.index.nearest import one_thread
from featuredb.index.stacked import Stacked

CODE_PARTS, CODE_BYTES = 32, 16  # 4 bits a part
# So many are compared one by one in the time that the lists of a descriptor take to be found.
_FEW = 25_000
_PROBES = 16  # inverted lists that a descriptor is looked for in; more find the neighbour oftener, and slower
_LISTS, _CODES = "list_centers.npz", "code_centers.npz"  # tools/train_vocabulary.py made them
LISTS = 2048
_AT_ONCE = 256  # descriptors that are compared with all lists: two megabytes
_SORTED = 32  # of these, whose lists are sorted at a time
_CHUNK = 2_048  # descriptors at a time: bounds the copies


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DescriptorCodes:
    """What an index keeps of descriptors.

    Attributes:
        lists: (n,) int16, the inverted list of each.
        codes: (n, 16) uint8, product code.
    """

    lists: NDArray[np.int16]
    codes: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.lists)

    @classmethod
    def of(cls, descriptors: NDArray[np.uint8]) -> Self:
        """Codes of descriptors (n, 128)."""
        lists = np.empty(len(descriptors), np.int16)
        codes = np.empty((len(descriptors), CODE_BYTES), np.uint8)
        index = _empty_index()  # which its quantizer dies with
        for start in range(0, len(descriptors), _CHUNK):
            end = start + _CHUNK
            part = np.ascontiguousarray(descriptors[start:end], dtype=np.float32)
            lists[start:end] = _from_lists(part).argmin(axis=1)
            codes[start:end] = index.pq.compute_codes(part)
        return cls(lists=lists, codes=codes)

    @classmethod
    def joined(cls, parts: Sequence["DescriptorCodes"]) -> Self:
        """Of all, one after the other."""
        return cls(
            lists=np.concatenate([part.lists for part in parts] or [np.zeros(0, np.int16)]),
            codes=np.concatenate([part.codes for part in parts] or [np.zeros((0, CODE_BYTES), np.uint8)]),
        )


class DescriptorIndex:
    """Neighbours among descriptors. Searching is thread-safe; the object never changes."""

    def __init__(self, index: Any) -> None:
        self._index = index

    def __reduce__(self) -> tuple[object, ...]:
        """As bytes, which are copied where they are read: 25 a descriptor."""
        return _of_bytes, (faiss.serialize_index(self._index),)

    def __len__(self) -> int:
        return int(self._index.ntotal)

    @classmethod
    def of(cls, codes: DescriptorCodes) -> Self:
        """Of few, or inverted lists of many."""
        if len(codes) <= _FEW:
            return cls.exhaustive(codes)
        index = _empty_index()
        order = np.argsort(codes.lists, kind="stable")
        rows, sorted_codes = order.astype(np.int64), np.ascontiguousarray(codes.codes[order])
        ends = np.searchsorted(codes.lists[order], np.arange(index.nlist + 1))
        for number in np.flatnonzero(np.diff(ends)):
            start, end = ends[number : number + 2]
            index.invlists.add_entries(
                int(number),
                int(end - start),
                faiss.swig_ptr(rows[start:end]),
                faiss.swig_ptr(sorted_codes[start:end]),
            )
        index.ntotal = len(codes)
        packed = faiss.serialize_index(faiss.IndexIVFPQFastScan(index))
        del index  # its lists lie between those of the other one, and would keep as much memory
        return cls(_read(packed))

    @classmethod
    def exhaustive(cls, codes: DescriptorCodes) -> Self:
        """Without lists: a search compares a descriptor with all codes."""
        flat = faiss.IndexPQ(DESCRIPTOR_SIZE, CODE_PARTS, 4, faiss.METRIC_L2)
        faiss.copy_array_to_vector(_shipped(_CODES).ravel(), flat.pq.centroids)
        faiss.copy_array_to_vector(codes.codes.ravel(), flat.codes)
        flat.is_trained, flat.ntotal = True, len(codes)
        return cls(faiss.IndexPQFastScan(flat))  # type: ignore[arg-type]  # its stubs have one form of several

    def search(self, descriptors: NDArray[np.uint8], k: int) -> NDArray[np.int64]:
        """Rows (n, k) of near ones to each descriptor (n, 128), about nearest first; -1: there are fewer."""
        if len(self) == 0 or len(descriptors) == 0:
            return np.full((len(descriptors), k), -1, np.int64)
        found = np.empty((len(descriptors), k), np.int64)
        for start in range(0, len(descriptors), _CHUNK):
            part = slice(start, start + _CHUNK)
            found[part] = self._search(np.ascontiguousarray(descriptors[part], dtype=np.float32), k)
        return found

    def _search(self, asked: NDArray[np.float32], k: int) -> NDArray[np.int64]:
        if hasattr(self._index, "nprobe"):
            lists = np.concatenate(
                [_probed(part) for part in np.array_split(asked, len(asked) // _AT_ONCE + 1)]
            )
            _, row = self._index.search_preassigned(asked, k, lists, np.zeros(lists.shape, np.float32))
        else:
            parts = np.array_split(asked, min(opencv_threads(), len(asked)))
            row = np.concatenate(mapped(lambda part: self._flat(part, k), parts, len(parts)))
        return np.asarray(row, dtype=np.int64)

    def _flat(self, asked: NDArray[np.float32], k: int) -> NDArray[np.int64]:
        with one_thread():
            row: NDArray[np.int64] = self._index.search(asked, k)[1]
        return row


def squared_distances(
    query: NDArray[np.uint8],
    query_rows: NDArray[np.int64],
    base: NDArray[np.uint8] | Stacked[np.uint8],
    base_rows: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Exact squared distances (m,) of pairs of descriptors, a row of `query` and one of `base` each."""
    squared = np.empty(len(base_rows), np.float32)
    loops = compiled_module("featuredb.index.distance_loops")
    # The loop is compiled for these alone.
    query = np.require(query, requirements=["C", "W"])
    query_rows = np.ascontiguousarray(query_rows, dtype=np.int64)
    for start in range(0, len(base_rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        loops.pair_distances(query, query_rows[part], base[base_rows[part]], squared[part])
    return squared


def warm_up() -> None:
    """Load the compiled loop, or compile it, now: processes that are forked then have it."""
    none = np.zeros((1, DESCRIPTOR_SIZE), np.uint8)
    squared_distances(none, np.zeros(1, np.int64), none, np.zeros(1, np.int64))


def _empty_index() -> Any:
    """Inverted lists of product codes, not of residuals, so that a code is the same in every list."""
    centers = _list_centers()
    index = faiss.IndexIVFPQ(centers, DESCRIPTOR_SIZE, centers.ntotal, CODE_PARTS, 4, faiss.METRIC_L2)
    index.by_residual = False
    faiss.copy_array_to_vector(_shipped(_CODES).ravel(), index.pq.centroids)
    index.is_trained = True
    return index


def _from_lists(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances (n, lists) of descriptors (n, 128) from the lists' centres, less their own length.

    FAISS's search among the centres takes twice as long.
    """
    centers = _shipped(_LISTS)
    squared = descriptors @ (-2.0 * centers.T)
    squared += (centers**2).sum(axis=1)
    return np.asarray(squared)


def _probed(descriptors: NDArray[np.float32]) -> NDArray[np.int64]:
    """The lists (n, _PROBES) that descriptors (n, 128) are looked for in."""
    squared, lists = _from_lists(descriptors), np.empty((len(descriptors), _PROBES), np.int64)
    for start in range(0, len(squared), _SORTED):
        part = slice(start, start + _SORTED)
        lists[part] = np.argpartition(squared[part], _PROBES, axis=1)[:, :_PROBES]
    return lists


@cache
def _list_centers() -> Any:
    """The index of the lists' centres (2048, 128), which all indexes share."""
    index = faiss.IndexFlatL2(DESCRIPTOR_SIZE)
    index.add(_shipped(_LISTS))
    return index


@cache
def _shipped(name: str) -> NDArray[np.float32]:
    data = resources.files("featuredb.index").joinpath("data", name).read_bytes()
    with np.load(BytesIO(data), allow_pickle=False) as archive:
        return np.asarray(archive["centers"], dtype=np.float32)


def _of_bytes(data: NDArray[np.uint8]) -> DescriptorIndex:
    return DescriptorIndex(_read(data))


def _read(data: NDArray[np.uint8]) -> Any:
    index = faiss.deserialize_index(data)
    if hasattr(index, "nprobe"):
        index.nprobe = _PROBES
    return index


@cache
def trained_digest() -> str:
    """Names what codes hang on: the centres of lists and of codes."""
    digest = hashlib.sha256()
    for name in (_LISTS, _CODES):
        digest.update(_shipped(name).tobytes())
    return digest.hexdigest()


def use_threads(count: int) -> None:
    """Cap the threads of FAISS in what the calling thread does."""
    faiss.omp_set_num_threads(count)
