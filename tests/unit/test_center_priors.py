"""What positions say of a map's shape: as noisy as they are among themselves, whatever they state."""

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from ingest.positions.center_priors import center_priors

_STATED = np.array([4.0, 4.0, 10.0])


def _flight(noise: FloatArray, bias: FloatArray, seed: int = 0) -> tuple[FloatArray, FloatArray, Sim3]:
    """Centres (30, 3) in their own frame, positions (30, 3), and what takes one to the other."""
    rng = np.random.default_rng(seed)
    east, north = np.meshgrid(np.linspace(-40, 40, 6), np.linspace(-33, 33, 5))
    true = np.column_stack([east.ravel(), north.ravel(), 45.0 + rng.normal(0.0, 0.5, 30)])
    sim = Sim3(scale=8.0, rotation=so3_exp([0.2, -0.1, 1.0]), translation=np.array([5.0, -7.0, 30.0]))
    positions = true + bias + rng.normal(size=true.shape) * noise
    return sim.inverse().act(true), positions, sim


def _sigmas(covariance: FloatArray, sim: Sim3) -> FloatArray:
    """(n, 3) along the axes of the positions, metres."""
    turned = sim.scale**2 * sim.rotation @ covariance @ sim.rotation.T
    np.testing.assert_allclose(turned[0] - np.diag(np.diag(turned[0])), 0.0, atol=0.02 * turned.max())
    return np.asarray(np.sqrt(np.diagonal(turned, axis1=1, axis2=2)))


def test_what_positions_share_does_not_make_them_noisy() -> None:
    centers, positions, sim = _flight(np.array([1.5, 1.5, 0.2]), np.array([2.0, -3.0, 8.0]))
    found = center_priors(np.arange(30), centers, positions, np.tile(_STATED, (30, 1)), sim)
    sigma = np.median(_sigmas(found.covariance, sim), axis=0)
    assert 1.0 < sigma[0] < 3.0
    assert sigma[1] == pytest.approx(sigma[0], rel=0.05)
    assert 0.1 < sigma[2] < 0.8  # of a barometer that says 10 m
    off = sim.scale * np.linalg.norm(found.xyz - centers, axis=1)
    assert np.median(off) < 3.0  # the 8 m of bias move the map, they do not shape it


def test_positions_count_no_less_than_they_state() -> None:
    """A bent map of survey-grade positions must not make these noisy: they are what unbends it."""
    centers, positions, sim = _flight(np.zeros(3), np.zeros(3))
    bent = centers + sim.inverse().rotation @ [0.0, 0.0, 1.0] * (0.002 * (centers**2).sum(axis=1))[:, None]
    found = center_priors(np.arange(30), bent, positions, np.full((30, 3), 0.02), sim)
    np.testing.assert_allclose(_sigmas(found.covariance, sim).max(), 0.02, rtol=0.05)


def test_positions_keep_their_order_of_trust() -> None:
    centers, positions, sim = _flight(np.array([1.0, 1.0, 1.0]), np.zeros(3))
    stated = np.ones((30, 3))
    stated[7] = 5.0
    found = center_priors(np.arange(30), centers, positions, stated, sim)
    sigma = _sigmas(found.covariance, sim)
    np.testing.assert_allclose(sigma[7] / sigma[8], 5.0, rtol=0.05)
