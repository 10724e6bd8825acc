"""Flights with positions, for tests of placement."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from ingest.register.gps import GpsPlacement, place_by_gps

TRUE = Sim3(scale=8.5, rotation=so3_exp([0.3, -0.2, 2.0]), translation=np.array([4.0, -7.0, 50.0]))


def flight(count: int, seed: int = 0) -> FloatArray:
    """Positions in the local frame: a block of some 100 m by 80 m, heights varying by metres."""
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(-50, 50, count), rng.uniform(-40, 40, count), rng.normal(50, 3, count)]
    )


def place(positions: FloatArray, noise: FloatArray, sigmas: FloatArray) -> GpsPlacement:
    return place_by_gps(TRUE.inverse().act(positions), positions + noise, sigmas)
