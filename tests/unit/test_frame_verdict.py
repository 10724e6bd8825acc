"""The verdict on a registered frame: every gate fires, and on its own."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from ingest.register.frame.dense.confirmation import PictureConfirmation, log_nfa_of
from ingest.register.frame.prior_fit import prior_sigmas
from ingest.register.frame.verdict import (
    FrameEvidence,
    asks_elsewhere,
    cells_with_inliers,
    verdict,
    weighed_log_nfa,
)
from ingest.register.frame_registration import FramePrior
from reloc.tracking.pose_fit import of_camera

CONFIRMED = PictureConfirmation(confirmed=True, pieces=150, agreeing=90, log_nfa=45.0, cells=16, message="")
GOOD = FrameEvidence(
    inliers=200,
    candidates=1500,
    log_nfa=30.0,
    confirmation=CONFIRMED,
    cells=60,
    agreement=0.7,
    rival_share=0.1,
    prior_sigmas=2.0,
    position_sigma_share=0.002,
)


def test_good_evidence_is_believed() -> None:
    assert verdict(GOOD) is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"inliers": 12}, "TOO_FEW_MATCHES"),
        ({"confirmation": replace(CONFIRMED, confirmed=False, message="no")}, "NOT_CONFIRMED"),
        ({"confirmation": replace(CONFIRMED, log_nfa=8.4), "log_nfa": 5.0}, "NOT_CONFIRMED"),
        ({"cells": 4}, "NO_CONSISTENT_POSE"),
        ({"agreement": 0.1}, "NO_CONSISTENT_POSE"),
        ({"rival_share": 0.6}, "AMBIGUOUS"),
        ({"position_sigma_share": 0.2}, "NO_CONSISTENT_POSE"),
        ({"prior_sigmas": 9.0}, "CONTRADICTS_PRIOR"),
    ],
)
def test_each_gate_fires(change: dict[str, object], reason: str) -> None:
    refusal = verdict(replace(GOOD, **change))  # type: ignore[arg-type]
    assert refusal is not None
    assert refusal[0] == reason


MIDDLING = replace(GOOD, log_nfa=0.0, confirmation=replace(CONFIRMED, agreeing=38, log_nfa=9.0))


def test_middling_evidence_is_believed_where_other_places_show_much_less() -> None:
    assert verdict(MIDDLING) is not None  # nobody has looked elsewhere
    assert asks_elsewhere(MIDDLING)
    assert verdict(replace(MIDDLING, places_elsewhere=2, elsewhere_log_nfa=0.4)) is None
    refusal = verdict(replace(MIDDLING, places_elsewhere=2, elsewhere_log_nfa=3.0))
    assert refusal is not None
    assert refusal[0] == "AMBIGUOUS"


def test_relief_needs_evidence_of_its_own() -> None:
    relief = replace(MIDDLING, places_elsewhere=5, relief_only=True)
    assert verdict(replace(relief, relief_only=False)) is None
    refusal = verdict(relief)
    assert refusal is not None
    assert refusal[0] == "NOT_CONFIRMED"
    assert verdict(replace(relief, confirmation=replace(CONFIRMED, log_nfa=25.0))) is None


def test_features_and_pictures_add_up() -> None:
    assert verdict(replace(MIDDLING, log_nfa=22.0)) is None
    assert verdict(replace(MIDDLING, log_nfa=20.0)) is not None


def test_middling_evidence_far_from_the_prior_is_refused() -> None:
    asked = replace(MIDDLING, places_elsewhere=5, confirmation=replace(CONFIRMED, log_nfa=7.7))
    assert verdict(replace(asked, prior_sigmas=2.4)) is None
    assert weighed_log_nfa(replace(asked, prior_sigmas=2.4)) == 7.7
    refusal = verdict(replace(asked, prior_sigmas=4.7))
    assert refusal is not None
    assert refusal[0] == "NOT_CONFIRMED"
    assert "4.7 deviations" in refusal[1]
    assert verdict(replace(GOOD, prior_sigmas=4.7)) is None  # features speak for it


def test_middling_evidence_is_refused_where_houses_stand_elsewhere() -> None:
    crossing = replace(CONFIRMED, agreeing=26, pieces=79, log_nfa=log_nfa_of(26, 79))
    asked = replace(MIDDLING, places_elsewhere=5, confirmation=crossing)
    assert verdict(asked) is None
    relief = replace(CONFIRMED, confirmed=False, agreeing=1, pieces=78, log_nfa=0.0)
    refusal = verdict(replace(asked, relief=relief))
    assert refusal is not None
    assert refusal[0] == "NOT_CONFIRMED"
    assert verdict(replace(asked, relief=replace(relief, agreeing=9))) is None
    assert (
        verdict(replace(asked, relief=replace(relief, agreeing=0, pieces=20))) is None
    )  # too few to be asked
    assert verdict(replace(GOOD, relief=relief)) is None  # features speak for it


def test_relief_takes_evidence_away_and_adds_none() -> None:
    relief = replace(CONFIRMED, agreeing=60, pieces=150)
    assert weighed_log_nfa(replace(MIDDLING, relief=relief)) == MIDDLING.confirmation.log_nfa


def test_elsewhere_is_asked_only_where_it_decides() -> None:
    assert not asks_elsewhere(GOOD)
    assert not asks_elsewhere(replace(MIDDLING, inliers=12))
    assert not asks_elsewhere(replace(MIDDLING, confirmation=replace(MIDDLING.confirmation, confirmed=False)))


def test_decisive_features_bear_silent_pictures_but_no_contradiction() -> None:
    silent = replace(
        GOOD, log_nfa=900.0, confirmation=replace(CONFIRMED, confirmed=False, pieces=10, log_nfa=0.0)
    )
    assert verdict(silent) is None
    contradicted = replace(silent, confirmation=replace(CONFIRMED, confirmed=False, log_nfa=0.0))
    assert verdict(contradicted) is not None
    assert verdict(replace(silent, log_nfa=20.0)) is not None


def prior(heading: float) -> FramePrior:
    return FramePrior(
        cam_from_local=Rigid3(rotation=np.diag([1.0, -1.0, -1.0]), translation=np.zeros(3)),
        sigma_horizontal_m=5.0,
        sigma_vertical_m=10.0,
        sigma_heading_deg=heading,
        sigma_tilt_deg=2.0,
    )


def posed(center: list[float], turn_local_deg: list[float]) -> Rigid3:
    rotation = np.diag([1.0, -1.0, -1.0]) @ so3_exp(np.radians(turn_local_deg))
    return Rigid3(rotation=rotation, translation=-rotation @ np.array(center))


def test_distance_from_the_prior_by_axis() -> None:
    assert prior_sigmas(prior(4.0), posed([10.0, 0.0, 0.0], [0.0, 0.0, 0.0])) == pytest.approx(2.0)
    assert prior_sigmas(prior(4.0), posed([0.0, 0.0, 30.0], [0.0, 0.0, 0.0])) == pytest.approx(3.0)
    assert prior_sigmas(prior(4.0), posed([0.0, 0.0, 0.0], [0.0, 0.0, 12.0])) == pytest.approx(3.0)
    assert prior_sigmas(prior(4.0), posed([0.0, 0.0, 0.0], [6.0, 0.0, 0.0])) == pytest.approx(3.0)


def test_unknown_heading_counts_nothing() -> None:
    assert prior_sigmas(prior(180.0), posed([0.0, 0.0, 0.0], [0.0, 0.0, 170.0])) == pytest.approx(
        0.0, abs=1e-6
    )
    assert prior_sigmas(prior(180.0), posed([0.0, 0.0, 0.0], [6.0, 0.0, 0.0])) == pytest.approx(3.0)


def test_cells_are_counted_where_the_scan_is_seen() -> None:
    camera = Camera.from_focal(1000, 1000, 900.0)
    valid = np.zeros((100, 100), bool)
    valid[:, :50] = True
    pixels = np.array([[x + 50.0, y + 50.0] for x in range(0, 300, 100) for y in range(0, 1000, 100)])
    assert cells_with_inliers(pixels, valid, camera) == (30, pytest.approx(0.6))


def test_covariance_changes_axes_as_finite_differences_say() -> None:
    pose = posed([4.0, -2.0, 9.0], [20.0, -10.0, 35.0])
    step = np.array(
        [1e-5, -2e-5, 3e-5, 2e-4, 1e-4, -3e-4]
    )  # turn about local axes, displacement of the centre
    rotation = (so3_exp(step[:3]) @ pose.rotation.T).T
    moved = Rigid3(rotation=rotation, translation=-rotation @ (pose.center + step[3:]))
    left = (moved @ pose.inverse()).log()
    # The centre's displacement and the turn are moved to the camera's origin, about which the pose turns.
    covariance = of_camera(pose.inverse(), np.outer(step, step))
    np.testing.assert_allclose(covariance, np.outer(left, left), rtol=1e-3, atol=1e-13)
