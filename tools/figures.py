"""How the programs here hand their figures to the scoreboard: one JSON object in a file."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """The option that all programs have that measure something."""
    parser.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the figures there")


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write the figures as JSON; numbers that are not finite become null. Nothing is done without a path."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(plain(figures), indent=1) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """The value as JSON has it: mappings, lists, strings, numbers; null for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(one) for one in value]
    if hasattr(value, "item"):  # a number of NumPy's
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
