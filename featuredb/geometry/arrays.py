"""Small helpers with which the value types check and freeze their arrays."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from featuredb.errors import InvalidValueError

FloatArray = NDArray[np.float64]
_Columns = TypeVar("_Columns")


def frozen_array(
    name: str,
    value: ArrayLike,
    shape: tuple[int | None, ...],
    dtype: DTypeLike = np.float64,
    *,
    nan: bool = False,
) -> NDArray[Any]:
    """Return a read-only copy of `value` with the given dtype, after checking its shape.

    `None` in `shape` accepts any length on that axis. Floating arrays must be finite, with `nan` except for
    NaN; a conversion to integers or booleans must keep every value, so that 0.7 does not become row 0 and 300
    not the byte 44.

    Raises:
        InvalidValueError: wrong shape, not convertible without changing values, or not finite.
    """
    target = np.dtype(dtype)
    try:
        given = np.asarray(value)
    except ValueError as error:
        raise InvalidValueError(f"{name}: expected an array of {target}, found {value!r:.200}") from error
    if given.size and given.dtype.kind not in "biuf":
        raise InvalidValueError(f"{name}: expected numbers, found an array of {given.dtype}")
    if given.dtype == target:
        array = np.array(given)
    else:
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused below
            array = np.array(given, dtype=target)
    if target.kind in "biu" and given.dtype != target and not np.array_equal(array, given):
        raise InvalidValueError(
            f"{name}: expected values that {target} can hold, found others in an array of {given.dtype}"
        )
    if array.shape != shape and not _fits(array.shape, shape):
        wanted = "(" + ", ".join("n" if s is None else str(s) for s in shape) + ")"
        raise InvalidValueError(f"{name}: expected shape {wanted}, found {array.shape}")
    if array.dtype.kind == "f" and (np.isinf(array) if nan else ~np.isfinite(array)).any():
        if nan:
            raise InvalidValueError(f"{name}: expected finite numbers or NaN, found infinity")
        raise InvalidValueError(f"{name}: expected finite numbers, found NaN or infinity")
    array.setflags(write=False)
    return array


def joined(parts: Sequence[_Columns]) -> _Columns:
    """A dataclass of arrays from others of its kind, at least one: their rows one after the other."""
    first: Any = parts[0]
    columns = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(first)}
    return type(parts[0])(**columns)


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(found) == len(shape) and all(s in (None, a) for s, a in zip(shape, found, strict=True))


def freeze(value: object, dtype: DTypeLike = np.float64, **shapes: tuple[int | None, ...]) -> None:
    """Put `frozen_array` of each named field, of this shape, in its place in a frozen dataclass.

    Raises:
        InvalidValueError: as `frozen_array`.
    """
    for name, shape in shapes.items():
        array = frozen_array(f"{type(value).__name__}.{name}", getattr(value, name), shape, dtype)
        object.__setattr__(value, name, array)
