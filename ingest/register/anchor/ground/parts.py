"""Parts of a map that hang together by little: where fronts look alike, maps are joined wrongly there."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import UnplacedMap

# Normalised weight of a cut from which on a map hangs together. Wrong joins in simulated towns had 0.02 to
# 0.13, maps that were joined rightly 0.55 to 0.95; what is cut needlessly is only tried in vain.
_FIRM = 0.5
_LEAST_TIE = 1e-6  # of photos that share no point: each is on a side, too


def parts(unplaced: UnplacedMap, least: int) -> Iterator[UnplacedMap]:
    """The map, then its parts of `least` photos and more, each before its own parts."""
    yield unplaced
    for half in halves(unplaced) if len(unplaced.images) > least else ():
        if len(half.images) >= least:
            yield from parts(half, least)


def halves(unplaced: UnplacedMap) -> tuple[UnplacedMap, ...]:
    """The two parts of a map, of two photos and more, between which its photos share least; none if much.

    The cut of the least normalised weight among those along the second eigenvector (Shi and Malik 2000);
    photos are tied by the points that both see, as a share of those of the one that sees fewer.
    """
    first, weight = weakest_cut(unplaced)
    if weight > _FIRM:
        return ()
    ids = np.array([image.image_id for image in unplaced.images])
    return only_images(unplaced, ids[first].tolist()), only_images(unplaced, ids[~first].tolist())


def weakest_cut(unplaced: UnplacedMap) -> tuple[NDArray[np.bool_], float]:
    """(i,) whether an image is on one side of it, and its normalised weight, 0 to 2."""
    count = len(unplaced.images)
    rows = unplaced.image_rows(unplaced.observations.image_id)
    sees = sparse.csr_array(
        (np.ones(len(rows)), (rows, unplaced.observations.point_index)),
        shape=(count, max(len(unplaced.points), 1)),
    )
    shared = (sees @ sees.T).toarray()
    seen = np.maximum(np.diagonal(shared), 1.0)
    ties = np.maximum(shared / np.minimum.outer(seen, seen), _LEAST_TIE)
    np.fill_diagonal(ties, 0.0)
    degree = ties.sum(axis=1)
    root = np.sqrt(degree)
    vector = np.linalg.eigh(np.eye(count) - ties / np.outer(root, root))[1][:, 1] / root
    order = np.argsort(vector, kind="stable")
    ahead = degree[order].cumsum()[:-1]
    behind = degree[order][::-1].cumsum()[::-1][1:]
    among = np.diagonal(ties[np.ix_(order, order)].cumsum(axis=0).cumsum(axis=1))[:-1]
    across = np.maximum(ahead - among, 0.0)
    weight = across / ahead + across / behind
    first = np.zeros(count, dtype=bool)
    first[order[: int(weight.argmin()) + 1]] = True
    return first, float(weight.min())
