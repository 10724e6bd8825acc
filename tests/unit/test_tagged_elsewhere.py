"""Photos whose positions agree on another place are found; those that are merely poor are not."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.bridge import Model
from ingest.register.gps import GpsPlacement, place_by_gps
from ingest.register.tagged_elsewhere import joined_wrongly, tagged_elsewhere
from tests.support.posed_models import model_of

_TWIN = (11, 12, 13)  # photos of a twin of the house that 10 shows
_SIGMA_M = 3.0


def walk() -> Model:
    """Twenty photos of a square, each of which shares half of its points with the next ones."""
    angles = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    centers = 60.0 * np.column_stack([np.cos(angles), np.sin(angles), 0.3 * np.cos(3 * angles)])
    poses = tuple(Rigid3(rotation=np.eye(3), translation=-center) for center in centers)
    return replace(model_of(*(range(50 * k, 50 * k + 100) for k in range(20))), cam_from_sfm=poses)


def close_walk() -> Model:
    """The same with photos that share four fifths with the next ones."""
    close = model_of(*(range(20 * k, 20 * k + 100) for k in range(20)))
    return replace(close, cam_from_sfm=walk().cam_from_sfm)


def placed(
    model: Model, off: Mapping[int, tuple[float, float]], without: Iterable[int] = ()
) -> tuple[list[int], GpsPlacement]:
    """Noisy positions, some off by east and north, some photos without one."""
    positions = model.centers() + np.random.default_rng(4).normal(0.0, 2.0, (len(model.rows), 3))
    for k, offset in off.items():
        positions[k, :2] += offset
    with_gps = [k for k in range(len(model.rows)) if k not in set(without)]
    sigmas = np.full((len(with_gps), 3), _SIGMA_M)
    return with_gps, place_by_gps(model.centers()[with_gps], positions[with_gps], sigmas)


def found(model: Model, with_gps: list[int], placement: GpsPlacement) -> list[tuple[int, ...]]:
    assert placement.reason is None
    return [g.photos for g in tagged_elsewhere(model, with_gps, placement)]


def test_positions_that_agree_on_another_place() -> None:
    model = walk()
    with_gps, placement = placed(model, dict.fromkeys(_TWIN, (30.0, -40.0)))
    (group,) = tagged_elsewhere(model, with_gps, placement)
    assert group.photos == _TWIN
    assert group.offset_m == pytest.approx(50.0, abs=5.0)


def test_a_photo_without_position_goes_with_those_it_hangs_on() -> None:
    model = close_walk()
    with_gps, placement = placed(model, dict.fromkeys(_TWIN, (30.0, -40.0)), without=(3, 12))
    assert found(model, with_gps, placement) == [_TWIN]


@pytest.mark.parametrize(
    "off",
    [
        {},
        {11: (30.0, -40.0)},  # one alone
        {11: (30.0, -40.0), 15: (30.0, -40.0)},  # two that do not hang together
        {11: (30.0, -40.0), 12: (-900.0, 200.0), 13: (40.0, 3000.0)},  # each somewhere else
        dict.fromkeys(_TWIN, (7.0, -9.0)),  # poor, as positions are between houses
    ],
)
def test_positions_that_are_poor_do_not_count(off: dict[int, tuple[float, float]]) -> None:
    model = walk()
    assert found(model, *placed(model, off)) == []


def test_one_that_is_somewhere_else_leaves_with_the_others_that_agree() -> None:
    off = dict.fromkeys(_TWIN, (30.0, -40.0)) | {12: (5000.0, 100.0)}
    assert found(close_walk(), *placed(close_walk(), off)) == [_TWIN]


def test_a_receiver_that_lost_its_correction_for_a_while() -> None:
    """Centimetres, and four photos off by two metres: they are where the others see them."""
    model = walk()
    positions = model.centers() + np.random.default_rng(4).normal(0.0, 0.02, (20, 3))
    positions[8:12, :2] += (1.2, 1.6)
    placement = place_by_gps(model.centers(), positions, np.full((20, 3), 0.03))
    assert (~placement.inliers).sum() == 4
    assert found(model, list(range(20)), placement) == []


def long_walk() -> Model:
    """Sixty photos around a park."""
    angles = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    centers = 180.0 * np.column_stack([np.cos(angles), np.sin(angles), 0.1 * np.cos(3 * angles)])
    poses = tuple(Rigid3(rotation=np.eye(3), translation=-center) for center in centers)
    return replace(model_of(*(range(50 * k, 50 * k + 100) for k in range(60))), cam_from_sfm=poses)


def half_turn(model: Model, rows: Iterable[int]) -> dict[int, tuple[float, float]]:
    """How far positions are off where these photos were joined with half a turn about the first."""
    centers = model.centers()[:, :2]
    first = next(iter(rows))
    offsets = 2.0 * (centers[first] - centers)
    return {k: (float(offsets[k, 0]), float(offsets[k, 1])) for k in rows if k != first}


def test_a_part_that_was_joined_with_half_a_turn_is_found() -> None:
    model, turned = long_walk(), range(20, 32)
    with_gps, placement = placed(model, half_turn(model, turned), without=(25,))
    assert found(model, with_gps, placement) == []
    (group,) = joined_wrongly(model, with_gps, placement)
    assert set(range(22, 32)) <= set(group) <= set(turned)  # the first ones have hardly moved


def test_heights_that_are_wrong_for_a_part_of_a_flight_do_not_part_it() -> None:
    """A barometer that is set anew on the way: where the photos are in plan, they are."""
    model = long_walk()
    positions = model.centers() + np.random.default_rng(4).normal(0.0, 2.0, (60, 3))
    positions[20:32, 2] += 200.0
    placement = place_by_gps(model.centers(), positions, np.full((60, 3), _SIGMA_M))
    assert placement.reason is None
    assert not placement.inliers[20:32].any()
    assert joined_wrongly(model, list(range(60)), placement) == []


@pytest.mark.parametrize("seed", range(3))
def test_positions_that_are_wrong_by_accident_are_no_part(seed: int) -> None:
    model, rng = long_walk(), np.random.default_rng(seed)
    off = {int(k): tuple(rng.uniform(-400.0, 400.0, 2)) for k in rng.choice(60, 12, replace=False)}
    assert joined_wrongly(model, *placed(model, off)) == []
    assert joined_wrongly(model, *placed(model, {})) == []
