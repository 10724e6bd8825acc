"""What the machine refuses is told in a line, and is no defect of the program."""

import argparse
import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from featuredb.atomic import atomic_file
from featuredb.cli.main import run_command


def _full_disk(args: argparse.Namespace) -> None:
    with atomic_file(args.path):
        raise _FilmError(errno.ENOSPC, "No space left on device")  # no file, as where an open one is written


class _FilmError(OSError):
    """As PyAV's: its file name cannot be changed."""

    filename = property(lambda _: None)


def _delta(args: argparse.Namespace) -> None:
    raise OSError(f"Generic LocalFileSystem error: {args.path}: Permission denied (os error 13)")


@pytest.mark.parametrize(
    ("run", "said"), [(_full_disk, "{}: No space left on device; "), (_delta, "Permission denied; ")]
)
def test_a_disk_or_a_right_is_told_in_a_line(
    run: Callable[[argparse.Namespace], None], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "t.csv"
    assert run_command(run, argparse.Namespace(path=path)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said.format(path) in line


def test_another_error_is_a_defect(tmp_path: Path) -> None:
    def run(_: argparse.Namespace) -> None:
        raise OSError("anything")

    assert run_command(run, argparse.Namespace()) == 70
