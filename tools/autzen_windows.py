"""Windows of an ortho image registered to an airborne scan as nadir telephoto photos, from intensity alone.

The scan is added to a database as any other; its colours are thrown away, for they may come from that ortho
image. Scan and image are laid on one grid, whose pixels are no finer than either. Each window of 400 x 400
pixels becomes the photo of a camera 1000 m above the ground, whose prior is wrong by 20 m in a random
direction of space and by 5 degrees about a random axis: on the ground, up to 107 m. It is registered by
`register_frame` as every photo is, with the defaults and a prior that says so.

An ortho image is laid over the ground: what stands above leans away from where the aircraft was, by as much
as the ground's map is wrong for it, and no camera takes such a picture. So before anything is registered a
window counts as having structure by these measures alone:

- at most half of it is higher than 3 m above the ground around, and
- of its parts of 25 x 25 pixels on the ground, at least a quarter have an edge in the ortho image and in the
  scan: a gradient (sigma 2 pixels) whose 95th percentile there is above the picture's own 75th percentile.

Ortho image and scan disagree, by an offset that is measured in each half before anything is registered
(`measured_offset`). A window's error is the root mean square, over 16 places of the window, of the distance
on the ground between where the pose puts them and where the ortho image and the offset of its half do.

No window lies in both the western and the eastern half. For each half the program prints what the product
accepts, and the limit of evidence that would be chosen there (the lowest with which nothing wrong and nothing
of another place is accepted) with what it gives in the other half.

Refused must be: mirrored windows, windows whose prior lies elsewhere in the scan, photos of other places.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import cycle, zip_longest
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.scans import list_scans
from ingest.register.frame.dense.confirmation import MIN_LOG_NFA
from ingest.register.frame.register import register_frame
from ingest.register.frame.verdict import SURE_CONFIRMATION_LOG_NFA
from tools.commands import cloud_of
from tools.figures import few, off_pose, prior_off_by, say, study_parser, write_figures
from tools.ortho_over_scan import (
    Floats,
    OrthoOverScan,
    Part,
    halves_of,
    has_structure,
    measured_offset,
    place_of,
)
from tools.photo_files import photo_names

_STEP_PX = 200  # between windows, at most
_MOST = 24  # windows of a half
_OTHERS = 44  # at least
_HEIGHT_M = 1000.0
_PRIOR_M, _PRIOR_DEG = 20.0, 5.0
_FAR_M = 200.0  # four deviations of the prior on the ground
_EACH = 8  # photos of a folder
_KINDS = ("window", "mirrored", "elsewhere", "photo")
_LIMIT_M, _WRONG_M = 2.0, 5.0


class _Trial(NamedTuple):
    """A picture, and the window at which it is looked for."""

    kind: str
    half: str
    column: int
    row: int
    photo: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowOutcome:
    """What became of one window; `error_m` is None where no pose was tried."""

    kind: str
    half: str
    has_structure: bool
    accepted: bool
    error_m: float | None
    log_nfa: float

    @property
    def close(self) -> bool:
        return self.error_m is not None and self.error_m <= _LIMIT_M

    @property
    def wrong(self) -> bool:
        """What must not be accepted."""
        return self.kind != "window" or self.error_m is None or self.error_m > _WRONG_M


def main() -> None:
    parser = study_parser(__doc__, "--seed", "scan")
    parser.set_defaults(seed=0)
    parser.add_argument("ortho", type=Path)
    parser.add_argument("--figure", type=Path, help="draw evidence against error")
    parser.add_argument("--photos", type=Path, nargs="*", default=[], help="folders of other places")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        cloud = replace(cloud_of(args.scan, Path(folder) / "db"), rgb=None)
        (scan,) = list_scans(Database.open(Path(folder) / "db"))
    place = place_of(args.ortho, scan.epsg, cloud)
    halves = halves_of(place)
    offsets = {name: measured_offset(place, part) for name, part in halves.items()}
    outcomes = []
    for number, trial in enumerate(_trials(place, halves, args.photos)):
        rng = np.random.default_rng([args.seed, number])
        outcomes.append(_one(place, cloud, trial, offsets[trial.half].metres, rng))
        say(f"column {trial.column}, row {trial.row}: {asdict(outcomes[-1])}")
    if args.figure is not None:
        _draw(outcomes, args.figure)
    sigma = {f"{name}_offset_sigma_m": float(np.linalg.norm(of.sigma)) for name, of in offsets.items()}
    write_figures(args.json, figures_of(outcomes) | sigma)


def _trials(place: OrthoOverScan, halves: Mapping[str, Part], folders: Sequence[Path]) -> Iterator[_Trial]:
    """Windows to be found and pictures to be refused; no window lies in both halves."""
    spots = [[(half, c, r) for c, r in _spots(place, part)] for half, part in halves.items()]
    both = [spot for pair in zip_longest(*spots) for spot in pair if spot is not None]

    def cut(c: int, r: int) -> NDArray[np.uint8]:
        return place.gray[r : r + place.window, c : c + place.window]

    for half, c, r in both:
        yield _Trial("window", half, c, r, cut(c, r))
    photos = [folder / name for folder in folders for name in few(photo_names(folder), _EACH)]
    for path, (half, c, r) in zip(photos, cycle(both), strict=False):
        gray = decode_gray(path)
        scale = 2.2 * place.window / max(gray.shape)
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        y, x = (gray.shape[0] - place.window) // 2, (gray.shape[1] - place.window) // 2
        photo = np.ascontiguousarray(gray[y : y + place.window, x : x + place.window])
        yield _Trial("photo", half, c, r, photo)
    # Those with structure first: they have something to agree by chance.
    both.sort(key=lambda spot: not has_structure(place, *spot[1:]))
    for number, (half, c, r) in zip(range(_OTHERS - len(photos)), cycle(both), strict=False):
        far = max(both, key=lambda spot: np.hypot(spot[1] - c, spot[2] - r))
        if number % 2 and np.hypot(far[1] - c, far[2] - r) * place.cell > _FAR_M:
            # The prior out of the search's reach.
            yield _Trial("elsewhere", *far, cut(c, r))
        else:
            yield _Trial("mirrored", half, c, r, np.ascontiguousarray(cut(c, r)[:, ::-1]))


def _spots(place: OrthoOverScan, part: Part) -> list[tuple[int, int]]:
    """Columns and rows of windows spread over a part of the grid."""
    rows, columns = (
        np.linspace(
            at.start, at.stop - place.window, -(-(at.stop - at.start - place.window) // _STEP_PX) + 1
        ).astype(int)
        for at in part
    )
    spots = [
        (int(c), int(r))
        for r in rows
        for c in columns
        if place.shown[r : r + place.window, c : c + place.window].mean() > 0.9
    ]
    return spots[:: -(-len(spots) // _MOST)] if spots else []


def _one(
    place: OrthoOverScan, cloud: PointCloud, trial: _Trial, offset: Floats, rng: np.random.Generator
) -> WindowOutcome:
    camera, truth = _nadir_camera(place, trial)
    prior = prior_off_by(off_pose(truth, rng, _PRIOR_M, _PRIOR_DEG), _PRIOR_M, _PRIOR_DEG)
    found = register_frame(trial.photo, camera, prior, cloud)
    tried = found.evidence.get("pose_tried")
    error = None
    if tried is not None:
        error = _ground_error(place, camera, Rigid3.from_matrix(tried), trial, offset)
    return WindowOutcome(
        kind=trial.kind,
        half=trial.half,
        has_structure=has_structure(place, trial.column, trial.row),
        accepted=found.accepted,
        error_m=error,
        log_nfa=found.evidence.get("confirmation", {}).get("log_nfa", 0.0),
    )


def _nadir_camera(place: OrthoOverScan, trial: _Trial) -> tuple[Camera, Rigid3]:
    """The camera that would have taken the window, north upwards."""
    window = (slice(trial.row, trial.row + place.window), slice(trial.column, trial.column + place.window))
    middle = place.on_ground(np.array([[trial.column, trial.row]]) + place.window / 2)[0]
    center = np.array([*middle, float(np.median(place.ground[window])) + _HEIGHT_M])
    camera = Camera.from_focal(place.window, place.window, _HEIGHT_M / place.cell, "SIMPLE_PINHOLE")
    return camera, Rigid3.from_center(np.diag([1.0, -1.0, -1.0]), center)


def _ground_error(place: OrthoOverScan, camera: Camera, pose: Rigid3, trial: _Trial, offset: Floats) -> float:
    each = np.array([1.0, 3.0, 5.0, 7.0]) * place.window / 8
    spots = np.array([(x, y) for y in each for x in each])
    pixels = spots + np.array([trial.column, trial.row])
    height = place.ground[tuple(pixels.astype(int).T[::-1])]
    rays = np.column_stack([camera.unproject(spots), np.ones(len(spots))]) @ pose.rotation
    found = pose.center + rays * ((height - pose.center[2]) / rays[:, 2])[:, None]
    wanted = place.on_ground(pixels) + offset
    return float(np.sqrt(((found[:, :2] - wanted) ** 2).sum(axis=1).mean()))


def _draw(outcomes: Sequence[WindowOutcome], path: Path) -> None:
    """Evidence of the pictures against the error on the ground, with the verdict's two lines."""
    chart = Figure(figsize=(7.5, 3.6), dpi=110, facecolor="white", layout="constrained")
    axes = chart.subplots()
    looks = {"window": ("o", "#2e7d32"), "mirrored": ("x", "#c62828"), "elsewhere": ("+", "#ad1457")}
    for kind in _KINDS:
        marker, colour = looks.get(kind, ("^", "#6a1b9a"))
        some = np.array(
            [(o.error_m, o.log_nfa) for o in outcomes if o.kind == kind and o.error_m is not None]
        )
        if len(some):
            axes.plot(some[:, 0], some[:, 1], marker, color=colour, ms=5, label=kind)
    for limit in (SURE_CONFIRMATION_LOG_NFA, MIN_LOG_NFA):
        axes.axhline(limit, color="#1b2733", lw=0.8, ls="--")
    axes.set(xscale="log", xlabel="error on the ground, m", ylabel="evidence, -log10(NFA)", ylim=(0, None))
    axes.legend(fontsize=8)
    axes.grid(color="#e6ebef", lw=0.6)
    chart.savefig(path)


def figures_of(outcomes: Sequence[WindowOutcome]) -> dict[str, float]:
    """What is accepted by the verdict, in all and in each half, and above the limit of the other half.

    That limit is the highest evidence of what must not be accepted there.
    """
    figures = _rates("", outcomes, [o for o in outcomes if o.accepted])
    figures["largest_m"] = max((o.error_m or 0.0 for o in outcomes if o.accepted), default=float("nan"))
    for half in sorted({o.half for o in outcomes}):
        here = [o for o in outcomes if o.half == half]
        limit = max((o.log_nfa for o in outcomes if o.half != half and o.wrong), default=0.0)
        figures |= _rates(f"{half}_", here, [o for o in here if o.accepted])
        figures |= _rates(f"{half}_chosen_", here, [o for o in here if o.log_nfa > limit])
        figures[f"{half}_chosen_limit"] = limit
    return figures


def _rates(name: str, outcomes: Sequence[WindowOutcome], passed: Sequence[WindowOutcome]) -> dict[str, float]:
    structured = sum(o.kind == "window" and o.has_structure for o in outcomes)
    close = sum(o.kind == "window" and o.has_structure and o.close for o in passed)
    return {
        f"{name}structured": structured,
        f"{name}close": close,
        f"{name}rate": close / max(structured, 1),
        f"{name}wrong": sum(o.kind == "window" and o.wrong for o in passed),
        f"{name}foreign": sum(o.kind != "window" for o in outcomes),
        f"{name}foreign_accepted": sum(o.kind != "window" for o in passed),
    }


if __name__ == "__main__":
    main()
