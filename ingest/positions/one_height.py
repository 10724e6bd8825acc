"""One height for all photos: software wrote it, and no receiver measured it."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray

# Of heights that are one number. Four that are good to 3 cm come as close by chance in one case of 2,000;
# some that a barometer tells in steps of 10 cm may well, and their place is then wider than it need be.
_SAME_M = 5e-3
_EARTH_M = 6.371e6
COUNTS_FOR = 3  # photos: they level a plane, and leave nothing over from which their noise could be told


def one_height(positions: FloatArray, known: NDArray[np.int64]) -> bool:
    """Whether positions (n, 3) have one height in the known rows, in a local frame about their middle."""
    if len(known) <= COUNTS_FOR:
        return False
    plan = positions[known, :2] - np.median(positions[known, :2], axis=0)
    level = positions[known, 2] + (plan**2).sum(axis=1) / (2.0 * _EARTH_M)
    return bool(np.ptp(level) <= _SAME_M)


def told_once(
    positions: FloatArray, sigmas: FloatArray, placed: FloatArray, taken: NDArray[np.bool_]
) -> FloatArray:
    """Standard deviations of positions where one height for all photos counts for three that lie far apart.

    Taken for measurements, heights that agree to the last digit would level the way of the cameras.

    Args:
        positions: (n, 3) local, metres. sigmas: (n, 3), infinite for a coordinate that is not known.
        placed: (n, 3) the cameras, about where they are. taken: (n,) that take part; the three are of these.
    """
    known = np.flatnonzero(np.isfinite(sigmas[:, 2]) & taken)
    if not one_height(positions, known):
        return sigmas
    plan = placed[known, :2] - np.median(placed[known, :2], axis=0)
    first = int((plan**2).sum(axis=1).argmax())
    way = plan - plan[first]
    last = int((way**2).sum(axis=1).argmax())
    aside = np.abs(way[:, 0] * way[last, 1] - way[:, 1] * way[last, 0])
    once = sigmas.copy()
    once[:, 2] = np.inf
    kept = known[[first, last, int(aside.argmax())]]
    once[kept, 2] = sigmas[kept, 2]
    return once
