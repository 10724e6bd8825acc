"""Seen from above: roofs, eaves, trees, walls, bridges, slopes."""

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.ortho import margin_m, seen_from_above

FAR = np.array([680_000.0, 5_334_000.0, 560.0])  # UTM: float32 would lose decimetres there


def sheet(
    rng: np.random.Generator, x: tuple[float, float], y: tuple[float, float], z: float, per_m2: float = 9.0
) -> FloatArray:
    """Points of a level rectangle, scattered as a scanner does: a jittered grid."""
    step = 1.0 / np.sqrt(per_m2)
    grid = np.stack(np.meshgrid(np.arange(*x, step), np.arange(*y, step)), axis=-1).reshape(-1, 2)
    grid = grid + rng.uniform(-0.3, 0.3, grid.shape) * step
    return np.column_stack([grid, np.full(len(grid), z) + rng.normal(0, 0.02, len(grid))])


def seen(*parts: FloatArray) -> list[NDArray[np.bool_]]:
    answer = seen_from_above(np.concatenate(parts) + FAR, 1 / 3)
    return np.split(answer, np.cumsum([len(p) for p in parts])[:-1])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_open_ground_is_seen_whole(rng: np.random.Generator) -> None:
    (ground,) = seen(sheet(rng, (0, 40), (0, 40), 0.0))
    assert ground.all()


def test_what_lies_under_a_roof_is_hidden_and_the_street_is_not(rng: np.random.Generator) -> None:
    ground, roof = sheet(rng, (0, 40), (0, 40), 0.0), sheet(rng, (10, 25), (10, 20), 6.0)
    on_ground, on_roof = seen(ground, roof)
    assert on_roof.all()
    inside = (ground[:, 0] > 10) & (ground[:, 0] < 24.6) & (ground[:, 1] > 10) & (ground[:, 1] < 19.6)
    assert not on_ground[inside].any()
    # From two spacings off the roof's edge everything is seen.
    off = np.maximum(
        np.maximum(9.3 - ground[:, 0], ground[:, 0] - 25.7),
        np.maximum(9.3 - ground[:, 1], ground[:, 1] - 20.7),
    )
    assert on_ground[off > 0].all()


def test_walls_are_hidden_by_the_edge_of_their_roof(rng: np.random.Generator) -> None:
    roof = sheet(rng, (10, 25), (10, 20), 6.0)
    wall = np.column_stack([rng.uniform(10.2, 24.4, 300), np.full(300, 9.95), rng.uniform(0.3, 5.3, 300)])
    on_wall, _, _ = seen(wall, roof, sheet(rng, (0, 40), (0, 9.5), 0.0))
    assert on_wall.mean() < 0.01


@pytest.mark.parametrize("pitch_deg", [20.0, 40.0, 48.0])
def test_roofs_and_slopes_do_not_hide_themselves(rng: np.random.Generator, pitch_deg: float) -> None:
    slope = sheet(rng, (0, 30), (0, 30), 0.0)
    slope[:, 2] += np.tan(np.radians(pitch_deg)) * np.minimum(slope[:, 0], 30 - slope[:, 0])
    (on_slope,) = seen(slope)
    assert on_slope.mean() > 0.995


def test_lawns_under_trees_stay_hidden_though_lasers_reach_them(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crown with holes of a metre: an image shows leaves there; around the tree the lawn is seen."""
    ground = sheet(rng, (0, 30), (0, 30), 0.0)
    crown = sheet(rng, (0, 30), (0, 30), 0.0, per_m2=4.0)
    centre = np.hypot(crown[:, 0] - 15, crown[:, 1] - 15)
    crown = crown[(centre < 4.0)]
    crown[:, 2] = 4.0 + np.sqrt(16.0 - np.hypot(crown[:, 0] - 15, crown[:, 1] - 15) ** 2) * 0.6
    holes = (np.floor(crown[:, 0] / 1.5) + np.floor(crown[:, 1] / 1.5)) % 3 == 0
    crown = crown[~holes | (rng.random(len(crown)) < 0.3)]
    on_ground, _ = seen(ground, crown)
    distance = np.hypot(ground[:, 0] - 15, ground[:, 1] - 15)
    assert on_ground[distance < 3.0].mean() < 0.06
    assert on_ground[distance > 5.0].all()
    monkeypatch.setattr("featuredb.lidar.ortho.GAP_M", 0.0)
    splats_only, _ = seen(ground, crown)
    assert splats_only[distance < 3.0].mean() > 2 * on_ground[distance < 3.0].mean() + 0.05


def test_a_tile_with_its_margin_answers_as_the_whole(rng: np.random.Generator) -> None:
    ground = sheet(rng, (0, 60), (0, 60), 0.0)
    roof = sheet(rng, (28, 33), (5, 55), 5.0)
    points = np.concatenate([ground, roof]) + FAR
    spacing_m = 1 / 3
    whole = seen_from_above(points, spacing_m)
    core = points[:, 0] < FAR[0] + 30
    near = points[:, 0] < FAR[0] + 30 + margin_m(spacing_m)
    tile = seen_from_above(points[near], spacing_m)
    # Cells start elsewhere in another tile: a point here and there is judged by another neighbour.
    assert (tile[core[near]] == whole[core]).mean() > 0.999


def test_hostile_input() -> None:
    assert seen_from_above(np.zeros((0, 3)), 1.0).shape == (0,)
    assert seen_from_above(np.array([[1.0, 2.0, 3.0]]), 1.0).tolist() == [True]
    stacked = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, 0.0, 5.0]])
    assert seen_from_above(stacked, 1.0).tolist() == [False, True, True]
