"""A pose from matches and prior together, against closed forms and against the matches alone."""

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from ingest.register.frame.features.matching import FrameMatches
from ingest.register.frame.prior_fit import (
    fitted_under_prior,
    loosened,
    prior_information,
    prior_residual,
    prior_sigmas,
)
from ingest.register.frame_registration import FramePrior
from reloc.localise.options import PoseOptions
from reloc.localise.pose import PoseHypothesis

DOWN = np.diag([1.0, -1.0, -1.0])
LONG_LENS = Camera(model="SIMPLE_PINHOLE", width=400, height=400, params=(3300.0, 200.0, 200.0))


def looking_down(center: list[float], turned_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Rigid3:
    """A nadir camera turned about east, north and up."""
    rotation = DOWN @ so3_exp(-np.radians(turned_deg))
    return Rigid3(rotation=rotation, translation=-rotation @ np.array(center))


def prior_at(pose: Rigid3, heading: float = 3.0) -> FramePrior:
    return FramePrior(
        cam_from_local=pose,
        sigma_horizontal_m=10.0,
        sigma_vertical_m=20.0,
        sigma_heading_deg=heading,
        sigma_tilt_deg=2.0,
    )


def seen_by(camera: Camera, pose: Rigid3, points: FloatArray) -> FrameMatches:
    return FrameMatches(pixels=camera.project(pose.act(points)), points=points)


def start(pose: Rigid3, camera: Camera, count: int) -> PoseHypothesis:
    return PoseHypothesis(
        cam_from_local=pose,
        camera=camera,
        camera_source="request",
        inliers=np.ones(count, dtype=bool),
    )


@pytest.mark.parametrize(
    ("center", "turned", "expected"),
    [
        ([10.0, 0.0, 0.0], (0.0, 0.0, 0.0), [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ([0.0, -5.0, 40.0], (0.0, 0.0, 0.0), [0.0, -0.5, 2.0, 0.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], (4.0, 0.0, 0.0), [0.0, 0.0, 0.0, 2.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], (0.0, 3.0, 0.0), [0.0, 0.0, 0.0, 0.0, 1.5, 0.0]),
        ([0.0, 0.0, 0.0], (0.0, 0.0, 6.0), [0.0, 0.0, 0.0, 0.0, 0.0, 2.0]),
    ],
)
def test_residual_by_axis(
    center: list[float], turned: tuple[float, float, float], expected: list[float]
) -> None:
    residual = prior_residual(looking_down(center, turned), prior_at(looking_down([0.0, 0.0, 0.0])))
    np.testing.assert_allclose(residual, expected, atol=1e-9)


def test_unknown_heading_counts_nothing_and_leaves_tilt() -> None:
    unknown = prior_at(looking_down([0.0, 0.0, 0.0]), heading=180.0)
    turned = looking_down([0.0, 0.0, 0.0])
    for angle in (90.0, 170.0, -120.0):
        rotation = turned.rotation @ so3_exp([0.0, 0.0, np.radians(angle)])
        assert prior_sigmas(unknown, Rigid3(rotation=rotation, translation=np.zeros(3))) < 1e-9


def test_information_is_that_of_the_deviations() -> None:
    pose = looking_down([3.0, 4.0, 100.0])
    wanted = 1.0 / np.array([*np.radians([2.0, 2.0, 3.0]), 10.0, 10.0, 20.0]) ** 2
    np.testing.assert_allclose(prior_information(pose, prior_at(pose)), np.diag(wanted), rtol=1e-5, atol=1e-6)
    loose = prior_information(pose, loosened(prior_at(pose)))
    np.testing.assert_allclose(loose, np.diag(wanted) / 4.0, rtol=1e-5, atol=1e-6)


def test_what_matches_leave_open_the_prior_decides() -> None:
    """From 1000 m with a long lens over flat ground a displacement and a tilt look alike."""
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-55, 55, (150, 2)), np.zeros(150)])
    truth = looking_down([0.0, 0.0, 1000.0])
    exact = seen_by(LONG_LENS, truth, points)
    matches = FrameMatches(pixels=exact.pixels + rng.normal(0.0, 1.5, (150, 2)), points=points)
    slid = looking_down([0.0, 40.0, 1000.0], (-np.degrees(np.arctan(0.04)), 0.0, 0.0))
    options = PoseOptions(tolerance_rel=0.02)
    apart = np.linalg.norm(LONG_LENS.project(slid.act(points)) - exact.pixels, axis=1)
    assert np.median(apart) < 3.0  # matches hardly tell the two apart
    found = fitted_under_prior(matches, start(slid, LONG_LENS, 150), prior_at(truth), options)
    assert prior_sigmas(prior_at(truth), slid) > 4.0
    assert prior_sigmas(prior_at(truth), found.cam_from_local) < 1.0
    left = LONG_LENS.project(found.cam_from_local.act(points)) - exact.pixels
    assert np.sqrt(np.mean(left**2)) < 0.6  # and the picture is where it was


def test_what_matches_determine_the_prior_does_not_move() -> None:
    rng = np.random.default_rng(5)
    camera = Camera(model="SIMPLE_PINHOLE", width=800, height=600, params=(640.0, 400.0, 300.0))
    points = np.column_stack([rng.uniform(-40, 40, (200, 2)), rng.uniform(0, 15, 200)])
    truth = looking_down([0.0, 0.0, 60.0], (5.0, -3.0, 20.0))
    matches = seen_by(camera, truth, points)
    noisy = FrameMatches(pixels=matches.pixels + rng.normal(0.0, 0.5, (200, 2)), points=points)
    wrong = prior_at(looking_down([8.0, -6.0, 75.0], (6.0, -3.0, 18.0)))
    found = fitted_under_prior(noisy, start(truth, camera, 200), wrong, PoseOptions())
    assert np.linalg.norm(found.cam_from_local.center - truth.center) < 0.03
    assert found.cam_from_local.angle_to_deg(truth) < 0.03


def test_few_matches_leave_the_pose() -> None:
    pose = looking_down([1.0, 2.0, 50.0])
    points = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 5.0, 0.0]])
    given = start(pose, LONG_LENS, 3)
    matches = seen_by(LONG_LENS, pose, points)
    assert fitted_under_prior(matches, given, prior_at(pose), PoseOptions()) is given
