"""How good are the answers on the simulated world, and do their reported uncertainties mean something?

    uv run python tools/simulated_evaluation.py --out DIR [--seed 1]

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
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from featuredb.features.decode import decode_gray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.negatives import NEGATIVE_KINDS
from featuredb.simworld.scoring import PoseError, pose_error, summarise
from featuredb.simworld.world import World
from featuredb.store import Database
from ingest.demo import ingest_world, make_world
from reloc.localise.result import LocaliseResult
from reloc.localiser import Localiser
from reloc.service.handler import localise_request
from reloc.wire.query import LocaliseWireRequest
from tools.calibration import RECEIVERS, Calibration, as_reported, over_placements
from tools.figures import study_parser, write_figures

_DRAWS = 300  # of placements


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
    asked = ask_world(world, localiser)
    drone = [a for a in asked if a.group == "drone"]
    answers = [(a.result.pose, a.true_in_area) for a in drone if a.result.pose and a.true_in_area]
    area = localiser.areas[0].area
    calibrations = {"as ingested": as_reported(answers)}
    for receiver in RECEIVERS:
        calibrations[receiver.name] = over_placements(answers, area, world, receiver, _DRAWS, args.seed)
    sys.stdout.write(f"{accuracy_table(asked)}\n\n{calibration_table(calibrations)}\n\n")
    coverage = {name: asdict(one.coverage) for name, one in calibrations.items()}
    write_figures(args.json, {"coverage": coverage} | flat_figures(asked))
    return 0


def prepare(args: argparse.Namespace) -> tuple[World, Database]:
    """The world and the database of its drone photos, made unless they are there."""
    start = time.monotonic()
    world = make_world(args.out / "world", size="full", seed=args.seed, exact_gps=True)
    database = Database.create(args.out / "db")
    if not database.snapshot().maps():
        ingest_world(world, database, args.out / "report", exact_gps=True)
    sys.stdout.write(f"world and map: {time.monotonic() - start:.0f} s\n")
    sys.stdout.flush()
    return world, database


def ask_world(world: World, localiser: Localiser) -> list[Asked]:
    """Ask for every photo that is not in the map."""
    asked = [_ask(world, localiser, "drone", p) for p in world.images("queries")]
    asked += [_ask(world, localiser, "street", p) for p in world.images("street")]
    for kind in NEGATIVE_KINDS:
        asked += [_ask(world, localiser, kind, p) for p in world.negatives(kind)]
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


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("simulated-evaluation"))
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
