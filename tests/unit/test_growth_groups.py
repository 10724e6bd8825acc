"""Two localised photos and their matches: rays that meet, pairs that vouch for each other or do not."""

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from ingest.growth.place.groups import PairCheck, intersections
from tests.support.scenes import CAMERA, box_points, ring


def test_rays_meet_in_the_points() -> None:
    points = box_points(np.random.default_rng(1), 50)
    a, b = ring(8)[:2]
    pixels = [CAMERA.project(pose.act(points)) for pose in (a, b)]
    found, angle = intersections(CAMERA, a, pixels[0], CAMERA, b, pixels[1])
    assert np.abs(found - points).max() < 1e-6
    expected = [
        np.arccos(
            (p - a.center) @ (p - b.center) / np.linalg.norm(p - a.center) / np.linalg.norm(p - b.center)
        )
        for p in points
    ]
    assert angle == pytest.approx(expected, abs=1e-9)


def test_rays_from_one_spot_have_no_angle() -> None:
    points = box_points(np.random.default_rng(1), 10)
    (a,) = ring(1)
    turned = Rigid3.exp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]) @ a
    pixels = [CAMERA.project(pose.act(points)) for pose in (a, turned)]
    _, angle = intersections(CAMERA, a, pixels[0], CAMERA, turned, pixels[1])
    assert angle.max() < 1e-3


@pytest.mark.parametrize(
    ("verified", "fitting", "angle_deg", "agrees"),
    [
        (60, 0.9, 5.0, True),
        (19, 0.9, 5.0, False),  # too few matches
        (60, 0.6, 5.0, False),  # the matches say otherwise than the poses
        (60, 0.9, 0.5, False),  # one spot, or one picture twice
    ],
)
def test_when_a_pair_agrees(verified: int, fitting: float, angle_deg: float, agrees: bool) -> None:
    check = PairCheck(verified=verified, fitting=fitting, angle_deg=angle_deg)
    assert check.agrees is agrees
