"""Numba at one place: the decorator of compiled loops, the way to modules that need it, and their threads."""

import importlib
import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from types import ModuleType
from typing import Any, TypeVar

import cv2

from featuredb.errors import InvalidValueError

_LOG = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])

T = TypeVar("T")
R = TypeVar("R")

_MOST = 4  # beyond this, merging the threads' buffers eats what they gain
_BAND_ROWS = 16  # small bands even out the work between full and empty parts of a picture


def thread_count(wanted: int) -> int:
    """Threads to use: as wanted, or for 0 as many as the process may use, up to four.

    Raises:
        InvalidValueError: a negative number.
    """
    if wanted < 0:
        raise InvalidValueError(f"threads: expected 0 or more, found {wanted}")
    if wanted:
        return wanted
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(usable, _MOST)


def opencv_threads() -> int:
    """As many as OpenCV may use in this process, up to four."""
    return min(max(cv2.getNumThreads(), 1), _MOST)


def mapped(function: Callable[[T], R], items: Sequence[T], threads: int) -> list[R]:
    """Results in order. Plain threads, since the loops hold no lock and OpenMP's threads forbid a fork."""
    if threads == 1 or len(items) == 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))


def over_rows(loop: Callable[[int, int], None], rows: int, threads: int) -> None:
    """Call loop(first, end) so that all rows are covered once."""
    if threads == 1:
        loop(0, rows)
        return
    band = max(_BAND_ROWS, -(-rows // (4 * threads)))
    bands = [(first, min(first + band, rows)) for first in range(0, rows, band)]
    mapped(lambda ends: loop(*ends), bands, threads)


def compiled(function: F) -> F:
    """Compile a loop on its first call, kept on disk for the next process; it runs without Python's lock.

    Only modules that `compiled_module` imports may use it.
    """
    import numba

    # IEEE division instead of a test per division; NaN keeps its meaning, so no fastmath.
    options = {"nogil": True, "error_model": "numpy"}
    try:
        decorated: F = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no folder that may be written to
        _warn_once()
        decorated = numba.njit(**options)(function)
    return decorated


@cache
def _warn_once() -> None:
    _LOG.warning("no folder for compiled loops: each process compiles them; set NUMBA_CACHE_DIR to a folder")


def compiled_module(name: str) -> ModuleType:
    """Import a module of compiled loops, which takes half a second: where it is needed, and not before."""
    return importlib.import_module(name)
