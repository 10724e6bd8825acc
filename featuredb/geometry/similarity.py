"""Similarities between points that correspond."""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import nearest_rotation
from featuredb.geometry.sim3 import Sim3


def similarity_closed_form(source: FloatArray, target: FloatArray) -> Sim3 | None:
    """Least-squares similarity target = S source, both (n, 3) (Umeyama 1991); None if points coincide."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    variance = float((a**2).sum())
    cross = b.T @ a
    if variance < 1e-18 or float((b**2).sum()) < 1e-12:
        return None
    rotation = nearest_rotation(cross)
    scale = float(np.trace(rotation.T @ cross)) / variance
    if scale <= 0:
        return None
    return Sim3(scale=scale, rotation=rotation, translation=target_mean - scale * rotation @ source_mean)
