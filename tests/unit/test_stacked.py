"""Stacked rows against one array of all of them."""

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.stacked import Moved, Stacked


@dataclass
class Owner:
    values: NDArray[np.float32]


def test_rows_are_those_of_one_array() -> None:
    rng = np.random.default_rng(0)
    owners = [Owner(rng.random((count, 3)).astype(np.float32)) for count in (5, 0, 7, 1)]
    whole = np.concatenate([owner.values for owner in owners])
    stacked = Stacked[np.float32](owners, "values")
    assert len(stacked) == 13
    np.testing.assert_array_equal(stacked.whole(), whole)
    for rows in (
        np.array([12, 0, 5, 5, 4]),
        rng.integers(0, 13, (4, 2)),
        np.array([6, 7]),
        np.array(12),
        np.zeros(0, np.int64),
        np.zeros((0, 2), np.int64),
    ):
        taken = stacked[rows]
        assert taken.dtype == np.float32
        np.testing.assert_array_equal(taken, whole[rows])
    for beyond in (np.array([0, 13]), np.array([-1, 3])):
        with pytest.raises(IndexError, match="expected rows from 0 to 12"):
            stacked[beyond]
    again = pickle.loads(pickle.dumps(stacked))
    np.testing.assert_array_equal(again.whole(), whole)


def test_rows_of_nothing() -> None:
    none = Stacked[np.float32]([Owner(np.zeros((0, 3), np.float32))], "values")
    assert len(none) == 0
    assert none[np.zeros(0, np.int64)].shape == (0, 3)


def test_points_are_moved_and_directions_turned() -> None:
    rng = np.random.default_rng(1)
    owners = [Owner(rng.random((count, 3)).astype(np.float32)) for count in (4, 6)]
    moves = [Rigid3.exp(rng.normal(size=6)) for _ in owners]
    turns, shifts = (np.array([getattr(m, name) for m in moves]) for name in ("rotation", "translation"))
    moved = Moved(owners, "values", turns, shifts)
    expected = np.concatenate([m.act(o.values) for m, o in zip(moves, owners, strict=True)])
    np.testing.assert_allclose(pickle.loads(pickle.dumps(moved)).whole(), expected, atol=1e-12)
    for rows in (np.array([9, 0, 4]), np.array([[1, 2], [8, 3]]), np.array([5]), np.array(5)):
        assert moved[rows].dtype == np.float64
        np.testing.assert_allclose(moved[rows], expected[rows], atol=1e-12)
    turned = Moved(owners, "values", turns)[np.array([0, 9])]
    np.testing.assert_allclose(turned, [turns[0] @ owners[0].values[0], turns[1] @ owners[1].values[5]])
