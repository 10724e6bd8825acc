"""How many cores one query may use."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def capped_threads(count: int) -> Iterator[None]:
    """Within the block OpenCV (the process) and BLAS and OpenMP (this thread) use at most `count` threads."""
    cv2.setNumThreads(count)
    with threadpool_limits(limits=count):
        yield
