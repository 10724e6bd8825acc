"""One height for all photos: software wrote it, and no receiver measured it."""

import numpy as np

from featuredb.geometry.arrays import FloatArray

_SAME_M, _EARTH_M = 1e-3, 6.371e6  # of heights that are one number; the Earth curves away from a local frame
_LEAST = 3  # level a plane, and leave nothing over from which their noise could be told


def told_once(positions: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Standard deviations of positions where one height for all photos counts for three that lie far apart.

    Taken for measurements, heights that agree to the last digit would level the way of the cameras.

    Args:
        positions: (n, 3) local, metres. sigmas: (n, 3), infinite for a coordinate that is not known.
    """
    known = np.flatnonzero(np.isfinite(sigmas[:, 2]))
    if len(known) <= _LEAST:
        return sigmas
    plan = positions[known, :2] - positions[known, :2].mean(axis=0)
    curved_m = float((np.ptp(plan, axis=0) ** 2).sum()) / (2.0 * _EARTH_M)
    if np.ptp(positions[known, 2]) > _SAME_M + curved_m:
        return sigmas
    first = int((plan**2).sum(axis=1).argmax())
    way = plan - plan[first]
    last = int((way**2).sum(axis=1).argmax())
    aside = np.abs(way[:, 0] * way[last, 1] - way[:, 1] * way[last, 0])
    once = sigmas.copy()
    once[np.delete(known, [first, last, int(aside.argmax())]), 2] = np.inf
    return once
