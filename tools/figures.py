"""What programs that measure something share: arguments, errors, and figures for the scoreboard."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.stats import chi2

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp, so3_log
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from featuredb.maps.feature_map import FeatureMap
from featuredb.plain_json import plain
from ingest.register.frame_registration import FramePrior

_SHARED: dict[str, dict[str, Any]] = {
    "--json": {"metavar": "FILE", "help": "write the figures there, too"},
    "--photos": {"metavar": "FOLDER", "required": True},
    "--scan": {"metavar": "LAZ", "required": True},
    "--work": {"metavar": "FOLDER", "required": True, "help": "what is made is kept there"},
    "--inputs": {"metavar": "FOLDER", "help": "keep worlds and films there"},
    "--held-out": {"type": str, "nargs": "+", "required": True, "metavar": "NAME"},
    "--seed": {"type": int, "default": 1, "help": "of what is drawn; default: 1"},
    "film": {"metavar": "FILM"},
    "folder": {"metavar": "FOLDER"},
    "folders": {"metavar": "FOLDER", "nargs": "+"},
    "scan": {"metavar": "LAZ"},
}
_LEVELS = (0.68, 0.95)
T = TypeVar("T")
Values = Sequence[float] | FloatArray


class StudyParser(argparse.ArgumentParser):
    """Makes the folder of --work, which is that of --inputs as well where none is told."""

    def parse_args(self, *args: Any, **more: Any) -> Any:
        told = super().parse_args(*args, **more)
        if "work" in told:
            told.work.mkdir(parents=True, exist_ok=True)
        if "inputs" in told:
            told.inputs = told.inputs or told.work
        return told


def study_parser(doc: str | None, *shared: str) -> StudyParser:
    """The parser of a program, with --json and the shared arguments of these names; `doc`: of its module."""
    parser = StudyParser(description=(doc or "").split("\n")[0])
    for name in ("--json", *shared):
        parser.add_argument(name, **{"type": Path, **_SHARED[name]})
    return parser


def pose_offset(pose: Rigid3, true: Rigid3) -> FloatArray:
    """(6,) rotation (rad) before displacement of the camera (m), from a cam_from_local to the true one."""
    turn = so3_log(true.rotation.T @ pose.rotation)
    return np.concatenate([turn, true.center - pose.center])


def off_pose(pose: Rigid3, rng: np.random.Generator, off_m: float, off_deg: float) -> Rigid3:
    """A pose that is wrong by so much, to some side and about some axis."""
    way, axis = (value / np.linalg.norm(value) for value in rng.normal(size=(2, 3)))
    return Rigid3.from_center(so3_exp(np.radians(off_deg) * axis) @ pose.rotation, pose.center + off_m * way)


def prior_off_by(pose: Rigid3, off_m: float, off_deg: float) -> FramePrior:
    """What a pose is worth that may be so far off in space, and about any axis."""
    return FramePrior.around(pose, off_m / float(np.sqrt(3.0)), off_deg / float(np.sqrt(3.0)))


def laid_on(mine: Mapping[str, FloatArray], theirs: Mapping[str, FloatArray]) -> Sim3 | None:
    """The similarity that takes places (3,) onto those of the same names; None where these are too few."""
    both = sorted(mine.keys() & theirs.keys())
    if len(both) < 3:
        return None
    return similarity_closed_form(*(np.array([of[name] for name in both]) for of in (mine, theirs)))


def laid_poses(poses: Mapping[str, Rigid3], onto: Mapping[str, Rigid3]) -> dict[str, Rigid3]:
    """Poses `cam_from_local`, moved by the similarity that takes their centres onto those of the same names;
    none where these are too few."""
    sim = laid_on(*({name: pose.center for name, pose in of.items()} for of in (poses, onto)))
    return {name: sim.act_on_pose(pose) for name, pose in poses.items()} if sim else {}


def laid_apart(mine: Mapping[str, FloatArray], theirs: Mapping[str, FloatArray]) -> list[float]:
    """Metres (n,) between places of the same names, once laid on each other; NaN where these are too few."""
    sim, both = laid_on(mine, theirs), sorted(mine.keys() & theirs.keys())
    return [float(np.linalg.norm(sim.act(mine[n]) - theirs[n])) if sim else float("nan") for n in both]


def few(values: Sequence[T], count: int) -> Sequence[T]:
    """So many at the most, spread over all."""
    return values[:: max(1, len(values) // count)][:count]


def median(values: Values) -> float:
    """NaN of none."""
    return float(np.median(values)) if len(values) else float("nan")


def spread(metres: Values, degrees: Values | None = None) -> dict[str, float]:
    """Medians and largest of errors of positions, and of orientations; NaN where there are none."""
    figures: dict[str, float] = {}
    for unit, errors in {"m": metres, "deg": degrees}.items():
        if errors is None:
            continue
        figures |= {f"median_{unit}": median(errors), f"largest_{unit}": float(max(errors, default=np.nan))}
    return figures


def poses_in(frame: LocalFrame, feature_map: FeatureMap) -> dict[str, Rigid3]:
    """`cam_from_local` of a map's images in a local frame, by name."""
    here = feature_map.frame.enu_from(frame)
    return {image.name: image.cam_from_local @ here for image in feature_map.images}


def pose_errors(poses: Mapping[str, Rigid3], true: Mapping[str, Rigid3]) -> tuple[FloatArray, FloatArray]:
    """Metres and degrees (n,) between poses and true ones, of the names of both."""
    both = [(pose, true[name]) for name, pose in poses.items() if name in true]
    metres = np.array([np.linalg.norm(pose.center - other.center) for pose, other in both])
    return metres, np.array([pose.angle_to_deg(other) for pose, other in both])


def squared(error: FloatArray, covariance: FloatArray) -> float:
    """An error (d,), squared, in units of its covariance (d, d)."""
    return float(error @ np.linalg.solve(covariance, error))


def inside(squares: Values, level: float, size: int = 3) -> float:
    """Share of squared errors of `size` axes that lie inside the bound of that level; NaN of none."""
    return float(np.mean(np.asarray(squares) <= chi2.ppf(level, size))) if len(squares) else float("nan")


def inside_figures(name: str, squares: Values, size: int = 3) -> dict[str, float]:
    """Shares of squared errors inside 68 and 95 %, as NAME_68 and NAME_95."""
    return {f"{name}_{100 * level:.0f}": inside(squares, level, size) for level in _LEVELS}


def bounds_figures(found: Sequence[Mapping[str, Sequence[float]]]) -> dict[str, float]:
    """Of squared errors of three axes by name, of several maps: `inside_figures`, the worst; of all, those
    outside 99.9 %."""
    figures: dict[str, float] = {"outside": 0}
    for name in found[0] if found else ():
        of = [value for squares in found for value in squares[name]]
        figures |= inside_figures(name, of) | {f"{name}_worst": max(of, default=float("nan"))}
        figures["outside"] += sum(value > chi2.ppf(0.999, 3) for value in of)
    return figures


def say(text: str) -> None:
    """Print a line at once, with the time."""
    sys.stdout.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stdout.flush()


def kept(path: Path, make: Callable[[], Any]) -> Any:
    """What a JSON file says, which `make` gives once: a study that was stopped goes on behind it."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(make()), encoding="utf-8")
        say(f"{path.stem}: {path.read_text(encoding='utf-8')}")
    return json.loads(path.read_text(encoding="utf-8"))


def write_figures(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Print the figures as JSON, and write them to a path; numbers that are not finite become null."""
    text = json.dumps(plain(figures), indent=1) + "\n"
    sys.stdout.write(text)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
