"""Values of JSON files that other programs have written, each asked for with what is expected of it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from featuredb.errors import IngestError


def read_json(path: Path) -> Any:
    """The document.

    Raises:
        IngestError: it cannot be read, is no JSON, or nested beyond reason.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise IngestError(
            f"{path}: expected JSON, found something else ({error}); export it again"
        ) from error


def mapping(value: Any, where: str) -> dict[str, Any]:
    """`value` if it is an object.

    Raises:
        IngestError: it is none.
    """
    if not isinstance(value, dict):
        raise IngestError(f"{where}: expected an object, found {_shown(value)}; export the model again")
    return value


def member(parent: Mapping[str, Any], key: str, where: str) -> Any:
    """What `parent` has under `key`.

    Raises:
        IngestError: nothing.
    """
    if key not in parent:
        raise IngestError(
            f"{where}: expected {key!r}, found {_shown(sorted(parent))}; export the model again"
        )
    return parent[key]


def number(value: Any, where: str) -> float:
    """A finite number.

    Raises:
        IngestError: something else.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            plain = float(value)
        except OverflowError:
            plain = math.inf
        if math.isfinite(plain):
            return plain
    raise IngestError(f"{where}: expected a finite number, found {_shown(value)}; export the model again")


def numbers(value: Any, count: int, where: str) -> list[float]:
    """A list of so many finite numbers.

    Raises:
        IngestError: something else.
    """
    if not isinstance(value, list) or len(value) != count:
        raise IngestError(f"{where}: expected {count} numbers, found {_shown(value)}; export the model again")
    return [number(v, where) for v in value]


def _shown(value: Any) -> str:
    """For an error message: the beginning of it."""
    try:
        text = repr(value)
    except ValueError:  # integers of more digits than Python writes
        text = type(value).__name__
    return text if len(text) < 100 else text[:97] + "..."
