"""How good are the answers on the simulated world, and do their reported uncertainties mean something?

    uv run python tools/simulated_evaluation.py --out DIR [--size full] [--seed 1]

Makes a world whose drone photos carry exact positions, ingests them (both are kept in DIR and reused), asks
for every held-out photo and every negative, and compares with the truth:

- accuracy: held-out drone photos within 0.25 m and 0.3 degrees; street photos beside them;
- wrong answers, more than 5 m off, and answers to negatives, which have no place at all, by kind;
- calibration as ingested: share of errors within the reported 68 % radii. The positions are exact to about a
  millimetre and ingested as good to three;
- calibration over placements: one map has one bias of its receiver, and 68 % of one means nothing. So the
  same reconstruction is placed again by many drawn positions, the answers move with it, and the errors of
  all draws are counted. Receivers: a survey's (2 cm, half of the variance shared by the flight); a consumer
  drone's as the simulated world has it, with its true standard deviations; the same with what EXIF
  suggests, which is larger than its errors, so that the radii have to come out too cautious. The
  reconstruction itself stays that of the exact positions.
  calibration.png shows normalised errors against their chi-square distribution.

Writes answers.csv, calibration.png, and the figures to --json. Exit code 0 if all figures hold, or are too
cautious where EXIF's sigmas were, else 1.
"""

import argparse
import csv
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from featuredb.features.decode import decode_gray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.negatives import NEGATIVE_KINDS
from featuredb.simworld.scoring import PoseError, pose_error, summarise
from featuredb.simworld.world import World, open_world
from featuredb.store import Database
from ingest.demo import ingest_world, make_world
from reloc.localise.result import LocaliseResult
from reloc.localiser import Localiser
from reloc.service.handler import localise_request
from reloc.wire.query import LocaliseWireRequest
from tools.calibration import RECEIVERS, Calibration, Coverage, as_reported, over_placements
from tools.figures import add_json_option, write_figures

mpl.use("Agg")  # no display is needed

WITHIN = 0.95  # least share of held-out drone photos within 0.25 m and 0.3 degrees
CAUTIOUS = {r.name for r in RECEIVERS if r.sigmas == "exif"}  # were told sigmas larger than their errors
LEAST_NEGATIVES = 200  # fewer say little about how rare wrong answers are


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """One query.

    Attributes:
        group: drone, street, or the kind of negative.
        error: against the truth; None where not localised, or where there is none.
        true_in_area: true cam_from_local in the frame of the answer; None likewise.
    """

    group: str
    name: str
    result: LocaliseResult
    error: PoseError | None
    true_in_area: Rigid3 | None


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    world, database = prepare(args)
    localiser = Localiser.open(database)
    asked = ask_world(world, localiser, args.limit)
    drone = [a for a in asked if a.group == "drone"]
    answers = [(a.result.pose, a.true_in_area) for a in drone if a.result.pose and a.true_in_area]
    area = localiser.areas[0].area
    calibrations = {"as ingested": as_reported(answers)}
    for receiver in RECEIVERS:
        calibrations[receiver.name] = over_placements(answers, area, world, receiver, args.draws, args.seed)
    figures = evaluate(asked, calibrations)
    sys.stdout.write(f"{accuracy_table(asked)}\n\n{calibration_table(calibrations)}\n\n")
    for name, (text, holds) in figures.items():
        sys.stdout.write(f"{'holds' if holds else 'FAILS'}  {name}: {text}\n")
    _write_csv(args.out / "answers.csv", asked)
    _plot(args.out / "calibration.png", calibrations)
    document: dict[str, Any] = {
        name: {"figure": text, "holds": holds} for name, (text, holds) in figures.items()
    }
    document["coverage"] = {name: asdict(one.coverage) for name, one in calibrations.items()}
    write_figures(args.json, document | flat_figures(asked))
    return 0 if all(holds for _, holds in figures.values()) else 1


def prepare(args: argparse.Namespace) -> tuple[World, Database]:
    """The world and the database of its drone photos, made unless they are there."""
    start = time.monotonic()
    if args.world is not None:
        world = open_world(args.world)
    else:
        world = make_world(args.out / "world", size=args.size, seed=args.seed, exact_gps=True)
    if args.db is not None:
        return world, Database.open(args.db)
    database = Database.create(args.out / "db")
    if not database.snapshot().maps():
        ingest_world(world, database, args.out / "report", exact_gps=True)
    sys.stdout.write(f"world and map: {time.monotonic() - start:.0f} s\n")
    sys.stdout.flush()
    return world, database


def ask_world(world: World, localiser: Localiser, limit: int | None) -> list[Asked]:
    """Ask for every photo that is not in the map; `limit` of each kind where given."""
    asked = [_ask(world, localiser, "drone", p) for p in world.images("queries")[:limit]]
    asked += [_ask(world, localiser, "street", p) for p in world.images("street")[:limit]]
    for kind in NEGATIVE_KINDS:
        asked += [_ask(world, localiser, kind, p) for p in world.negatives(kind)[:limit]]
    return asked


def _ask(world: World, localiser: Localiser, group: str, path: Path) -> Asked:
    """As a client asks that knows nothing but the file."""
    data = path.read_bytes()
    gray = decode_gray(data)
    result = localiser.localise(gray, localise_request(LocaliseWireRequest(), data, gray))
    name = path.relative_to(world.folder).as_posix()
    true, pose = world.truth.images.get(name), result.pose
    if pose is None or true is None:
        return Asked(group=group, name=name, result=result, error=None, true_in_area=None)
    return Asked(
        group=group,
        name=name,
        result=result,
        error=pose_error(world.truth, name, pose.epsg, pose.utm, pose.cam_from_utm_xyzw),
        true_in_area=true.cam_from_local @ world.truth.frame.enu_from(pose.frame),
    )


def evaluate(asked: Sequence[Asked], calibrations: dict[str, Calibration]) -> dict[str, tuple[str, bool]]:
    """Each promise with its figure and whether it holds."""
    drone = summarise([a.error for a in asked if a.group == "drone"])
    far = [a for a in asked if a.error is not None and a.error.position_m > 5.0]
    negatives = [a for a in asked if a.group in NEGATIVE_KINDS]
    invented = [a for a in negatives if a.result.pose is not None]
    figures = {
        "accuracy": (
            f"{drone.within:.1%} of {drone.queries} within 0.25 m and 0.3 degrees, {WITHIN:.0%} wanted",
            drone.within >= WITHIN,
        ),
        "wrong answers": (
            f"{len(far)} more than 5 m off, {len(invented)} to {len(negatives)} negatives, of which "
            f"{LEAST_NEGATIVES} are wanted",
            not far and not invented and len(negatives) >= LEAST_NEGATIVES,
        ),
    }
    for name, one in calibrations.items():
        verdict = one.coverage.verdict()
        expected = ("holds", "too cautious") if name in CAUTIOUS else ("holds",)
        figures[f"68 % radii, {name}"] = (f"{verdict}, {_shares(one.coverage)}", verdict in expected)
    return figures


def flat_figures(asked: Sequence[Asked]) -> dict[str, float]:
    """Answers to held-out drone photos with their errors; answers where there should be none."""
    drone = summarise([a.error for a in asked if a.group == "drone"])
    negatives = [a for a in asked if a.group in NEGATIVE_KINDS]
    street = [a for a in asked if a.group == "street"]
    return {
        "asked": drone.queries,
        "answered": sum(a.result.pose is not None for a in asked if a.group == "drone"),
        "within": drone.within,
        "median_m": drone.position_m[0],
        "median_deg": drone.angle_deg[0],
        "wrong": sum(a.error is not None and a.error.position_m > 5.0 for a in asked),
        "negatives": len(negatives),
        "negatives_answered": sum(a.result.pose is not None for a in negatives),
        "street": len(street),
        "street_answered": sum(a.result.pose is not None for a in street),
    }


def _shares(coverage: Coverage) -> str:
    return (
        f"{coverage.horizontal:.0%} horizontal, {coverage.vertical:.0%} vertical, "
        f"{coverage.orientation:.0%} orientation of {coverage.answers} errors inside"
    )


def accuracy_table(asked: Sequence[Asked]) -> str:
    """One line for each group."""
    lines = [
        f"{'photos':<12}{'asked':>6}{'answered':>10}{'median m':>10}{'95 % m':>8}{'median deg':>12}"
        f"{'95 % deg':>10}{'within':>8}{'wrong':>7}"
    ]
    for group in dict.fromkeys(a.group for a in asked):
        mine = [a for a in asked if a.group == group]
        answered = sum(a.result.pose is not None for a in mine)
        line = f"{group:<12}{len(mine):>6}{answered:>10}"
        if group in NEGATIVE_KINDS:
            lines.append(f"{line}{'no true place':>40}{'':>8}{answered:>7}")
            continue
        s = summarise([a.error for a in mine])
        lines.append(
            f"{line}{s.position_m[0]:>10.3f}{s.position_m[1]:>8.3f}{s.angle_deg[0]:>12.3f}"
            f"{s.angle_deg[1]:>10.3f}{s.within:>8.1%}{s.wrong:>7}"
        )
    return "\n".join(lines)


def calibration_table(calibrations: dict[str, Calibration]) -> str:
    """Coverage, and normalised errors at their quartiles over what chi-square has there."""
    lines = [
        f"{'errors inside 68 % radii':<28}{'errors':>8}{'hor':>7}{'ver':>7}{'rot':>7}"
        f"{'chi2(3) at 50 %':>18}{'90 %':>7}{'chi2(6) at 50 %':>18}{'90 %':>7}"
    ]
    for name, one in calibrations.items():
        if not len(one.inside):
            lines.append(f"{name:<28}{0:>8}")
            continue
        c = one.coverage
        ratios = [
            np.percentile(values, q) / chi2.ppf(q / 100, freedom)
            for values, freedom in ((one.squared_3, 3), (one.squared_6, 6))
            for q in (50, 90)
        ]
        lines.append(
            f"{name:<28}{c.answers:>8}{c.horizontal:>7.0%}{c.vertical:>7.0%}{c.orientation:>7.0%}"
            f"{ratios[0]:>18.2f}{ratios[1]:>7.2f}{ratios[2]:>18.2f}{ratios[3]:>7.2f}"
        )
    lines.append(
        f"chi2: squared normalised error over its expected quantile; 1 is calibrated, more is too sure. "
        f"{sum(one.refused for one in calibrations.values())} placements refused by a gate."
    )
    return "\n".join(lines)


def _plot(path: Path, calibrations: dict[str, Calibration]) -> None:
    columns = len(calibrations)
    figure, axes = plt.subplots(1, columns, figsize=(4 * columns, 4), layout="constrained", squeeze=False)
    end = float(np.sqrt(chi2.ppf(0.999, 6)))
    for axis, (name, one) in zip(axes[0], calibrations.items(), strict=True):
        for values, freedom, colour, what in (
            (one.squared_6, 6, "C0", "pose"),
            (one.squared_3, 3, "C1", "position"),
        ):
            share = (np.arange(len(values)) + 0.5) / max(len(values), 1)
            expected = np.sqrt(chi2.ppf(share, freedom))
            axis.plot(expected, np.sqrt(np.sort(values)), ".", color=colour, label=what)
        axis.plot([0, end], [0, end], "k-", linewidth=0.8)
        axis.set(
            title=f"{name}: {one.coverage.answers} errors",
            xlabel="expected normalised error",
            ylabel="normalised error",
            xlim=(0, end),
            ylim=(0, 1.5 * end),
        )
        axis.legend(loc="upper left")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _write_csv(path: Path, asked: Sequence[Asked]) -> None:
    columns = [
        *("group", "name", "reason", "camera", "inliers", "matches", "confidence"),
        *("east_m", "north_m", "up_m", "angle_deg"),
        *("horizontal_68_m", "vertical_68_m", "orientation_68_deg"),
    ]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=columns, restval="")
        writer.writeheader()
        for one in asked:
            result, pose = one.result, one.result.pose
            row: dict[str, Any] = {"group": one.group, "name": one.name, "reason": result.reason or ""}
            row |= {"inliers": result.inliers, "matches": result.matches, "confidence": result.confidence}
            if pose is not None:
                row |= {name: getattr(pose, name) for name in columns[-3:]} | {"camera": pose.camera_source}
            writer.writerow(row | (asdict(one.error) if one.error is not None else {}))


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("simulated-evaluation"))
    parser.add_argument("--size", choices=("short", "full"), default="full")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--draws", type=int, default=300, help="placements drawn; default: 300")
    parser.add_argument("--world", type=Path, default=None, help="a world with exact positions, made before")
    parser.add_argument("--db", type=Path, default=None, help="the database of its drone photos")
    parser.add_argument(
        "--limit", type=int, default=None, metavar="N", help="ask for N photos of each kind only"
    )
    add_json_option(parser)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
