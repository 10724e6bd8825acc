"""FAISS over the descriptors of an area, built in memory when the area is loaded.

8-bit RootSIFT goes in exactly (QT_8bit_direct, 128 bytes a descriptor), into inverted lists whose centres
were trained once and come with featuredb: an area costs no training, and one that grows keeps its lists.
"""

from functools import cache
from importlib import resources
from io import BytesIO
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import DESCRIPTOR_SIZE

# Where an exhaustive search of 3,000 query features takes as long as one of the lists (45 ms of one core).
_EXHAUSTIVE_LIMIT = 4_000
_PROBES = 16  # inverted lists that a descriptor is looked for in; more find the neighbour oftener, and slower
_CENTERS = "list_centers.npz"  # tools/train_vocabulary.py made it


class DescriptorIndex:
    """Nearest descriptors of an area. Searching is thread-safe; the object never changes."""

    def __init__(self, index: Any, memory: NDArray[np.uint8] | None = None) -> None:
        """`memory`: where the index has its arrays, if it does not own them."""
        self._index, self._memory = index, memory

    def __reduce__(self) -> tuple[object, ...]:
        """As bytes, which are not copied where they are read."""
        return _in_memory, (faiss.serialize_index(self._index),)

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def search(
        self, descriptors: NDArray[np.uint8], k: int, among: NDArray[np.bool_] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The k nearest rows of each descriptor.

        Args:
            descriptors: (n, 128) uint8.
            among: (rows,) which rows may be found; None: all.

        Returns:
            Squared distances (n, k) float32, ascending, and rows (n, k) int64, -1 where there are fewer.
        """
        if len(self) == 0 or len(descriptors) == 0:
            shape = (len(descriptors), k)
            return np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int64)
        parameters: Any = None
        if among is not None:
            lists = isinstance(self._index, faiss.IndexIVF)
            parameters = faiss.SearchParametersIVF() if lists else faiss.SearchParameters()
            bits = np.packbits(among, bitorder="little")
            select: Any = faiss.IDSelectorBitmap  # its stub is that of C++
            selector = select(bits)
            parameters.sel = selector
            if lists:
                parameters.nprobe = self._index.nprobe
        distance, row = self._index.search(descriptors.astype(np.float32), k, params=parameters)
        return distance, row


def build_index(descriptors: NDArray[np.uint8]) -> DescriptorIndex:
    """Index of descriptors (n, 128) uint8: exhaustive when small, else inverted lists of exact codes."""
    count = len(descriptors)
    if count <= _EXHAUSTIVE_LIMIT:
        index: Any = faiss.IndexFlatL2(DESCRIPTOR_SIZE)
    else:
        centers = _list_centers()
        index = faiss.IndexIVFScalarQuantizer(
            centers,  # kept alive by the Python object of the index
            DESCRIPTOR_SIZE,
            centers.ntotal,
            faiss.ScalarQuantizer.QT_8bit_direct,
            faiss.METRIC_L2,
            False,  # codes, not residuals: exact
        )
        index.is_trained = True  # nor do direct codes need any
        index.nprobe = _PROBES
    for start in range(0, count, 100_000):
        index.add(descriptors[start : start + 100_000].astype(np.float32))
    return DescriptorIndex(index)


@cache
def _list_centers() -> Any:
    """The index of the lists' centres (2048, 128), which all areas share."""
    data = resources.files("featuredb.index").joinpath("data", _CENTERS).read_bytes()
    with np.load(BytesIO(data), allow_pickle=False) as archive:
        centers = archive["centers"].astype(np.float32)
    index = faiss.IndexFlatL2(DESCRIPTOR_SIZE)
    index.add(centers)
    return index


def _in_memory(memory: NDArray[np.uint8]) -> DescriptorIndex:
    library: Any = faiss  # its stubs lack these
    reader = library.ZeroCopyIOReader(library.swig_ptr(memory), memory.nbytes)
    return DescriptorIndex(faiss.read_index(reader), memory)


def use_threads(count: int) -> None:
    """Cap the threads of FAISS in what the calling thread does."""
    faiss.omp_set_num_threads(count)
