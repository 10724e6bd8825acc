"""The few true matches among many: neighbours in the photo must be neighbours in the render, moved alike.

Between a photo and a render of a scan only 3 to 7 of 100 matches are true (paper, section 3.1.1), too few
for RANSAC on all of them. The true ones agree locally: near one true match the scene is moved by nearly one
similarity, so another true match nearby has the same rotation and scale. False ones are spread at random.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import gammainc

from featuredb.geometry.arrays import FloatArray
from featuredb.render.compiled import compiled_module


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsistencyOptions:
    """How much neighbours must agree.

    Attributes:
        neighbours: matches around each one that are asked. At 3 % true ones, 180 hold five; with 120 a third
            of these is lost, and time grows with the square.
        reach_rel: none farther away than this share of the image's longer side: beyond, relief and
            perspective make more than one similarity of it.
        min_gap_rel: none nearer; keypoints of one structure agree with each other by construction.
        tolerance: of a neighbour's place, as a share of its distance; what slopes and perspective do to a
            similarity within the reach.
        tolerance_floor_rel: and at least this share of the longer side, the noise of keypoints.
        max_turn_deg: largest rotation between photo and reference.
        max_zoom: largest change of scale between them, either way.
        min_log_chance: -log10 of the expected number of matches, among all, that random neighbours would
            support as well. Three false ones do not disturb RANSAC.
    """

    neighbours: int = 180
    reach_rel: float = 0.15
    min_gap_rel: float = 0.006
    tolerance: float = 0.15
    tolerance_floor_rel: float = 0.002
    max_turn_deg: float = 45.0
    max_zoom: float = 2.0
    min_log_chance: float = -0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consistency:
    """Support of each match by its neighbours.

    Attributes:
        support: (m,) int64, neighbours that agree with the match and with each other.
        log_chance: (m,) -log10 of the expected number of matches with that support among as many random ones.
        kept: (m,) bool, those above the options' limit.
    """

    support: NDArray[np.int64]
    log_chance: FloatArray
    kept: NDArray[np.bool_]


def consistent_matches(
    photo: FloatArray, reference: FloatArray, side_px: float, area_px: float, options: ConsistencyOptions
) -> Consistency:
    """Score matches by how many of their neighbours are moved by one similarity.

    For each match i and each neighbour j, z_ij = (q_j - q_i) / (p_j - p_i), taken as complex numbers, is the
    rotation and scale that the pair suggests. The support of i is the largest number of neighbours that one
    such z takes to within the tolerance of where they are. How likely random matches do that follows from
    the areas of the tolerances: the number of random hits is Poisson.

    Args:
        photo: (m, 2) pixels. reference: (m, 2) where the matched scan points appear in one common view;
            rows that are not finite are supported by nothing.
        side_px: longer side of the photo. area_px: over which false matches are spread in the reference.

    Raises:
        MissingExtraError: numba is not installed.
    """
    m = len(photo)
    finite = np.isfinite(reference).all(axis=1)
    support = np.zeros(m, np.int64)
    expected = np.full(m, 1.0)
    rows = np.flatnonzero(finite)
    if len(rows) >= 3:
        tree = cKDTree(photo[rows])
        k = min(options.neighbours + 1, len(rows))
        distance, neighbour = tree.query(photo[rows], k=k, distance_upper_bound=options.reach_rel * side_px)
        neighbour = np.where(np.isfinite(distance), neighbour, -1).astype(np.int64)
        loops = compiled_module("ingest.register.frame.features.consistency_loops")
        support[rows], expected[rows] = loops.neighbour_support(
            np.ascontiguousarray(photo[rows], dtype=np.float64),
            np.ascontiguousarray(reference[rows], dtype=np.float64),
            neighbour,
            options.min_gap_rel * side_px,
            options.tolerance,
            options.tolerance_floor_rel * side_px,
            np.radians(options.max_turn_deg),
            np.log(options.max_zoom),
            area_px,
        )
    log_chance = _log_chance(support, expected, options.neighbours, m)
    return Consistency(support=support, log_chance=log_chance, kept=log_chance >= options.min_log_chance)


def _log_chance(
    support: NDArray[np.int64], expected: FloatArray, hypotheses: int, matches: int
) -> FloatArray:
    """-log10 of matches x hypotheses x P(at least support - 1 of the others by chance)."""
    others = np.maximum(support - 1, 0)  # the neighbour that gave the hypothesis agrees with itself
    tail = np.where(others > 0, gammainc(np.maximum(others, 1), np.maximum(expected, 1e-12)), 1.0)
    return np.asarray(-np.log10(np.maximum(tail, 1e-300) * matches * hypotheses), dtype=np.float64)
