"""Files that a command is to write a trajectory to: checked beforehand, written as far as they can be."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from featuredb.errors import FeatureDbError, InvalidValueError
from reloc.tracking.trajectory.files import check_format, write_trajectory
from reloc.tracking.trajectory.values import Trajectory

_NOTHING_FOUND, _FAILED = 1, 2  # exit codes: no frame was localised; a file could not be written


@dataclass(frozen=True, slots=True, kw_only=True)
class Outputs:
    """What became of the files: names of those that were written, and why others were not."""

    written: tuple[str, ...]
    failed: tuple[str, ...]


def check_outputs(files: Sequence[Path]) -> None:
    """Before an hour of tracking, not after it.

    Raises:
        InvalidValueError: a suffix that stands for no format, or a folder that cannot be written.
    """
    for file in files:
        check_format(file)
        _check_folder(file)


def write_outputs(files: Sequence[Path], trajectory: Trajectory) -> Outputs:
    """Write all that can be written; without any pose only tables."""
    known = _known(trajectory)
    written, failed = [], []
    for file in files:
        if not known and file.suffix.lower() != ".csv":
            continue
        try:
            write_trajectory(file, trajectory)
            written.append(str(file))
        except (FeatureDbError, OSError) as error:
            failed.append(f"{file}: {error}")
    return Outputs(written=tuple(written), failed=tuple(failed))


def exit_code(outputs: Outputs, trajectory: Trajectory) -> int:
    """0, 1 where no frame was localised, 2 where a file could not be written; stderr says which."""
    for text in outputs.failed:
        sys.stderr.write(f"featuredb: {text}\n")
    if outputs.failed:
        return _FAILED
    return 0 if _known(trajectory) else _NOTHING_FOUND


def _known(trajectory: Trajectory) -> bool:
    return any(point.found for point in trajectory.points)


def _check_folder(file: Path) -> None:
    folder = file.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InvalidValueError(f"{file}: expected a folder that can be written, found {folder}")
