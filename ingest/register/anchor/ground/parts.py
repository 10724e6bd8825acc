"""Parts of a map that hang together by little: where fronts look alike, maps are joined wrongly there."""

import numpy as np
from numpy.typing import NDArray

from featuredb.maps.subset import only_images
from featuredb.maps.unplaced_map import UnplacedMap


def halves(unplaced: UnplacedMap) -> tuple[UnplacedMap, UnplacedMap]:
    """The two parts of a map, of two photos and more, between which its photos share least.

    The cut of the least normalised weight among those along the second eigenvector (Shi and Malik 2000);
    photos are tied by the points that both see, as a share of those of the one that sees fewer.
    """
    first = weakest_cut(unplaced)
    ids = np.array([image.image_id for image in unplaced.images])
    return only_images(unplaced, ids[first].tolist()), only_images(unplaced, ids[~first].tolist())


def weakest_cut(unplaced: UnplacedMap) -> NDArray[np.bool_]:
    """(i,) whether an image is on one side of it."""
    count = len(unplaced.images)
    sees = np.zeros((count, len(unplaced.points)), dtype=np.float32)
    rows = unplaced.image_rows(unplaced.observations.image_id)
    sees[rows, unplaced.observations.point_index] = 1.0
    shared = sees @ sees.T
    seen = np.maximum(np.diagonal(shared), 1.0)
    ties = shared / np.minimum.outer(seen, seen)
    np.fill_diagonal(ties, 1e-6)  # a photo that nothing ties is on a side, too
    degree = ties.sum(axis=1)
    root = np.sqrt(degree)
    vector = np.linalg.eigh(np.eye(count) - ties / np.outer(root, root))[1][:, 1] / root
    order = np.argsort(vector, kind="stable")
    inner = ties[np.ix_(order, order)]
    ahead = degree[order].cumsum()[:-1]
    # Ties across the cut after each photo: those of the photos ahead less those among them, twice.
    among = np.diagonal(inner.cumsum(axis=0).cumsum(axis=1))[:-1]
    across = ahead - among
    weight = across / ahead + across / (degree.sum() - ahead)
    result = np.zeros(count, dtype=bool)
    result[order[: int(weight.argmin()) + 1]] = True
    return result
