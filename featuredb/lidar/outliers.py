"""Statistical outlier removal: points that are much farther from their neighbours than those are from theirs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray

_QUERY_ROWS = 100_000  # neighbours of this many points at a time: 15 MB


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlierOptions:
    """Which points are outliers.

    Attributes:
        neighbours: how many nearest neighbours are looked at.
        ratio: a point is one if the mean distance to its neighbours is this many times the median of theirs.
        reach_spacings: neighbours are looked for within this many of the scan's spacings, ...
        shortest_reach_m: ... but at least this far.
    """

    # Eight, as many as surround a point of a grid.
    neighbours: int = 8
    # A ratio of neighbours and no distance: scans are denser near the scanner and where strips overlap, and a
    # distance that is odd in one place is usual in another. docs/lidar.md has the distributions.
    ratio: float = 5.0
    reach_spacings: float = 12.0
    shortest_reach_m: float = 1.0

    def reach_m(self, spacing_m: float) -> float:
        """How far neighbours are looked for, metres."""
        return max(self.shortest_reach_m, self.reach_spacings * spacing_m)

    def margin_m(self, spacing_m: float) -> float:
        """How far around a block points decide on its own: neighbours, and their neighbours."""
        return 2.0 * self.reach_m(spacing_m)


def outlier_ratio(xyz: FloatArray, core: int, reach_m: float, neighbours: int) -> FloatArray:
    """Mean distance to the nearest neighbours, as a multiple of the median of the same of those neighbours.

    Neighbours farther than `reach_m` count as that far away, so that the ratio of a point depends only on what
    lies within twice the reach: pieces of a scan that overlap by that give what the whole scan gives.

    Args:
        xyz: (n, 3) metres.
        core: the ratio is asked for the first `core` points; the others are their surroundings.

    Returns:
        (core,) float64; infinity for a point without any neighbour in reach.
    """
    tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
    mean = np.empty(len(xyz), np.float32)
    for start in range(0, len(xyz), _QUERY_ROWS):
        distance, _ = _nearest(tree, xyz[start : start + _QUERY_ROWS], neighbours, reach_m)
        mean[start : start + _QUERY_ROWS] = np.minimum(distance, reach_m).mean(axis=1)
    padded = np.append(mean, np.nan)  # what has no neighbour gets row n
    ratio = np.empty(core)
    for start in range(0, core, _QUERY_ROWS):
        end = min(start + _QUERY_ROWS, core)
        _, index = _nearest(tree, xyz[start:end], neighbours, reach_m)
        of_neighbours = padded[index]
        alone = np.isnan(of_neighbours).all(axis=1)
        of_neighbours[alone] = 1.0
        ratio[start:end] = mean[start:end] / np.maximum(np.nanmedian(of_neighbours, axis=1), 1e-9)
        ratio[start:end][alone] = np.inf
    return ratio


def find_outliers(xyz: FloatArray, core: int, spacing_m: float, options: OutlierOptions) -> NDArray[np.bool_]:
    """(core,) bool, which of the first `core` points are outliers; see `outlier_ratio`."""
    return outlier_ratio(xyz, core, options.reach_m(spacing_m), options.neighbours) > options.ratio


def _nearest(
    tree: "cKDTree[None]", xyz: FloatArray, neighbours: int, reach_m: float
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Distances and rows (n, neighbours) of the nearest other points; infinity and row n beyond the reach."""
    found: Any = tree.query(xyz, k=neighbours + 1, distance_upper_bound=reach_m)
    distance, index = found
    return distance[:, 1:], index[:, 1:]
