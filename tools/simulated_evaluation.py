"""How good are the answers on the simulated world, and do their reported uncertainties mean something?

    python -m tools.simulated_evaluation --out DIR [--seed 1]

Makes a world whose drone photos carry exact positions, ingests them (both are kept in DIR and reused), asks
for every held-out photo and every negative, and compares with the truth:

- held-out drone photos within 0.25 m and 0.3 degrees;
- wrong answers, more than 5 m off, and answers to negatives, which have no place at all;
- shares of errors within the reported 68 % radii, over placements (tools/calibration.py).
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.negatives import NEGATIVE_KINDS
from featuredb.simworld.scoring import PoseError, pose_difference, summarise
from featuredb.simworld.world import World
from featuredb.store import Database
from ingest.demo import ingest_world, make_world
from reloc.localise.result import LocalisedPose
from reloc.localiser import Localiser
from tools.calibration import inside_over_placements
from tools.figures import study_parser, write_figures
from tools.growth_common import answer_of

_DRAWS = 300  # of placements


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """One query.

    Attributes:
        group: drone, street, or the kind of negative.
        pose: the answer; None where not localised.
        error: against the truth; None likewise, or where there is none.
        true_in_area: true cam_from_local in the frame of the answer; None likewise.
    """

    group: str
    pose: LocalisedPose | None
    error: PoseError | None
    true_in_area: Rigid3 | None


def main(argv: Sequence[str] | None = None) -> int:
    parser = study_parser(__doc__, "--seed")
    parser.add_argument("--out", type=Path, default=Path("simulated-evaluation"))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    world = make_world(args.out / "world", size="full", seed=args.seed, exact_gps=True)
    database = Database.create(args.out / "db")
    if not database.snapshot().maps():
        ingest_world(world, database, args.out / "report", exact_gps=True)
    localiser = Localiser.open(database)
    asked = ask_world(world, localiser)
    drone = [a for a in asked if a.group == "drone"]
    answers = [(a.pose, a.true_in_area) for a in drone if a.pose and a.true_in_area]
    inside = inside_over_placements(answers, localiser.areas[0].area, world, _DRAWS, args.seed)
    write_figures(args.json, inside | flat_figures(asked))
    return 0


def ask_world(world: World, localiser: Localiser) -> list[Asked]:
    """Ask for every photo that is not in the map."""
    asked = [_ask(world, localiser, "drone", p) for p in world.images("queries")]
    asked += [_ask(world, localiser, "street", p) for p in world.images("street")]
    for kind in NEGATIVE_KINDS:
        asked += [_ask(world, localiser, kind, p) for p in world.negatives(kind)]
    return asked


def _ask(world: World, localiser: Localiser, group: str, path: Path) -> Asked:
    pose = answer_of(localiser, path).pose
    name = path.relative_to(world.folder).as_posix()
    true, frame = world.truth.images.get(name), world.truth.frame
    if pose is None or true is None:
        return Asked(group=group, pose=pose, error=None, true_in_area=None)
    return Asked(
        group=group,
        pose=pose,
        error=pose_difference(frame, true.cam_from_local, pose.epsg, pose.utm, pose.cam_from_utm_xyzw),
        true_in_area=true.cam_from_local @ frame.enu_from(pose.frame),
    )


def flat_figures(asked: Sequence[Asked]) -> dict[str, float]:
    """Answers to held-out drone photos with their errors; answers where there should be none."""
    drone = summarise([a.error for a in asked if a.group == "drone"])
    negatives = [a for a in asked if a.group in NEGATIVE_KINDS]
    street = [a for a in asked if a.group == "street"]
    return {
        "asked": drone.queries,
        "answered": sum(a.pose is not None for a in asked if a.group == "drone"),
        "within": drone.within,
        "median_m": drone.position_m[0],
        "median_deg": drone.angle_deg[0],
        "wrong": sum(a.error is not None and a.error.position_m > 5.0 for a in asked),
        "negatives": len(negatives),
        "negatives_answered": sum(a.pose is not None for a in negatives),
        "street": len(street),
        "street_answered": sum(a.pose is not None for a in street),
    }


if __name__ == "__main__":
    sys.exit(main())
