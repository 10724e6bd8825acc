"""Star of poses around a prior, and the fan of headings."""

import numpy as np
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from ingest.register.frame.views import (
    MAX_ARM_SHARE,
    MIN_ARM_SHARE,
    UPRIGHT_REACH_DEG,
    fan_headings_deg,
    star_poses,
    turned_about_vertical,
)
from ingest.register.frame_registration import FramePrior

CAMERA = Camera.from_focal(1600, 1200, 1200.0)
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])


def prior(sigma_m: float, rotation: np.ndarray = DOWN, heading: float = 5.0) -> FramePrior:
    center = np.array([3.0, -4.0, 60.0])
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        sigma_horizontal_m=sigma_m,
        sigma_vertical_m=sigma_m,
        sigma_heading_deg=heading,
        sigma_tilt_deg=1.0,
    )


def offsets(p: FramePrior) -> np.ndarray:
    """Displacements of the star's views in camera axes, metres."""
    poses = star_poses(p, 60.0, CAMERA)
    return np.array([p.cam_from_local.act(pose.center) for pose in poses])


def test_seven_views_sideways_and_along_the_axis() -> None:
    moved = offsets(prior(6.0))
    assert len(moved) == 7
    np.testing.assert_allclose(moved[0], 0.0, atol=1e-9)
    for axis in range(3):
        along = moved[np.abs(moved[:, axis]) > 1e-6]
        assert len(along) == 2
        assert along[0, axis] * along[1, axis] < 0
        np.testing.assert_allclose(np.delete(along, axis, axis=1), 0.0, atol=1e-9)


def test_arms_grow_with_the_uncertainty_up_to_what_is_seen() -> None:
    arms = [np.abs(offsets(prior(sigma))[1:5]).max() for sigma in (0.01, 6.0, 10.0, 1000.0)]
    seen = 60.0 * 1200 / 1200.0
    assert arms[0] == pytest.approx(MIN_ARM_SHARE * seen)
    assert arms[1] == pytest.approx(1.5 * np.hypot(6.0, 60.0 * np.radians(1.0)))
    assert arms[1] < arms[2] < arms[3]
    assert arms[3] == pytest.approx(MAX_ARM_SHARE * seen)


def test_views_keep_the_rotation_and_zoom_within_bounds() -> None:
    p = prior(500.0, rotation=DOWN @ so3_exp([0.4, 0.1, -0.3]))
    poses = star_poses(p, 60.0, CAMERA)
    assert all(pose.angle_to_deg(p.cam_from_local) < 1e-9 for pose in poses)
    depth = 60.0 - np.array([p.cam_from_local.act(pose.center)[2] for pose in poses])
    assert depth.min() == pytest.approx(60.0 / 1.4)
    assert depth.max() == pytest.approx(60.0 * 1.4)


def test_fan_covers_the_circle_when_nothing_is_known() -> None:
    angles = np.sort(np.mod(fan_headings_deg(180.0), 360.0))
    gaps = np.diff([*angles, angles[0] + 360.0])
    assert len(angles) == 12
    assert gaps.max() <= 2.0 * UPRIGHT_REACH_DEG + 1e-9


@pytest.mark.parametrize(("sigma", "count"), [(5.0, 1), (7.5, 1), (10.0, 3), (30.0, 5)])
def test_fan_covers_two_sigmas(sigma: float, count: int) -> None:
    angles = fan_headings_deg(sigma)
    assert angles[0] == 0.0
    assert len(angles) == count
    assert max(angles) + UPRIGHT_REACH_DEG >= 2.0 * sigma


def test_turn_about_the_vertical_is_clockwise_from_above() -> None:
    looking_north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    p = prior(1.0, rotation=looking_north)
    turned = turned_about_vertical(p.cam_from_local, 90.0)
    np.testing.assert_allclose(turned.rotation[2], [1.0, 0.0, 0.0], atol=1e-12)  # the axis now points east
    np.testing.assert_allclose(turned.center, p.cam_from_local.center, atol=1e-9)
