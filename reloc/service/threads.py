"""How many cores one query may use."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def capped_process(count: int) -> Iterator[None]:
    """Within the block OpenCV and BLAS use at most `count` threads, in all threads of the process."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        with threadpool_limits(limits=count):
            yield
    finally:
        cv2.setNumThreads(before)
