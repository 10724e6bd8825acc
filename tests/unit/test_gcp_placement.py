"""Placement by control points on blocks with exact truth: accuracy, wrong marks, covariance, every gate."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.register.control.maps import vertical_of
from ingest.register.control.placement import GcpOptions, GcpPlacement, place_by_gcp
from ingest.register.control.report import residual_table
from tests.support.control import LOCAL_FROM_BLOCK, SurveyedBlock, moved_mark, surveyed_block

_OPTIONS = GcpOptions()


@pytest.fixture(scope="module")
def world() -> SurveyedBlock:
    return surveyed_block()


def _noisy(world: SurveyedBlock, sigma_m: float, seed: int = 1) -> FloatArray:
    return world.control_local + np.random.default_rng(seed).normal(0, sigma_m, world.control_local.shape)


def _flat(surveyed: FloatArray) -> FloatArray:
    return np.column_stack([surveyed[:, :2], np.full(len(surveyed), np.nan)])


def _errors(world: SurveyedBlock, placed: GcpPlacement) -> FloatArray:
    """Where the placed points lie minus where they truly are (n, 3)."""
    assert placed.block is not None
    return placed.block.xyz - LOCAL_FROM_BLOCK.act(world.block.xyz)


def test_points_with_heights_place_the_block(world: SurveyedBlock) -> None:
    control = world.control(_noisy(world, 0.02))
    placed = place_by_gcp(world.block, control, _OPTIONS)
    assert placed.accepted, placed.message
    assert np.abs(np.median(_errors(world, placed), axis=0)).max() < 0.03
    assert all(p.used for p in placed.points)
    assert all(m.used for m in placed.marks)
    assert placed.local_from_block is not None
    difference = (placed.local_from_block @ LOCAL_FROM_BLOCK.inverse()).log()
    # Over 4 m of relief the lens trades against the cameras' height, and the covariance says so.
    assert placed.covariance is not None
    assert (np.abs(difference) < 3.5 * np.sqrt(np.diag(placed.covariance))).all()
    assert np.abs(difference[1:4]).max() < 0.004
    assert abs(difference[0]) < 0.01
    # Surveyed 20 mm off: the residuals must show about that, and more for a point that takes no part.
    assert 0.01 < placed.residual_rms_m < 0.05
    for p in placed.points:
        assert np.linalg.norm(p.leave_one_out_m) > np.linalg.norm(p.residual_m)


def test_without_heights_the_ground_is_level_and_that_is_said(world: SurveyedBlock) -> None:
    placed = place_by_gcp(world.block, world.control(_flat(_noisy(world, 0.02))), _OPTIONS)
    assert placed.accepted, placed.message
    assert placed.covariance is not None
    assert any("level" in note for note in placed.notes)
    errors = _errors(world, placed)
    assert np.median(np.hypot(*errors[:, :2].T)) < 0.25
    sigma = np.sqrt(np.diag(placed.covariance))
    assert sigma[6] == pytest.approx(1000.0, rel=0.01)  # nothing says the height
    assert np.degrees(sigma[1:3]).max() < 3.5  # relief of 4 m tells a little of the tilt
    # The shape's tilt against the truth is within what the covariance claims.
    assert placed.local_from_block is not None
    difference = (placed.local_from_block @ LOCAL_FROM_BLOCK.inverse()).log()
    assert np.abs(difference[1:3]).max() < 3.5 * sigma[1:3].max()
    assert all(np.isnan(p.residual_m[2]) for p in placed.points)


def test_without_heights_a_placement_says_tilt_and_height(world: SurveyedBlock) -> None:
    covariance = np.diag([1e-4, *[np.radians(0.3) ** 2] * 3, 4.0, 4.0, 9.0])
    shift = Sim3.exp([0.01, 0.003, -0.002, 0.05, 2.0, -1.0, 2.5])
    before = shift @ LOCAL_FROM_BLOCK
    vertical = vertical_of(before, covariance, world.block.xyz, "the map's placement by gps")
    placed = place_by_gcp(world.block, world.control(_flat(_noisy(world, 0.02))), _OPTIONS, vertical=vertical)
    assert placed.accepted, placed.message
    assert placed.covariance is not None
    errors = _errors(world, placed)
    assert np.abs(np.median(errors[:, :2], axis=0)).max() < 0.1
    # The height is the earlier placement's, 2.5 m off, and its three metres of doubt are in the covariance.
    before_height = np.median((before.act(world.block.xyz) - LOCAL_FROM_BLOCK.act(world.block.xyz))[:, 2])
    assert np.median(errors[:, 2]) == pytest.approx(before_height, abs=0.2)
    assert np.sqrt(placed.covariance[6, 6]) == pytest.approx(3.0, rel=0.1)


@pytest.mark.parametrize("heights", [True, False])
def test_a_shifted_mark_is_named(world: SurveyedBlock, heights: bool) -> None:
    surveyed = _noisy(world, 0.02)
    key = sorted(world.marks)[5]
    marks = moved_mark(world.marks, key, (48.0, -36.0))
    control = world.control(surveyed if heights else _flat(surveyed), marks)
    placed = place_by_gcp(world.block, control, _OPTIONS)
    assert placed.accepted, placed.message
    wrong = [m for m in placed.marks if not m.used]
    assert [(m.mark.point, m.mark.photo) for m in wrong] == [(f"p{key[0]}", f"{key[1]}.jpg")]
    assert wrong[0].error_px == pytest.approx(60.0, abs=4.0)
    assert "px off: probably the wrong target" in residual_table(placed)
    assert all(p.used for p in placed.points)


def test_two_swapped_marks_are_named_with_what_they_show(world: SurveyedBlock) -> None:
    photo = 4
    first, second = [key for key in sorted(world.marks) if key[1] == photo][:2]
    marks = {**world.marks, first: world.marks[second], second: world.marks[first]}
    placed = place_by_gcp(world.block, world.control(_noisy(world, 0.02), marks), _OPTIONS)
    assert placed.accepted, placed.message
    remarks = {m.mark.point: m.remark for m in placed.marks if not m.used}
    assert set(remarks) == {f"p{first[0]}", f"p{second[0]}"}
    assert f"it lies on p{second[0]}" in remarks[f"p{first[0]}"]
    assert f"it lies on p{first[0]}" in remarks[f"p{second[0]}"]


def test_wrong_coordinates_are_named(world: SurveyedBlock) -> None:
    surveyed = _noisy(world, 0.02)
    surveyed[3] += [1.5, -2.0, 0.0]
    placed = place_by_gcp(world.block, world.control(surveyed), _OPTIONS)
    assert placed.accepted, placed.message
    (wrong,) = [p for p in placed.points if not p.used]
    assert wrong.name == "p3"
    np.testing.assert_allclose(wrong.residual_m, [1.5, -2.0, 0.0], atol=0.12)
    assert "p3 is 2.5" in wrong.remark


@pytest.mark.evaluation
def test_covariance_covers_the_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normalised squared errors of the seven parameters average about seven, and points lie where it says."""
    # The world's lens is known and its noise is white; what lenses leave open would make the covariance wide.
    exact = replace(_OPTIONS, keep_lens=True)
    monkeypatch.setattr("ingest.register.control.adjust._DILUTION", 1.0)
    scores, inside = [], []
    for trial in range(6):
        world = surveyed_block(seed=trial, points=7, marks_of_point=3)
        placed = place_by_gcp(world.block, world.control(_noisy(world, 0.05, seed=trial)), exact)
        assert placed.accepted, placed.message
        assert placed.covariance is not None
        assert placed.local_from_block is not None
        error = (LOCAL_FROM_BLOCK @ placed.local_from_block.inverse()).log()
        scores.append(float(error @ np.linalg.solve(placed.covariance, error)))
        inside.append(np.abs(error) <= 2.0 * np.sqrt(np.diag(placed.covariance)))
    assert 3.0 < np.mean(scores) < 14.0
    assert np.mean(inside) > 0.85


def test_few_points_are_refused(world: SurveyedBlock) -> None:
    marks = {key: xy for key, xy in world.marks.items() if key[0] < 2}
    placed = place_by_gcp(world.block, world.control(world.control_local, marks), _OPTIONS)
    assert placed.reason == "TOO_FEW"
    assert "2 control points" in placed.message


def test_points_at_one_place_are_refused(world: SurveyedBlock) -> None:
    control = world.control(world.control_local)
    together = replace(control, surveyed=np.tile(control.surveyed[0], (len(control.names), 1)))
    assert place_by_gcp(world.block, together, _OPTIONS).reason == "DEGENERATE_LINE"


def test_points_that_do_not_fit_are_refused(world: SurveyedBlock) -> None:
    """Coordinates dealt to the wrong points fit no similarity."""
    dealt = np.random.default_rng(4).permutation(world.control_local)
    assert place_by_gcp(world.block, world.control(dealt), _OPTIONS).reason == "RESIDUALS"


def test_exchanged_columns_are_refused(world: SurveyedBlock) -> None:
    """x and y exchanged make a mirror image, which fits flat ground from below."""
    mirrored = world.control_local[:, [1, 0, 2]]
    assert place_by_gcp(world.block, world.control(mirrored), _OPTIONS).reason == "UPSIDE_DOWN"
    assert place_by_gcp(world.block, world.control(_flat(mirrored)), _OPTIONS).reason == "RESIDUALS"


def test_a_scale_that_is_not_known_is_refused(world: SurveyedBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ingest.register.control.placement._MAX_SCALE_SIGMA", 1e-5)
    assert place_by_gcp(world.block, world.control(_noisy(world, 0.05)), _OPTIONS).reason == "SCALE"


def test_another_zone_contradicts_gps(world: SurveyedBlock) -> None:
    gps = LOCAL_FROM_BLOCK.act(world.block.centers()) + np.array([3_000.0, 0.0, 0.0])
    control = world.control(world.control_local)
    placed = place_by_gcp(world.block, control, _OPTIONS, gps_local=gps, gps_sigma_m=(5.0, 10.0))
    assert placed.reason == "CONTRADICTS_GPS"
    assert "3,000 m" in placed.message
    near = place_by_gcp(
        world.block, control, _OPTIONS, gps_local=gps - np.array([2_990.0, 0.0, 0.0]), gps_sigma_m=(5.0, 10.0)
    )
    assert near.accepted


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "told"),
    [
        ((0.0, 0.0, 20.0), (0.02, 0.02), ["GPS heights are 20."]),
        ((0.0, 0.0, 400.0), (0.02, 0.02), ["no datum explains that"]),
        ((0.0, 0.0, -20.0), (0.02, 0.02), ["below those of the control points"]),
        ((1.5, -2.0, 0.0), (0.02, 0.02), ["GPS is 2."]),
        ((0.03, 0.0, 0.05), (0.02, 0.02), []),
        ((3.0, -4.0, 15.0), (4.0, 10.0), []),  # a plain receiver's
    ],
)
def test_an_offset_of_the_photos_gps_is_told_beyond_noise(
    world: SurveyedBlock, off_m: tuple[float, ...], sigma_m: tuple[float, float], told: list[str]
) -> None:
    noise = np.random.default_rng(4).normal(0, 0.02, (len(world.block.names), 3))
    gps = LOCAL_FROM_BLOCK.act(world.block.centers()) + noise + np.array(off_m)
    gps[2] += 60.0  # one receiver without a fix
    control = world.control(_noisy(world, 0.02))
    placed = place_by_gcp(world.block, control, _OPTIONS, gps_local=gps, gps_sigma_m=sigma_m)
    assert placed.accepted, placed.message
    notes = [note for note in placed.notes if "GPS" in note]
    assert len(notes) == len(told)
    assert all(words in note for words, note in zip(told, notes, strict=True))
    found = np.array(placed.figures["gps_offset_m"]) - off_m
    assert (np.abs(found) < 2.0 * np.array(placed.figures["gps_offset_sigma_m"])).all()


def test_gps_without_heights_says_nothing_of_them(world: SurveyedBlock) -> None:
    gps = LOCAL_FROM_BLOCK.act(world.block.centers())
    gps[:, 2] = np.nan
    control = world.control(world.control_local)
    placed = place_by_gcp(world.block, control, _OPTIONS, gps_local=gps, gps_sigma_m=(0.02, 0.02))
    assert placed.figures["gps_offset_m"][2] is None
    assert not any("GPS" in note for note in placed.notes)


def test_marks_that_cannot_be_used_are_told(world: SurveyedBlock) -> None:
    first = sorted(world.marks)[0]
    text_marks = {**world.marks, (0, 77): np.array([10.0, 20.0]), first: np.array([5_000.0, 10.0])}
    control = world.control(world.control_local, text_marks)
    reasons = {mark.photo: reason for mark, reason in control.unused}
    assert "no photo 77.jpg" in reasons["77.jpg"]
    assert "outside" in reasons[f"{first[1]}.jpg"]
    table = residual_table(place_by_gcp(world.block, control, _OPTIONS))
    assert "mark of p0 in 77.jpg" in table
