"""Measured positions as terms of an adjustment: as noisy as they are among themselves."""

import numpy as np
from numpy.typing import NDArray

from featuredb.adjust.terms import CenterPriors
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.positions.one_height import COUNTS_FOR, one_height
from ingest.positions.position_noise import fit_noisy
from ingest.positions.variance_components import stated_sigma


def center_priors(
    photo_of: NDArray[np.int64], centers: FloatArray, positions: FloatArray, sigmas: FloatArray, start: Sim3
) -> CenterPriors:
    """In the frame of `centers`: positions with their noise and their drift, without what they share.

    What a receiver states is the size of its whole error, most of which a flight's positions share: a
    barometer that is off by 10 m still tells that all photos were taken at one height. What they share moves
    a map, the rest shapes it. No position counts less than it states: where they seem noisier, the map may be
    bent instead, and those that are far off lose to the adjustment's robust loss.

    Args:
        photo_of: (n,) photos of the positions, in the order of their names, which is taken for that in time.
        centers: (n, 3) as reconstructed. positions, sigmas: (n, 3) metres.
        start: takes centres to positions, within the range where it is linear.
    """
    fit = fit_noisy(start, centers, positions, sigmas)
    stated = np.array([stated_sigma(sigmas[:, :2]), stated_sigma(sigmas[:, 2:])])
    known = np.flatnonzero(np.isfinite(sigmas[:, 2]))
    if one_height(positions, known):
        sigmas = sigmas * [1.0, 1.0, np.sqrt(len(known) / COUNTS_FOR)]
    share = np.minimum(np.hypot(fit.white_m, fit.drift_m) / stated, 1.0)[[0, 0, 1]]
    move = fit.local_from_sfm.inverse()
    axes = move.scale * move.rotation * share
    return CenterPriors(
        photo_of=photo_of,
        xyz=move.act(positions),
        covariance=np.einsum("ij,nj,kj->nik", axes, sigmas**2, axes),
    )
