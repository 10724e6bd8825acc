"""The few true matches among many: neighbours in the photo must be neighbours in the render, moved alike.

Between a photo and a render of a scan only 3 to 7 of 100 matches are true (paper, section 3.1.1), too few
for RANSAC on all of them. The true ones agree locally: near one true match the scene is moved by nearly one
similarity, so another true match nearby has the same rotation and scale. False ones are spread at random.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammainc

from featuredb.compiled import compiled_module
from featuredb.geometry.arrays import FloatArray

# Matches around each one that are asked. At 3 % true ones, 180 hold five; with 120 a third of these is lost,
# and time grows with the square.
_NEIGHBOURS = 180
# None farther away than this share of the image's longer side: beyond, relief and perspective make more than
# one similarity of it.
_REACH_REL = 0.15
_MIN_GAP_REL = 0.006  # none nearer; keypoints of one structure agree with each other by construction
# Of a neighbour's place, as a share of its distance; what slopes and perspective do to a similarity within
# the reach.
_TOLERANCE = 0.15
_TOLERANCE_FLOOR_REL = 0.002  # and at least this share of the longer side, the noise of keypoints
_MAX_TURN_DEG = 45.0  # largest rotation between photo and reference
_MAX_ZOOM = 2.0  # largest change of scale between them, either way
# -log10 of the expected number of matches, among all, that random neighbours would support as well. Three
# false ones do not disturb RANSAC.
_MIN_LOG_CHANCE = -0.5


def consistent_matches(
    photo: FloatArray, reference: FloatArray, side_px: float, area_px: float
) -> NDArray[np.bool_]:
    """Which matches (m,) have more neighbours that one similarity moves than chance gives them.

    For each match i and each neighbour j, z_ij = (q_j - q_i) / (p_j - p_i), taken as complex numbers, is the
    rotation and scale that the pair suggests. The support of i is the largest number of neighbours that one
    such z takes to within the tolerance of where they are. How likely random matches do that follows from
    the areas of the tolerances: the number of random hits is Poisson.

    Args:
        photo: (m, 2) pixels. reference: (m, 2) where the matched scan points appear in one common view;
            rows that are not finite are supported by nothing.
        side_px: longer side of the photo. area_px: over which false matches are spread in the reference.
    """
    m = len(photo)
    finite = np.isfinite(reference).all(axis=1)
    support = np.zeros(m, np.int64)
    expected = np.full(m, 1.0)
    rows = np.flatnonzero(finite)
    if len(rows) >= 3:
        tree = cKDTree(photo[rows])
        k = min(_NEIGHBOURS + 1, len(rows))
        distance, neighbour = tree.query(photo[rows], k=k, distance_upper_bound=_REACH_REL * side_px)
        neighbour = np.where(np.isfinite(distance), neighbour, -1).astype(np.int64)
        loops = compiled_module("ingest.register.frame.features.consistency_loops")
        support[rows], expected[rows] = loops.neighbour_support(
            np.ascontiguousarray(photo[rows], dtype=np.float64),
            np.ascontiguousarray(reference[rows], dtype=np.float64),
            neighbour,
            _MIN_GAP_REL * side_px,
            _TOLERANCE,
            _TOLERANCE_FLOOR_REL * side_px,
            np.radians(_MAX_TURN_DEG),
            np.log(_MAX_ZOOM),
            area_px,
        )
    return _log_chance(support, expected, _NEIGHBOURS, m) >= _MIN_LOG_CHANCE


def _log_chance(
    support: NDArray[np.int64], expected: FloatArray, hypotheses: int, matches: int
) -> FloatArray:
    """-log10 of matches x hypotheses x P(at least support - 1 of the others by chance)."""
    others = np.maximum(support - 1, 0)  # the neighbour that gave the hypothesis agrees with itself
    tail = np.where(others > 0, gammainc(np.maximum(others, 1), np.maximum(expected, 1e-12)), 1.0)
    return np.asarray(-np.log10(np.maximum(tail, 1e-300) * matches * hypotheses), dtype=np.float64)
