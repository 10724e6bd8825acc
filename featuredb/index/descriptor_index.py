"""FAISS over the descriptors of an area: a derived file, named by the digest of what it indexes.

8-bit RootSIFT goes in exactly (QT_8bit_direct, 128 bytes a descriptor).
"""

import logging
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import StoreError
from featuredb.features.features import DESCRIPTOR_SIZE

_LOG = logging.getLogger(__name__)
_VERSION = 1
# Up to here an exhaustive search of 1,000 query features takes tens of milliseconds on two cores.
_EXHAUSTIVE_LIMIT = 20_000


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexOptions:
    """How the index of a large area is built and searched.

    Attributes:
        probes: inverted lists visited for each query descriptor. More find the true neighbour oftener, and
            take longer.
        mmap_from_bytes: files at least this large are memory-mapped instead of read.
    """

    probes: int = 16
    mmap_from_bytes: int = 256 * 2**20


class DescriptorIndex:
    """Nearest descriptors of an area. Searching is thread-safe; the object never changes."""

    def __init__(self, index: Any) -> None:
        self._index = index

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def search(self, descriptors: NDArray[np.uint8], k: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """The k nearest rows of each descriptor.

        Args:
            descriptors: (n, 128) uint8.

        Returns:
            Squared distances (n, k) float32, ascending, and rows (n, k) int64, -1 where there are fewer.
        """
        if len(self) == 0 or len(descriptors) == 0:
            shape = (len(descriptors), k)
            return np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int64)
        distance, row = self._index.search(descriptors.astype(np.float32), k)
        return distance, row


def build_index(descriptors: NDArray[np.uint8], options: IndexOptions | None = None) -> DescriptorIndex:
    """Index of descriptors (n, 128) uint8: exhaustive when small, else inverted lists of exact codes."""
    options = options or IndexOptions()
    count = len(descriptors)
    if count <= _EXHAUSTIVE_LIMIT:
        index: Any = faiss.IndexFlatL2(DESCRIPTOR_SIZE)
    else:
        # k-means wants at least 39 points a list.
        lists = min(int(2 ** np.round(np.log2(4 * np.sqrt(count)))), count // 39)
        index = faiss.IndexIVFScalarQuantizer(
            faiss.IndexFlatL2(
                DESCRIPTOR_SIZE
            ),  # kept alive, and freed once, by the Python object of the index
            DESCRIPTOR_SIZE,
            lists,
            faiss.ScalarQuantizer.QT_8bit_direct,
            faiss.METRIC_L2,
            False,  # codes, not residuals: exact
        )
        index.cp.seed = 0
        index.cp.niter = 10
        sample = np.random.default_rng(0).choice(count, min(count, 64 * lists), replace=False)
        index.train(descriptors[np.sort(sample)].astype(np.float32))
        index.nprobe = options.probes
    for start in range(0, count, 100_000):
        index.add(descriptors[start : start + 100_000].astype(np.float32))
    return DescriptorIndex(index)


def load_or_build(
    descriptors: NDArray[np.uint8], digest: str, cache: Path | None, options: IndexOptions | None = None
) -> DescriptorIndex:
    """The index of an area: from the cache folder when it is there and whole, else built and kept there.

    A cache that cannot be read or written costs time only: the index is built in memory and the reason
    is logged.
    """
    options = options or IndexOptions()
    if cache is None or len(descriptors) <= _EXHAUSTIVE_LIMIT:
        return build_index(descriptors, options)
    path = cache / f"v{_VERSION}-{digest[:32]}.faiss"
    try:
        return _read(path, len(descriptors), options)
    except FileNotFoundError:
        pass  # the first time
    except (RuntimeError, MemoryError, OSError, StoreError) as error:
        _LOG.warning("index %s is unusable and is rebuilt: %s", path, error)
    index = build_index(descriptors, options)
    try:
        _write(index, path)
    except (OSError, RuntimeError) as error:
        _LOG.warning("index cannot be kept at %s: %s", path, error)
    return index


def _read(path: Path, expected: int, options: IndexOptions) -> DescriptorIndex:
    mmap = path.stat().st_size >= options.mmap_from_bytes
    index: Any = faiss.read_index(str(path), faiss.IO_FLAG_MMAP | faiss.IO_FLAG_READ_ONLY if mmap else 0)
    if index.ntotal != expected or index.d != DESCRIPTOR_SIZE:
        raise StoreError(
            f"expected {expected} descriptors of {DESCRIPTOR_SIZE} bytes, found {index.ntotal} of {index.d}"
        )
    index.nprobe = options.probes
    return DescriptorIndex(index)


def _write(index: DescriptorIndex, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
    os.close(handle)
    try:
        faiss.write_index(index._index, temporary)
        Path(temporary).replace(path)
    finally:
        Path(temporary).unlink(missing_ok=True)
