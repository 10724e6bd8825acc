"""Numba at one place: the decorator of compiled loops, and the way to modules that need it."""

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

from featuredb.extras import require

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a loop on its first call, kept on disk for the next process; it runs without Python's lock.

    Only modules that `compiled_module` imports may use it.
    """
    import numba

    # IEEE division instead of a test per division; NaN keeps its meaning, so no fastmath.
    decorated: F = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    return decorated


def compiled_module(name: str) -> ModuleType:
    """Import a module of compiled loops.

    Raises:
        MissingExtraError: numba is not installed.
    """
    require("lidar", "Drawing point clouds", "numba")
    return importlib.import_module(name)
