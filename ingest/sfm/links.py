"""How firmly the photos of a reconstruction hang together, and a reconstruction cut down to some of them.

Look-alike buildings join reconstructions at the wrong place: a few dozen points of one facade tie photos that
share thousands among themselves. Nothing in the residuals shows it, and covariances take the tie for true.
"""

import heapq
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from featuredb.geometry.arrays import FloatArray
from ingest.colmap.bridge import Model, with_observations


def points_in_common(model: Model) -> sparse.csr_array:
    """(k, k): how many points both photos see; on the diagonal those of one."""
    return seen_by_both(model.photo_of, model.point_of, len(model.rows), len(model.xyz))


def seen_by_both(
    photo_of: NDArray[np.int64], point_of: NDArray[np.integer], photos: int, points: int
) -> sparse.csr_array:
    """`points_in_common` by observations: their photos (m,) and points (m,)."""
    seen: NDArray[np.float64] = np.ones(len(point_of))
    sees = sparse.csr_array((seen, (photo_of, point_of)), shape=(photos, max(points, 1)))
    return sparse.csr_array(sees @ sees.T)


def link_shares(model: Model) -> FloatArray:
    """(k, k): the share of the points of the photo that sees fewer which both see; 0 on the diagonal."""
    return shares_of(points_in_common(model))


def shares_of(seen_by_both: sparse.csr_array) -> FloatArray:
    """`link_shares` by points in common."""
    common = seen_by_both.toarray()
    counts = np.maximum(np.diag(common), 1.0)
    shares = common / np.minimum.outer(counts, counts)
    np.fill_diagonal(shares, 0.0)
    return np.asarray(shares)


def bottleneck_share(model: Model, held: Sequence[int], without: Sequence[int] = ()) -> FloatArray:
    """(k,) of every photo: the weakest link of its firmest chain of photos to one that is held.

    Args:
        held: photos of the model, by place among its rows, that need no link; they have infinity.
        without: photos that no chain goes through.

    Returns:
        0 for photos without a chain.
    """
    shares = link_shares(model)
    shares[:, list(without)] = 0.0
    firm = np.zeros(len(model.rows))
    firm[list(held)] = np.inf
    queue = [(-np.inf, k) for k in held]
    while queue:
        width, photo = heapq.heappop(queue)
        if -width < firm[photo]:
            continue
        reach = np.minimum(-width, shares[photo])
        for other in np.flatnonzero(reach > firm).tolist():
            firm[other] = reach[other]
            heapq.heappush(queue, (-float(reach[other]), other))
    return firm


def connected_parts(model: Model, least_share: float) -> list[list[int]]:
    """Rows of the photos that hang together by links of at least `least_share`, largest part first."""
    return _parts(model, sparse.csr_array(link_shares(model) >= least_share))


def tied_parts(model: Model, least_points: int) -> list[list[int]]:
    """Rows of the photos that hang together by pairs with so many points in common, largest part first."""
    return _parts(model, points_in_common(model) >= least_points)


def _parts(model: Model, tied: sparse.csr_array) -> list[list[int]]:
    count, label = connected_components(tied.astype(np.int8), directed=False)
    parts = [model.rows[label == part].tolist() for part in range(count)]
    return sorted(parts, key=lambda rows: (-len(rows), rows))


_LEAST_SHARED = 15  # points that hold two photos together; as many as an accepted pose needs


def keep_photos(model: Model, rows: Collection[int], least: int = 2) -> Model | None:
    """The largest part of the model that hangs together among the given rows; None if it is under `least`."""
    wanted = np.isin(model.rows, np.array(sorted(rows), dtype=np.int64))
    if wanted.all():
        return model if len(model.rows) >= least else None
    tied = (points_in_common(model).toarray() >= _LEAST_SHARED) & np.outer(wanted, wanted)
    _, label = connected_components(sparse.csr_array(tied.astype(np.int8)), directed=False)
    sizes = np.bincount(label[wanted], minlength=int(label.max()) + 1)
    kept = wanted & (label == int(sizes.argmax()))
    if int(kept.sum()) < least:
        return None
    return _cut(model, kept)


def select_photos(model: Model, rows: Collection[int]) -> Model:
    """The model with these photos, whether they hang together or not."""
    wanted = np.isin(model.rows, np.array(sorted(rows), dtype=np.int64))
    return model if wanted.all() else _cut(model, wanted)


def _cut(model: Model, kept: "np.ndarray") -> Model:
    """The model with the photos of the mask (k,) and the points that two of them still see."""
    here = kept[model.photo_of]
    here &= np.bincount(model.point_of[here], minlength=len(model.xyz))[model.point_of] >= 2
    cameras, camera_of = np.unique(model.camera_of[kept], return_inverse=True)
    seen = with_observations(model, here)
    return replace(
        seen,
        cameras=tuple(model.cameras[int(c)] for c in cameras),
        rows=model.rows[kept],
        camera_of=camera_of.reshape(-1).astype(np.int64),
        cam_from_sfm=tuple(p for p, yes in zip(model.cam_from_sfm, kept.tolist(), strict=True) if yes),
        photo_of=(np.cumsum(kept) - 1)[seen.photo_of].astype(np.int64),
    )
