"""Verified pairs that the photos' positions contradict.

Buildings that look alike verify pairs of photos that have nothing in common. A few of them are enough to
spoil a reconstruction: of 10,190 pairs of 1,000 photos over a simulated town 33 were of photos 100 to 500 m
apart, and blocks that were cut along them came back turned by half a turn.

A position may be wrong, so no distance is too large by itself: a pair goes where it is far longer than what
both photos have in common with others. A photo with a wrong position is far from all that it shows, and loses
nothing.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from ingest.photos.photo import Photo, gps_positions
from ingest.sfm.pairs import Pair

# A photo reaches as far as half of its verified matches; no photo loses more than the other half. Pairs go
# that are longer than four times the longer reach of their photos, and than what noise of positions adds: 2
# of 712 of `brighton`, `lewis` and `seneca` (21 and 28 matches), all 33 wrong ones of that town and none of
# the others; with a fifth of the positions off by 300 m 21 of the 33, and none of the others.
_WITHIN_REACH = 0.5
_MOST_REACHES, _MOST_SIGMAS = 4.0, 3.0


def far_pairs(photos: Sequence[Photo], inliers: Mapping[Pair, int]) -> frozenset[Pair]:
    """Pairs whose positions are too far apart for their photos to overlap, as their other pairs tell.

    Args:
        photos: all of them; the pairs name their rows.
        inliers: verified matches of each pair.
    """
    rows = [i for i, photo in enumerate(photos) if photo.gps is not None]
    if len(rows) < 2:
        return frozenset()
    plan, sigmas_m = np.full((len(photos), 2), np.nan), np.zeros(len(photos))
    plan[rows] = gps_positions([photos[i] for i in rows])[:, :2]
    sigmas_m[rows] = [gps.sigma_horizontal_m for i in rows if (gps := photos[i].gps) is not None]

    pairs = np.array(sorted(inliers), dtype=np.int64).reshape(-1, 2)
    pairs = pairs[np.isfinite(plan[pairs]).all(axis=(1, 2))]
    counts = np.array([inliers[i, j] for i, j in pairs.tolist()], dtype=np.float64)
    distances_m = np.linalg.norm(plan[pairs[:, 0]] - plan[pairs[:, 1]], axis=1)
    reach_m = np.zeros(len(photos))
    order = np.argsort(distances_m, kind="stable")
    seen, total = np.zeros(len(photos)), np.bincount(pairs.ravel(), np.repeat(counts, 2), len(photos))
    for pair, count, distance_m in zip(pairs[order], counts[order], distances_m[order], strict=True):
        reach_m[pair] = np.where(seen[pair] < _WITHIN_REACH * total[pair], distance_m, reach_m[pair])
        seen[pair] += count
    most_m = _MOST_REACHES * reach_m[pairs].max(axis=1) + _MOST_SIGMAS * np.hypot(*sigmas_m[pairs].T)
    return frozenset((i, j) for i, j in pairs[distances_m > most_m].tolist())
