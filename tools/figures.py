"""How the programs here hand their figures to the scoreboard: one JSON object in a file."""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from featuredb.plain_json import plain


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """The option that all programs have that measure something."""
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the figures there")


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write the figures as JSON; numbers that are not finite become null. Nothing is done without a path."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(plain(figures), indent=1) + "\n", encoding="utf-8")
