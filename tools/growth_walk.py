"""A walk away from the anchor, from contributed queries alone: does coverage follow, and is the bound true?

The world is that of `tools.worlds.walk_world`. Step by step the photos of three people are contributed
and `featuredb grow` runs once. After each step photos that nobody contributes (probes) of all steps so far
ask where they were taken, and the new maps are compared with the truth. When everything has arrived, the
survey at the far end is ingested and growth runs again.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from ingest.growth.values import DRIFT_BUDGET_M
from reloc.localiser import Localiser
from tools.figures import say, squared
from tools.growth_common import Album, GrowthStudy, Registered, Verdict, answer_of, conclude, surveyed
from tools.growth_gates import WRONG_M
from tools.worlds.album import AlbumFact
from tools.worlds.walk_world import WalkOptions, plan_walk

_SURVEYS_M = 150.0  # of the way, which needs no coverage by others
_AFTER_M = 0.3
_INSIDE = float(chi2.ppf(0.95, 3))
_PROBE_SHARE = 0.90  # of the probes inside their 95 %: of a few dozen, more may miss by chance


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """One held-out photo asked: error and squared normalised error of the answer."""

    error_m: float | None
    normalised: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What a step came to.

    Attributes:
        reach_m: distance from the anchor's edge to the furthest photo in an active map.
        drift_m: largest claimed of active maps. ratio: of the length of the median error of the map that is
            worst against its bound on Earth, over that bound.
        stopped: photos that wait for the drift budget. failed: photos lost by an exception.
    """

    step: int
    reach_m: float
    drift_m: float
    ratio: float
    stopped: int
    failed: int
    probes: tuple[Probe, ...]


def main() -> None:
    args, world, study = surveyed(__doc__, WalkOptions, plan_walk)
    steps = []
    for batch in sorted({f.batch for f in study.album.of("walk")}):
        study.give(study.album.of("walk", batch=batch))
        steps.append(measure(study, batch))
        say(f"{steps[-1]}")
    end, commits = second_anchor(study)
    conclude(args.json, judge(steps, end, commits, world), sum(s.failed for s in (*steps, end)))


def measure(study: GrowthStudy, batch: int) -> Step:
    """Grow once: maps and probes of all steps up to this one against the truth."""
    waiting, album = study.grown(), study.album
    edge = max(_along(album, f) for f in album.of("survey"))
    active = [r for r in study.registered() if r.generation > 0 and r.status == "active"]
    return Step(
        step=batch,
        reach_m=max((_along(album, r.fact) - edge for r in active), default=0.0),
        drift_m=max((r.drift_m or 0.0 for r in active), default=0.0),
        ratio=worst_ratio(active),
        stopped=waiting["DRIFT_BUDGET"],
        failed=waiting["FAILED"],
        probes=tuple(ask_probes(study, batch)),
    )


def worst_ratio(found: Sequence[Registered]) -> float:
    """True error of the map that is worst against its bound on Earth, over that bound."""
    ratios = [0.0]
    for map_id in {r.map_id for r in found}:
        mine = [r for r in found if r.map_id == map_id and r.offset_m is not None]
        true = float(np.linalg.norm(np.median([r.offset_m for r in mine], axis=0)))
        ratios.append(true / max(mine[0].bound_m, 1e-6))
    return max(ratios)


def ask_probes(study: GrowthStudy, upto: int) -> list[Probe]:
    """Ask for every probe of the steps so far."""
    localiser, album = Localiser.open(study.database), study.album
    probes = []
    for fact in (fact for fact in album.of("probe") if fact.batch <= upto):
        pose = answer_of(localiser, album.folder / fact.name).pose
        error, normalised = None, None
        if pose is not None:
            center = album.truth.frame.enu_from(pose.frame).act(pose.cam_from_local.center)
            offset = center - album.truth.images[fact.name].cam_from_local.center
            error, normalised = float(np.linalg.norm(offset)), squared(offset, pose.covariance[3:, 3:])
        probes.append(Probe(error_m=error, normalised=normalised))
    return probes


def second_anchor(study: GrowthStudy) -> tuple[Step, int]:
    """Ingest the far survey, grow, measure; also in how many commits the maps that were there moved."""
    database, version = study.database, study.database.poll_version()
    study.anchor("survey_far")
    end = measure(study, max(f.batch for f in study.album.of("walk")))
    snapshots = (database.snapshot(v) for v in range(version, database.poll_version() + 1))
    first, *later = ({m.map_id: m.write_id for m in snapshot.maps()} for snapshot in snapshots)
    moved = [
        any(now[i] != old[i] for i in now.keys() & old.keys() & first)
        for old, now in pairwise([first, *later])
    ]
    return end, sum(moved)


def judge(steps: Sequence[Step], end: Step, commits: int, world: WalkOptions) -> list[Verdict]:
    """The contract's lines."""
    wanted = world.end_m - world.start_m - _SURVEYS_M
    reach, ratio, over = (max(getattr(s, name) for s in steps) for name in ("reach_m", "ratio", "drift_m"))
    stopped = next((s for s in steps if s.stopped), None)
    asked = [p.normalised for p in steps[-1].probes if p.normalised is not None]
    inside = sum(value <= _INSIDE for value in asked)
    answers = [p.error_m for s in (*steps, end) for p in s.probes if p.error_m is not None]
    errors = [p.error_m for p in end.probes if p.error_m is not None]
    whole = reach >= world.end_m - world.start_m
    why = "the whole way is covered" if whole else "not stopped"
    if stopped is not None:
        why = f"stopped for the budget at step {stopped.step + 1}"
    return [
        Verdict(
            "coverage follows",
            f"{reach:.0f} m from the anchor's edge, {wanted:.0f} m wanted",
            reach >= wanted,
        ),
        Verdict(
            "true error inside the bound",
            f"at most {ratio:.2f} of the 95 % on Earth at every step",
            ratio <= 1.0,
        ),
        Verdict(
            "probes inside their 95 %",
            f"{inside} of {len(asked)} along the whole way; mean squared normalised error "
            f"{np.mean(asked):.1f}",
            bool(asked) and inside >= _PROBE_SHARE * len(asked),
        ),
        Verdict(
            "no wrong answer",
            f"{sum(e > WRONG_M for e in answers)} of {len(answers)} answers at any step more than "
            f"{WRONG_M} m off, worst {max(answers, default=float('nan')):.2f} m",
            bool(answers) and max(answers) <= WRONG_M,
        ),
        Verdict(
            "budget",
            f"largest claimed drift of an active map {over:.2f} of {DRIFT_BUDGET_M:.2f} m, {why}",
            over <= DRIFT_BUDGET_M and (whole or stopped is not None),
        ),
        Verdict(
            "second anchor",
            f"worst of {len(errors)} answered probes {max(errors, default=float('nan')):.3f} m of "
            f"{_AFTER_M} m; {len(errors)} of {len(end.probes)} answered; maps moved in {commits} commits",
            bool(errors) and max(errors) < _AFTER_M and commits == 1,
        ),
    ]


def _along(album: Album, fact: AlbumFact) -> float:
    """Coordinate along the way: the direction from the first survey to the far one."""
    start, end = (
        np.mean([album.truth.images[f.name].cam_from_local.center[:2] for f in album.of(kind)], axis=0)
        for kind in ("survey", "survey_far")
    )
    way, place = end - start, album.truth.images[fact.name].cam_from_local.center[:2]
    return float((place - start) @ way / np.linalg.norm(way))


if __name__ == "__main__":
    main()
