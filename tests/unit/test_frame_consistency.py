"""Local consistency of matches: the few true ones are found, and nothing is found where there are none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ingest.register.frame.features.search import consistent_matches

SIDE, AREA = 1600.0, 1600.0 * 1200.0
Array = NDArray[np.float64]


def matches(
    rate: float, seed: int, count: int = 4000, turn_deg: float = 8.0, zoom: float = 1.15
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Photo pixels, reference pixels and which are true, under a similarity with perspective and noise."""
    rng = np.random.default_rng(seed)
    photo = rng.uniform((0, 0), (1600, 1200), (count, 2))
    true = rng.random(count) < rate
    a = np.radians(turn_deg)
    turn = zoom * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    centred = photo - (800, 600)
    keystone = 1.0 + 1.5e-4 * centred[:, 1:]
    moved = (centred @ turn.T) / keystone + (760, 640) + rng.normal(0, 1.5, (count, 2))
    reference = np.where(true[:, None], moved, rng.uniform((0, 0), (1600, 1200), (count, 2)))
    return photo, reference, true


@pytest.mark.parametrize("rate", [0.03, 0.05, 0.07])
def test_finds_most_true_matches_among_few(rate: float) -> None:
    photo, reference, true = matches(rate, seed=3)
    found = consistent_matches(photo, reference, SIDE, AREA)
    recall = (found & true).sum() / true.sum()
    precision = (found & true).sum() / max(found.sum(), 1)
    assert recall > (0.3 if rate < 0.04 else 0.75), f"{recall:.2f} of the true matches kept"
    assert precision > 0.85, f"{precision:.2f} of the kept matches true; {rate} before"


def test_random_matches_are_hardly_ever_kept() -> None:
    kept = 0
    for seed in range(3):
        photo, reference, _ = matches(0.0, seed=seed)
        kept += int(consistent_matches(photo, reference, SIDE, AREA).sum())
    # Three chance hits are expected per run; they come in groups of neighbours.
    assert kept <= 30


def test_rotation_beyond_the_limit_supports_nothing() -> None:
    photo, reference, true = matches(0.1, seed=5, turn_deg=90.0, zoom=1.0)
    found = consistent_matches(photo, reference, SIDE, AREA)
    assert (found & true).sum() < 0.1 * true.sum()


def test_copies_of_one_keypoint_do_not_support_each_other() -> None:
    photo = np.repeat(np.array([[400.0, 300.0]]), 30, axis=0) + np.linspace(0, 2, 30)[:, None]
    found = consistent_matches(photo, photo + 50.0, SIDE, AREA)
    assert not found.any()


def test_places_behind_the_reference_view_are_left_out() -> None:
    photo, reference, true = matches(0.2, seed=6)
    reference[::2] = np.nan
    found = consistent_matches(photo, reference, SIDE, AREA)
    assert not found[::2].any()
    assert (found & true)[1::2].sum() > 0.6 * true[1::2].sum()
