"""A new map whose scene an existing map has at another place, and maps of one scene that are both right."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.geometry.sim3 import Sim3
from featuredb.index.vocabulary import shipped_vocabulary
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from ingest.scene_elsewhere import SceneElsewhere, chance_of_offset, same_scene_elsewhere
from tests.support.scene_strip import strip_map

_GPS = np.diag([1e-3, 1e-3, 1e-3, 1e-3, 3.0, 3.0, 5.0]) ** 2


def _shifted(map_id: str, east_m: float, by_m: tuple[float, float], seed: int) -> FeatureMap:
    move = Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([*by_m, 0.0]))
    return strip_map(map_id, east_m, move=move, seed=seed, covariance=_GPS)


def _found(tmp_path: Path, new: FeatureMap, *existing: FeatureMap) -> SceneElsewhere | None:
    database = Database.create(tmp_path / "db")
    database.commit_maps(existing)
    return same_scene_elsewhere(new, database.snapshot(), tmp_path / "work", shipped_vocabulary())


@pytest.mark.parametrize(
    ("by_m", "words"), [((50_000.0, 0.0), "50.0 km to the west"), ((0.0, -400.0), "400 m to the north")]
)
def test_positions_that_are_wrong_together_show_against_a_map_of_the_scene(
    tmp_path: Path, by_m: tuple[float, float], words: str
) -> None:
    unrelated = strip_map("unrelated", 190.0, seed=3, covariance=_GPS)
    found = _found(tmp_path, _shifted("new", 40.0, by_m, 1), unrelated, strip_map("old", 55.0, seed=2))
    assert found is not None
    assert found.summary.map_id == "old"
    assert words in found.message
    assert found.overlap.photos >= 3


@pytest.mark.parametrize("by_m", [(0.0, 0.0), (12.0, -9.0)])
def test_maps_that_positions_have_apart_by_their_noise_are_both_right(
    tmp_path: Path, by_m: tuple[float, float]
) -> None:
    assert _found(tmp_path, _shifted("new", 40.0, by_m, 1), strip_map("old", 55.0, seed=2)) is None


def test_a_map_that_one_confirms_is_not_held_back_by_another_that_is_wrong(tmp_path: Path) -> None:
    wrong, right = _shifted("wrong", 40.0, (50_000.0, 0.0), 4), strip_map("right", 55.0, seed=2)
    assert _found(tmp_path, _shifted("new", 45.0, (0.0, 0.0), 1), wrong, right) is None


def test_the_chance_of_an_offset_is_that_of_receivers_which_differ_by_a_factor_of_e() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[9.0, 2.0], [2.0, 4.0]])
    drawn = rng.multivariate_normal(np.zeros(2), covariance, 200_000) * np.exp(rng.normal(size=(200_000, 1)))
    squared = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn)
    for offset in (np.array([8.0, 0.0]), np.array([0.0, 30.0])):
        further = (squared > offset @ np.linalg.inv(covariance) @ offset).mean()
        assert chance_of_offset(offset, covariance) == pytest.approx(further, rel=0.1)
