"""Do frames that were registered one by one move the map to the same place?

A wrong registration may look good on its own. Each frame alone gives a similarity for the whole map (paper,
section 2.4); wrong ones do not send the map where another frame sends it. What both see is compared: far from
both, small differences of tilt and the bend of the reconstruction grow without anyone being wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3

# Median distance between the places of the same map points, as a share of the distance from which they are
# seen. `featuredb anchor` prints how far apart right frames are: up to 0.27 m on brighton, from 40 to 50 m,
# 0.07 m in the simulated town; this allows five times that. Wrong frames have not been measured: none has
# passed the verdict so far.
_MAX_APART_SHARE = 0.03
_MIN_APART_M = 0.3  # and never less than this, for frames that are close to what they see


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoneFrame:
    """One frame and the similarity that it alone gives.

    Attributes:
        image_id: the frame.
        new_from_old: similarity of the map's local frame.
        points: (n, 3) map points that the frame sees, old local frame.
        distance_m: median distance from the camera to them.
    """

    image_id: int
    new_from_old: Sim3
    points: FloatArray
    distance_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAgreement:
    """Which frames belong together.

    Attributes:
        agreeing: ids of the largest set of frames that all agree pairwise; empty where two such sets are
            equally large and neither can be preferred.
        apart_m: median distance between the places of common points, by pair of ids.
        allowed_m: what was allowed, likewise.
    """

    agreeing: tuple[int, ...]
    apart_m: Mapping[tuple[int, int], float]
    allowed_m: Mapping[tuple[int, int], float]


def frames_that_agree(frames: Sequence[LoneFrame]) -> FrameAgreement:
    """The largest set of frames whose similarities agree."""
    apart: dict[tuple[int, int], float] = {}
    allowed: dict[tuple[int, int], float] = {}
    for a, b in combinations(frames, 2):
        pair = (a.image_id, b.image_id)
        points = np.vstack([a.points, b.points])
        difference = a.new_from_old.act(points) - b.new_from_old.act(points)
        apart[pair] = float(np.median(np.linalg.norm(difference, axis=1)))
        allowed[pair] = max(_MAX_APART_SHARE * max(a.distance_m, b.distance_m), _MIN_APART_M)
    ids = [frame.image_id for frame in frames]
    for size in range(len(ids), 0, -1):
        sets = [
            chosen
            for chosen in combinations(ids, size)
            if all(apart[pair] <= allowed[pair] for pair in combinations(chosen, 2))
        ]
        if len(sets) == 1 or (sets and size > len(ids) / 2):
            best = min(sets, key=lambda s: sum((apart[pair] for pair in combinations(s, 2)), 0.0))
            return FrameAgreement(agreeing=best, apart_m=apart, allowed_m=allowed)
        if sets:
            break
    return FrameAgreement(agreeing=(), apart_m=apart, allowed_m=allowed)
