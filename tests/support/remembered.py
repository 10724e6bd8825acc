"""What a long calculation gave is remembered, for tests that ask for the same again and again."""

import hashlib
import pickle
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def remembered(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The function, which does not calculate anew where all that it is given has the same content."""
    results: dict[bytes, Result] = {}

    @wraps(function)
    def asked(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        key = hashlib.sha256(pickle.dumps((args, kwargs), protocol=5)).digest()
        if key not in results:
            results[key] = function(*args, **kwargs)
        return results[key]

    return asked
