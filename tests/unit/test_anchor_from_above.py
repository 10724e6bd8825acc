"""Flat ground seen from below is its own mirror image: only places under the cameras count."""

import numpy as np
import pytest

from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from ingest.register.anchor.start.from_above import _judged, _most_fitting

_LOCAL_FROM_OWN = Sim3(scale=2.5, rotation=so3_exp([0.1, 3.0, 0.4]), translation=np.array([4.0, -9.0, 2.0]))


@pytest.mark.parametrize("mirrored", [False, True])
def test_flat_ground_is_found_from_above_alone(mirrored: bool) -> None:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-30, 30, (60, 2)), np.zeros(60)])
    own = _LOCAL_FROM_OWN.inverse().act(ground)
    above = _LOCAL_FROM_OWN.inverse().act([0.0, 0.0, 40.0]) - _LOCAL_FROM_OWN.inverse().act([0.0, 0.0, 0.0])
    if mirrored:
        ground[:, 0] *= -1.0
    found = _most_fitting(own, ground, above, 0.5)
    assert (found is None) == mirrored
    if found is not None:
        assert np.linalg.norm(found.act(own) - ground, axis=1).max() < 0.5


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_place_whose_fit_leaves_cameras_underground_is_none(mirrored: bool) -> None:
    """A start from which cameras lie above, on a mirrored scan, comes to lie below once it is fitted."""
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(-30, 30, (60, 2)), np.zeros(60)])
    inverse = _LOCAL_FROM_OWN.inverse()
    own, above = inverse.act(ground), inverse.act([0.0, 0.0, 40.0]) - inverse.act([0.0, 0.0, 0.0])
    sim = _LOCAL_FROM_OWN
    if mirrored:
        ground[:, 0] *= -1.0
        tilted = so3_exp([0.0, np.radians(89.0), 0.0])
        sim = Sim3(scale=1.0, rotation=tilted, translation=np.zeros(3)) @ sim
        assert sim.rotation[2] @ above > 0.0
    found = _judged(sim, own, ground, above, np.arange(60), 35.0, 3600.0, "rgb")
    assert (found is None) == mirrored
