"""Verdicts of the programs that measure growth: each line holds, and fails where it should."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from featuredb.geo.local_frame import LocalFrame
from featuredb.simworld.world import Truth
from tools import growth_community, growth_poison, growth_walk
from tools.growth_common import Album, Registered, Verdict, world_told
from tools.growth_poison import PoisonOutcome
from tools.growth_walk import Probe, Step, worst_ratio
from tools.worlds.album import AlbumFact
from tools.worlds.community import CommunityOptions
from tools.worlds.walk_world import WalkOptions

WALK = WalkOptions()


def test_another_seed_is_another_world(tmp_path: Path) -> None:
    def told(*words: str) -> CommunityOptions:
        return world_told("", CommunityOptions, ["--work", str(tmp_path / "kept"), *words])[1]

    assert told() == CommunityOptions(seed=1)
    assert told("--seed", "7") == CommunityOptions(seed=7)
    assert (tmp_path / "kept").is_dir()


def fact(i: int, kind: str = "drone") -> AlbumFact:
    return AlbumFact(
        name=f"photos/anna/{i}.jpg",
        photo_id=str(i),
        kind=kind,
        owner="anna",
        licence="CC0-1.0",
        time=datetime(2025, 1, 1, tzinfo=UTC),
        home=kind == "drone",
    )


def album(facts: list[AlbumFact]) -> Album:
    frame = LocalFrame(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0)
    truth = Truth(seed=1, epsg=32632, frame=frame, images={})
    return Album(folder=Path(), truth=truth, facts={f.name: f for f in facts}, rows={})


def placed(f: AlbumFact, error_m: float | None, status: str = "active", drift_m: float = 0.3) -> Registered:
    return Registered(
        fact=f,
        map_id="m1",
        status=status,
        generation=1,
        offset_m=None if error_m is None else np.array([0.0, error_m, 0.0]),
        drift_m=drift_m,
        bound_m=2.0 * drift_m,
    )


def holding(verdicts: list[Verdict]) -> dict[str, bool]:
    return {v.name: v.holds for v in verdicts}


def test_a_community_that_registers_well_holds() -> None:
    facts = [fact(i) for i in range(10)] + [fact(20, "other_town")]
    found = [placed(f, 0.1) for f in facts[:7]]
    assert all(holding(growth_community.judge(album(facts), found)).values())


@pytest.mark.parametrize(
    ("line", "change"),
    [
        ("registered", lambda found: found[:6]),
        ("registered", lambda found: [replace(r, status="quarantined") for r in found]),
        ("median error", lambda found: [replace(r, offset_m=np.array([0.4, 0.0, 0.0])) for r in found]),
        ("foreign photos", lambda found: [*found, placed(fact(20, "other_town"), None)]),
        ("wrong by more than 2 m", lambda found: [*found[1:], placed(fact(0), 2.1)]),
    ],
)
def test_each_line_of_the_community_can_fail(line: str, change) -> None:  # type: ignore[no-untyped-def]
    facts = [fact(i) for i in range(10)] + [fact(20, "other_town")]
    found = change([placed(f, 0.1) for f in facts[:7]])
    assert not holding(growth_community.judge(album(facts), found))[line]


def steps(ratio: float = 0.5, stopped: int = 0, reach: float = 700.0, drift: float = 0.4) -> list[Step]:
    probes = tuple(Probe(error_m=0.1, normalised=2.0) for _ in range(10))
    return [Step(step=0, reach_m=reach, drift_m=drift, ratio=ratio, stopped=stopped, failed=0, probes=probes)]


def test_a_walk_holds_and_each_of_its_lines_can_fail() -> None:
    good = steps(stopped=9)
    assert all(holding(growth_walk.judge(good, good[0], 1, WALK)).values())
    near = steps(reach=100.0, stopped=9)
    assert not holding(growth_walk.judge(near, good[0], 1, WALK))["coverage follows"]
    whole_m = WALK.end_m - WALK.start_m
    for reach, holds in ((whole_m - 1.0, False), (whole_m, True)):  # nothing need stop who has arrived
        assert holding(growth_walk.judge(steps(reach=reach, stopped=0), good[0], 1, WALK))["budget"] == holds
    far = steps(ratio=1.2)
    assert not holding(growth_walk.judge(far, good[0], 1, WALK))["true error inside the bound"]
    over = steps(drift=0.6, stopped=9)
    assert not holding(growth_walk.judge(over, good[0], 1, WALK))["budget"]
    assert not holding(growth_walk.judge(good, good[0], 2, WALK))["second anchor"]
    off = replace(good[0], probes=(replace(good[0].probes[0], error_m=0.31, normalised=20.0),))
    assert not holding(growth_walk.judge(good, off, 1, WALK))["second anchor"]
    assert not holding(growth_walk.judge([off], good[0], 1, WALK))["probes inside their 95 %"]
    # One wrong answer at one early step, among any number of right ones.
    astray = replace(good[0], probes=(replace(good[0].probes[0], error_m=2.1), *good[0].probes))
    assert not holding(growth_walk.judge([astray, *good], good[0], 1, WALK))["no wrong answer"]


def test_the_worst_map_is_the_one_nearest_to_its_bound_on_earth() -> None:
    first = [placed(fact(i), 0.1, drift_m=0.4) for i in range(5)]
    second = [replace(placed(fact(i), 0.08, drift_m=0.1), map_id="m2") for i in range(5, 10)]
    assert worst_ratio([*first, *second]) == pytest.approx(0.4)


def test_poison_that_gets_in_fails() -> None:
    clean = PoisonOutcome(sent=10, active=0, wrong={}, off_share=0.0)
    good = {"changed": True, "restored": True}
    assert all(holding(growth_poison.judge(clean, 0.01, good)).values())
    for bad in (replace(clean, wrong={"mirrored": 1}), replace(clean, off_share=0.03)):
        assert not holding(growth_poison.judge(bad, 0.01, good))["poison"]
    assert holding(growth_poison.judge(replace(clean, off_share=0.03), 0.02, good))["poison"]
    for bad in ({"changed": True, "restored": False}, {"changed": False, "restored": True}):
        assert not holding(growth_poison.judge(clean, 0.01, bad))["retire"]
    held = replace(clean, forced=1, restored=False)
    assert not holding(growth_poison.judge(held, 0.01, good))["retire"]
