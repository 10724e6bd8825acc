"""What programs that measure something share: arguments, errors, and figures for the scoreboard."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.similarity import similarity_closed_form
from featuredb.plain_json import plain

_SHARED: dict[str, dict[str, Any]] = {
    "--json": {"metavar": "FILE", "help": "write the figures there, too"},
    "--out": {"metavar": "FOLDER", "required": True, "help": "what is made is kept there, and the figures"},
    "--photos": {"metavar": "FOLDER", "required": True},
    "--scan": {"metavar": "LAZ", "required": True},
    "--work": {"metavar": "FOLDER", "required": True, "help": "what is made is kept there"},
    "--inputs": {"metavar": "FOLDER", "help": "keep worlds and films there"},
    "--held-out": {"type": str, "nargs": "+", "required": True, "metavar": "NAME"},
    "--seed": {"type": int, "default": 1, "help": "of what is drawn; default: 1"},
}


def study_parser(doc: str | None, *shared: str) -> argparse.ArgumentParser:
    """The parser of a program, with the shared arguments of these names; `doc`: of its module.

    Without --out, whose folder has the figures, it has --json as well.
    """
    parser = argparse.ArgumentParser(description=(doc or "").split("\n")[0])
    for name in shared if "--out" in shared else ("--json", *shared):
        parser.add_argument(name, **{"type": Path, **_SHARED[name]})
    return parser


def pose_offset(pose: Rigid3, true: Rigid3) -> FloatArray:
    """(6,) rotation (rad) before displacement of the camera (m), from a cam_from_local to the true one."""
    turn = so3_log(true.rotation.T @ pose.rotation)
    return np.concatenate([turn, true.center - pose.center])


def laid_on(mine: Mapping[str, FloatArray], theirs: Mapping[str, FloatArray]) -> Sim3 | None:
    """The similarity that takes places (3,) onto those of the same names; None where these are too few."""
    both = sorted(mine.keys() & theirs.keys())
    if len(both) < 3:
        return None
    return similarity_closed_form(*(np.array([of[name] for name in both]) for of in (mine, theirs)))


def spread(metres: Sequence[float], degrees: Sequence[float]) -> dict[str, float]:
    """Medians and largest of errors of positions and orientations; NaN where there are none."""
    return {
        f"{name}_{unit}": float(of(errors)) if len(errors) else float("nan")
        for unit, errors in (("m", metres), ("deg", degrees))
        for name, of in (("median", np.median), ("largest", np.max))
    }


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Print the figures as JSON, and write them to a path; numbers that are not finite become null."""
    text = json.dumps(plain(figures), indent=1) + "\n"
    sys.stdout.write(text)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
