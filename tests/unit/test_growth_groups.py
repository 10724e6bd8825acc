"""Two localised photos and their matches: rays that meet, pairs that vouch for each other or do not."""

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from ingest.growth.place.component import intersections, poses_fit
from tests.support.localised_photos import localised_photo
from tests.support.scenes import CAMERA, box_points, ring


def test_rays_meet_in_the_points() -> None:
    points = box_points(np.random.default_rng(1), 50)
    a, b = ring(8)[:2]
    pixels = [CAMERA.project(pose.act(points)) for pose in (a, b)]
    found, angle = intersections((localised_photo(a), localised_photo(b)), (pixels[0], pixels[1]))
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
    _, angle = intersections((localised_photo(a), localised_photo(turned)), (pixels[0], pixels[1]))
    assert angle.max() < 1e-3


@pytest.mark.parametrize(
    ("wrong", "apart", "agrees"),
    [
        (5, True, True),
        (25, True, False),  # the matches say otherwise than the poses
        (0, False, False),  # one spot, or one picture twice
    ],
)
def test_when_matches_bear_two_poses_out(wrong: int, apart: bool, agrees: bool) -> None:
    """Of fifty matches the wrong ones are of other points."""
    points = box_points(np.random.default_rng(1), 50)
    a, b = ring(8)[:2] if apart else ring(8)[:1] * 2
    pixels = CAMERA.project(a.act(points))
    others = CAMERA.project(b.act(np.concatenate([np.roll(points[:wrong], 1, axis=0), points[wrong:]])))
    assert poses_fit(localised_photo(a), localised_photo(b), pixels, others) is agrees
