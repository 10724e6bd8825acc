"""Small helpers with which the value types check and freeze their arrays."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from featuredb.errors import InvalidValueError

FloatArray = NDArray[np.float64]


def frozen_array(
    name: str, value: ArrayLike, shape: tuple[int | None, ...], dtype: DTypeLike = np.float64
) -> NDArray[Any]:
    """Return a read-only copy of `value` with the given dtype, after checking its shape.

    `None` in `shape` accepts any length on that axis. Floating arrays must be finite.

    Raises:
        InvalidValueError: wrong shape, not convertible, or not finite.
    """
    try:
        array = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"{name}: expected an array of {np.dtype(dtype)}, found {value!r}") from error
    wanted = "(" + ", ".join("n" if s is None else str(s) for s in shape) + ")"
    if array.ndim != len(shape) or any(
        s is not None and s != a for s, a in zip(shape, array.shape, strict=True)
    ):
        raise InvalidValueError(f"{name}: expected shape {wanted}, found {array.shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InvalidValueError(f"{name}: expected finite numbers, found NaN or infinity")
    array.setflags(write=False)
    return array
