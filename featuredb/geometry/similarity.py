"""Similarities between points that correspond."""

from typing import Protocol

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import nearest_rotation
from featuredb.geometry.sim3 import Sim3, point_jacobian

_ROUNDS = 50
_SETTLED = 1e-10  # of a step, log scale, radians and metres


class Term(Protocol):
    """What is known of a similarity besides points."""

    def residual(self, similarity: Sim3) -> FloatArray:
        """(m,) whitened."""

    def jacobian(self, similarity: Sim3) -> FloatArray:
        """(m, 7) of `residual` by the left perturbation."""


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


def refined_similarity(
    sim: Sim3, source: FloatArray, target: FloatArray, sigmas: float | FloatArray, term: Term | None = None
) -> Sim3:
    """Weighted least squares on the tangent, by Gauss and Newton.

    Args:
        source, target: (n, 3), coordinates of the target NaN where unknown.
        sigmas: standard deviations of the target's coordinates: one, (3,) or (n, 3).
    """
    known = np.isfinite(target).ravel()
    weight = np.broadcast_to(1.0 / np.asarray(sigmas), target.shape).ravel()[known]
    for _ in range(_ROUNDS):
        placed = sim.act(source)
        jacobian = point_jacobian(placed).reshape(-1, 7)[known] * weight[:, None]
        residual = (target - placed).ravel()[known] * weight
        if term is not None:
            jacobian = np.vstack([jacobian, term.jacobian(sim)])
            residual = np.concatenate([residual, -term.residual(sim)])
        step = np.linalg.lstsq(jacobian, residual, rcond=1e-14)[0]
        sim = Sim3.exp(step) @ sim
        if np.abs(step).max() < _SETTLED:
            break
    return sim
