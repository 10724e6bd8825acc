"""Walls of a scan as straight lines, what stands behind them, and which way is up in a map of a street."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import OwnFrame
from ingest.register.anchor.ground.scan_shape import fitted, shape_of
from ingest.register.anchor.ground.street_plan import street_plan
from tests.support.scanned_map import plain_cloud
from tests.support.street_map import OWN_FROM_LOCAL, street_map

_TURN = np.radians(23.0)
_ROTATION = np.array([[np.cos(_TURN), -np.sin(_TURN)], [np.sin(_TURN), np.cos(_TURN)]])


def _house(rng: np.random.Generator, eaves_m: float = 0.0) -> FloatArray:
    """Eight points a square metre of ground, and of a house of 24 x 10 m, 6 m high, that is turned."""
    xy = rng.uniform(-40.0, 40.0, (8 * 80 * 80, 2))
    within = (np.abs(xy @ _ROTATION) < np.array([12.0, 5.0]) + eaves_m).all(axis=1)
    return np.column_stack([xy, 6.0 * within + rng.normal(0.0, 0.03, len(xy))])


@pytest.mark.parametrize("seed", range(4))
def test_walls_lie_on_the_lines_of_a_roof(seed: int) -> None:
    shape = shape_of(plain_cloud(_house(np.random.default_rng(seed))), None)
    assert shape is not None
    place, out = shape.walls[:, :2] @ _ROTATION, shape.walls[:, 2:4] @ _ROTATION
    side = np.abs(out).argmax(axis=1)
    rows = np.arange(len(place))
    off = np.abs(place[rows, side]) - np.array([12.0, 5.0])[side]
    assert len(np.unique(np.column_stack([side, np.sign(out[rows, side])]), axis=0)) == 4
    assert np.abs(off).max() < 0.25
    assert np.abs(off).mean() < 0.08
    assert np.degrees(np.arccos(np.abs(out[rows, side]))).max() < 2.0


def test_a_view_through_a_house_is_seen() -> None:
    shape = shape_of(plain_cloud(_house(np.random.default_rng(0))), None)
    assert shape is not None
    rays = np.array([[0.0, -20.0, 0.0, 20.0], [-30.0, -30.0, -30.0, 30.0]])
    assert [shape.through(ray[None]) for ray in rays] == [1.0, 0.0]


def test_eaves_do_not_change_the_size_of_a_map() -> None:
    """All around a house whose roof sticks out by 0.3 m."""
    rng = np.random.default_rng(0)
    shape = shape_of(plain_cloud(_house(rng, eaves_m=0.3)), None)
    assert shape is not None
    t, h = rng.uniform(-1.0, 1.0, (3000, 2)) * [[12.0, 5.0]], rng.uniform(0.5, 5.5, 3000)
    side, sign = rng.integers(0, 2, 3000), rng.choice([-1.0, 1.0], 3000)
    t[np.arange(3000), side] = sign * np.array([12.0, 5.0])[side]
    ground = np.column_stack([rng.uniform(-20.0, 20.0, (1000, 2)), np.zeros(1000)])
    ground = ground[(np.abs(ground[:, :2] @ _ROTATION) > [13.0, 6.0]).any(axis=1)]
    points = np.vstack([np.column_stack([t @ _ROTATION.T, h]), ground])
    start = Sim3(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
    known, widths = np.diag([1e-3] * 8), (0.5, 0.3, 0.15)
    free = fitted(shape, points, start, known, widths)
    assert abs(free.local_from_own.scale - 1.0) < 0.015
    assert free.eaves_m == pytest.approx(0.3, abs=0.08)
    without = fitted(shape, points, start, known + np.diag([0.0] * 7 + [1e9]), widths)
    assert without.local_from_own.scale > 1.02


@pytest.mark.parametrize("photo", [0, 5])
def test_photos_on_edge_do_not_turn_a_map_upside_down(photo: int) -> None:
    street = street_map(mirrored=False)
    images = list(street.images)
    on_edge = Rigid3(rotation=so3_exp([0.0, 0.0, 0.5 * np.pi]), translation=np.zeros(3))
    images[photo] = replace(images[photo], cam_from_local=on_edge @ images[photo].cam_from_local)
    plan = street_plan(replace(street, images=tuple(images), frame=OwnFrame(metric=False, upright=False)))
    assert plan is not None
    up = plan.upright_from_own.rotation @ OWN_FROM_LOCAL.rotation @ [0.0, 0.0, 1.0]
    assert up[2] > 0.99
