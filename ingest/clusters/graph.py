"""The graph of verified pairs: what hangs together, and how large pieces of it are cut.

Everything here is linear in the number of pairs but for a logarithm.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra

from featuredb.geometry.arrays import FloatArray
from ingest.sfm.pairs import Pair

# A cut that leaves less on one side is none; a photo that everybody matches has no middle.
_LEAST_HALF = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class ClusterOptions:
    """How photos that hang together are cut.

    Attributes:
        max_map_photos: of one map. A thousand photos with three thousand observations each fill some
            gigabytes while they are adjusted and written; larger groups become several maps.
        max_block_photos: of one reconstruction from scratch, without what it shares with its neighbours.
            COLMAP's work for one photo grows with the number of photos; flights of one battery stay whole.
        seam_share: photos of neighbouring blocks that a block takes in besides its own, over its own: the
            models are joined by them.
        least_seam_photos: so many at least; a block has about four neighbours, and a joint needs three.
    """

    max_map_photos: int = 600
    max_block_photos: int = 150
    seam_share: float = 0.2
    least_seam_photos: int = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoBlock:
    """Photos that are reconstructed together.

    Attributes:
        own: rows that are in no other block.
        shared: rows of neighbouring blocks that are reconstructed here as well.
    """

    own: tuple[int, ...]
    shared: tuple[int, ...] = ()

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows, rising."""
        return tuple(sorted({*self.own, *self.shared}))


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoCluster:
    """Photos of one map to be: one block, or several that are joined."""

    blocks: tuple[PhotoBlock, ...]

    @property
    def rows(self) -> tuple[int, ...]:
        """All rows, rising."""
        return tuple(sorted(row for block in self.blocks for row in block.own))


def find_clusters(
    photos: int, inliers: Mapping[Pair, int], min_photos: int, options: ClusterOptions
) -> list[PhotoCluster]:
    """Clusters of photos that verified pairs connect, largest first.

    Args:
        photos: number of photos.
        inliers: verified matches of each pair of rows.
        min_photos: smaller groups are left out.
    """
    graph = Graph.of(photos, inliers)
    clusters = []
    for component in graph.components(np.arange(photos)):
        if len(component) < min_photos:
            continue
        for part in graph.cut(component, options.max_map_photos):
            if len(part) >= min_photos:
                clusters.append(_cluster(graph, part, options))
    return sorted(clusters, key=lambda c: (-len(c.rows), c.rows))


def _cluster(graph: "Graph", rows: NDArray[np.int64], options: ClusterOptions) -> PhotoCluster:
    cores = graph.cut(rows, options.max_block_photos)
    if len(cores) == 1:
        return PhotoCluster(blocks=(PhotoBlock(own=tuple(rows.tolist())),))
    blocks = []
    for core in cores:
        seam = graph.seam(core, rows, options)
        blocks.append(PhotoBlock(own=tuple(core.tolist()), shared=tuple(seam.tolist())))
    return PhotoCluster(blocks=tuple(blocks))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Graph:
    """Photos and their verified pairs.

    Attributes:
        weights: (n, n) symmetric, verified matches.
    """

    weights: csr_matrix

    @classmethod
    def of(cls, photos: int, inliers: Mapping[Pair, int]) -> "Graph":
        """The graph of `photos` photos."""
        pairs = np.array(sorted(inliers), dtype=np.int64).reshape(-1, 2)
        counts = np.array([inliers[i, j] for i, j in pairs.tolist()], dtype=np.float64)
        both = np.concatenate([pairs, pairs[:, ::-1]])
        weights = csr_matrix((np.tile(counts, 2), (both[:, 0], both[:, 1])), shape=(photos, photos))
        return cls(weights=weights)

    def components(self, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Rows that hang together among the given ones, largest first."""
        _, labels = connected_components(self.weights[rows][:, rows], directed=False)
        order = np.argsort(labels, kind="stable")
        groups = np.split(rows[order], np.flatnonzero(np.diff(labels[order])) + 1)
        return sorted(groups, key=lambda g: (-len(g), int(g[0])))

    def cut(self, rows: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
        """Connected rows in connected pieces of at most `most`, of about equal size."""
        if len(rows) <= most:
            return [np.sort(rows)]
        halves = self._halves(rows)
        if min(len(half) for half in halves) < _LEAST_HALF * len(rows):
            halves = self._peeled(rows, most)
        return [piece for half in halves for piece in self.cut(half, most)]

    def _peeled(self, rows: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
        """As many rows as fit, breadth first from the first, and what that leaves: for stars and the like."""
        order = breadth_first_order(self.weights[rows][:, rows], 0, return_predecessors=False)
        return [rows[order[:most]], *self.components(np.sort(rows[order[most:]]))]

    def _halves(self, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Two connected halves, across the longest way through the graph.

        Photos are told apart by which of its two ends they are nearer to; fragments that a cut leaves
        behind go to the other side.
        """
        weights = self.weights[rows][:, rows]
        lengths = weights.copy()
        lengths.data = 1.0 / np.sqrt(lengths.data)  # photos that share more are nearer
        start = int(np.argmax(_distances(lengths, 0)))
        from_start = _distances(lengths, start)
        end = int(np.argmax(from_start))
        nearer = from_start - _distances(lengths, end)
        left = np.zeros(len(rows), dtype=bool)
        left[np.lexsort((np.arange(len(rows)), nearer))[: len(rows) // 2]] = True
        for side in (True, False):
            left = self._whole(rows, left, side)
        return [rows[left], rows[~left]]

    def _whole(self, rows: NDArray[np.int64], left: NDArray[np.bool_], side: bool) -> NDArray[np.bool_]:
        """The same division with all but the largest piece of one side given to the other."""
        members = np.flatnonzero(left == side)
        pieces = self.components(rows[members])
        stray = np.isin(rows, np.concatenate(pieces[1:])) if len(pieces) > 1 else np.zeros(len(rows), bool)
        return np.where(stray, not side, left)

    def seam(
        self, core: NDArray[np.int64], rows: NDArray[np.int64], options: ClusterOptions
    ) -> NDArray[np.int64]:
        """Rows outside the core that have most matches with it."""
        outside = np.setdiff1d(rows, core)
        matches = np.asarray(self.weights[outside][:, core].sum(axis=1)).ravel()
        most = max(options.least_seam_photos, round(options.seam_share * len(core)))
        best = np.lexsort((outside, -matches))[:most]
        return np.sort(outside[best[matches[best] > 0]])


def _distances(lengths: csr_matrix, source: int) -> FloatArray:
    """Shortest ways (n,) from one row to all."""
    ways = dijkstra(lengths, directed=False, indices=np.array([source], dtype=np.int32))
    return np.asarray(ways, dtype=np.float64).ravel()
