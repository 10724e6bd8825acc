"""kapture's text files: a line with the version, then values parted by commas."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from featuredb.errors import IngestError
from featuredb.geometry.arrays import FloatArray

_VERSION = re.compile(r"#\s*kapture format:\s*(\S+)")
_MAJOR_MINOR = "1.1"
_LONGEST_LINE = 10_000_000  # of a point that a hundred thousand images see

Row = tuple[str, list[str]]
"""Where a row stands, for error messages, and its values."""


def check_version(path: Path) -> None:
    """Whether a file is of kapture 1.1.

    Raises:
        IngestError: it is not.
    """
    try:
        with path.open(encoding="utf-8") as file:
            first = file.readline(200)
    except (OSError, UnicodeDecodeError) as error:
        raise IngestError(f"{path}: expected kapture's file, cannot be read: {error}") from error
    found = _VERSION.match(first)
    if found is None or found[1] != _MAJOR_MINOR:
        raise IngestError(
            f"{path}: expected '# kapture format: {_MAJOR_MINOR}' in the first line, found "
            f"{first[:60].strip()!r}; "
            "bring it to that version by kapture_upgrade_1.0_to_1.1.py of kapture"
        )


def table(path: Path, least: int, most: int | None = None) -> Iterator[Row]:
    """The rows of a file, of at least and at most so many values.

    Raises:
        IngestError: it is missing, no text, or has a row of another number.
    """
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), start=1):
                if not line.strip() or line.startswith("#"):
                    continue
                values = [value.strip() for value in line.split(",")]
                where = f"{path}, line {number}"
                if len(values) < least or (most is not None and len(values) > most):
                    expected = f"{least}" if most == least else f"at least {least}"
                    raise IngestError(
                        f"{where}: expected {expected} values, found {len(values)}: the file is cut off or "
                        "broken; copy or export it again"
                    )
                yield where, values
    except (OSError, UnicodeDecodeError) as error:
        raise IngestError(f"{path}: expected kapture's table, cannot be read: {error}") from error


def floats(values: list[str], where: str) -> FloatArray:
    """Finite numbers.

    Raises:
        IngestError: something else.
    """
    try:
        found = np.array([float(value) for value in values], dtype=np.float64)
    except ValueError:
        found = np.full(1, np.nan)
    if not np.isfinite(found).all():
        raise IngestError(
            f"{where}: expected finite numbers, found {', '.join(v[:20] for v in values[:8])}; export it "
            "again"
        )
    return found


def whole(value: str, below: int | None, where: str) -> int:
    """A number from 0, below a bound.

    Raises:
        IngestError: something else.
    """
    if value.isdecimal() and len(value) < 20 and (below is None or int(value) < below):
        return int(value)
    expected = "a number from 0" if below is None else f"a number from 0 to {below - 1}"
    raise IngestError(f"{where}: expected {expected}, found {value[:40]!r}; the files do not belong together")
