"""`featuredb register --gcp` as typed: residuals, a new placement, the old one within reach, refusals."""

import argparse
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import run_command
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, Placement
from featuredb.store import Database
from ingest.cli.register import register
from ingest.register.block import block_of_map, map_of_block
from tests.support.control import FRAME, SurveyedBlock, control_text, moved_mark, surveyed_block
from tests.support.maps import without_place
from tests.support.scenes import random_descriptors, scene_map

_SHIFT = Sim3.exp([0.01, 0.005, -0.004, 0.02, 3.0, -4.0, 9.0])


def _run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers(required=True))
    parsed = parser.parse_args(["register", *map(str, arguments)])
    return run_command(parsed.run, parsed)


@pytest.fixture(scope="module")
def world() -> SurveyedBlock:
    return surveyed_block(seed=3)


def _misplaced_map(world: SurveyedBlock) -> FeatureMap:
    """The world's map as GPS might have placed it: metres off."""
    true = world.block.moved(world.local_from_block)
    descriptors = random_descriptors(np.random.default_rng(0), len(true.xyz))
    exact = scene_map(points=true.xyz, descriptors=descriptors, poses=true.cam_from_block, map_id="hills")
    placement = Placement(
        method="gps",
        local_from_sfm=_SHIFT,
        covariance=np.diag([1e-4, 1e-4, 1e-4, 1e-3, 9.0, 9.0, 36.0]),
        residual_rms_m=2.0,
    )
    return map_of_block(exact, block_of_map(exact).moved(_SHIFT), FRAME, placement, "unknown")


def test_a_map_moves_to_its_control_points_and_back(
    world: SurveyedBlock, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = Database.create(tmp_path / "db")
    before = _misplaced_map(world)
    first = database.commit_map(before)
    key = sorted(world.marks)[4]
    marks = {**moved_mark(world.marks, key, (50.0, 30.0)), (0, 99): np.array([5.0, 6.0])}
    survey = tmp_path / "gcp_list.txt"
    survey.write_text(control_text(world.control_local, marks))

    # The first letters of the id are enough.
    arguments = (tmp_path / "db", "hil", "--gcp", survey, "--height-datum", "ellipsoidal")
    assert _run(*arguments, "--dry-run") == 0
    assert database.snapshot().version == first.version
    assert _run(*arguments, "--report", tmp_path / "report") == 0
    out = capsys.readouterr().out
    assert f"mark of p{key[0]} in {key[1]}.jpg" in out
    assert "no photo 99.jpg in the map" in out

    after = database.snapshot().load_map("hills")
    assert (after.placement.method, after.height_datum, after.generation) == ("gcp", "ellipsoidal", 0)
    truth = world.local_from_block.act(world.block.xyz)
    assert np.linalg.norm(before.points_local() - truth, axis=1).min() > 5.0
    assert np.median(np.linalg.norm(after.points_local(FRAME) - truth, axis=1)) < 0.05
    centers = np.array([image.cam_from_local.center for image in after.images])
    # The principal point is not known either, and trades against where the cameras stand.
    assert np.abs(centers - world.local_from_block.act(world.block.centers())).max() < 0.2
    assert after.points.error_px.mean() < 0.6
    evidence = json.loads((tmp_path / "report" / "control.json").read_text())
    assert [m["used"] for m in evidence["marks"]].count(False) == 1
    page = (tmp_path / "report" / "control.html").read_text(encoding="utf-8")
    assert len(page.split("data:image/png;base64,")[1]) > 5_000
    # The old place is still there, in the past and by rollback.
    old = database.snapshot(first.version).load_map("hills")
    np.testing.assert_array_equal(old.points.utm, before.points.utm)
    database.rollback(first.version)
    assert database.snapshot().load_map("hills").placement.method == "gps"


def test_control_points_place_a_map_that_had_no_place(
    world: SurveyedBlock, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = Database.create(tmp_path / "db")
    unplaced = without_place(_misplaced_map(world), world.local_from_block.inverse())
    first = database.commit_map(unplaced)
    survey = tmp_path / "gcp_list.txt"
    survey.write_text(control_text(world.control_local[:2], dict(itertools.islice(world.marks.items(), 8))))
    assert _run(tmp_path / "db", "hills", "--gcp", survey) == 1
    assert "TOO_FEW" in capsys.readouterr().out
    survey.write_text(control_text(world.control_local, world.marks))
    assert _run(tmp_path / "db", "hills", "--gcp", survey) == 0
    assert "had no place before" in capsys.readouterr().out
    after = database.snapshot().load_map("hills")
    assert (after.placement.method, after.status) == ("gcp", "active")
    truth = world.local_from_block.act(world.block.xyz)
    assert np.median(np.linalg.norm(after.points_local(FRAME) - truth, axis=1)) < 0.05
    placed = after.placement.local_from_sfm.act(unplaced.points.xyz)
    assert np.median(np.linalg.norm(placed - after.points_local(), axis=1)) < 0.2
    database.rollback(first.version)
    assert database.snapshot().load_unplaced("hills").no_place == unplaced.no_place


def test_a_refused_file_changes_nothing(
    world: SurveyedBlock, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = Database.create(tmp_path / "db")
    first = database.commit_map(_misplaced_map(world))
    survey = tmp_path / "gcp_list.txt"
    survey.write_text(control_text(np.roll(world.control_local, 3, axis=0) * [1, -1, 1], world.marks))
    assert _run(tmp_path / "db", "hills", "--gcp", survey) == 1
    assert "refused: " in capsys.readouterr().out
    survey.write_text("EPSG:32632\n1 2 3\n")
    assert _run(tmp_path / "db", "hills", "--gcp", survey) == 2
    assert "line 2" in capsys.readouterr().err
    assert _run(tmp_path / "db", "none", "--gcp", survey) == 2
    assert database.snapshot().version == first.version
