"""What programs that measure something share: arguments, a folder to work in, figures for the scoreboard."""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from featuredb.plain_json import plain


def study_parser(doc: str | None) -> argparse.ArgumentParser:
    """The parser of a program; `doc`: of its module."""
    parser = argparse.ArgumentParser(description=(doc or "").split("\n")[0])
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the figures there")
    return parser


@contextmanager
def work_folder(kept: Path | None) -> Iterator[Path]:
    """The folder that is to be kept, or else one that goes with the block."""
    with tempfile.TemporaryDirectory() as scratch:
        yield kept or Path(scratch)


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Print the figures as JSON, and write them to a path; numbers that are not finite become null."""
    text = json.dumps(plain(figures), indent=1) + "\n"
    sys.stdout.write(text)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
