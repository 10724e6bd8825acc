"""Matches between a photo and pooled features of renders, without and with a pose to look from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.nearest import nearest
from ingest.register.frame.features.pool import Pool

_NEIGHBOURS = 8  # one place is in as many renders of the star; the next place must be among them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameMatches:
    """Photo pixels with the scan points that they may show.

    Attributes:
        pixels: (m, 2) full-size pixels. points: (m, 3) local frame, metres.
    """

    pixels: FloatArray
    points: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "FrameMatches":
        return FrameMatches(pixels=self.pixels[rows], points=self.points[rows])


def joined(parts: Sequence[FrameMatches]) -> FrameMatches:
    """All matches of all parts; none for no parts."""
    return FrameMatches(
        pixels=np.concatenate([np.empty((0, 2)), *(p.pixels for p in parts)]),
        points=np.concatenate([np.empty((0, 3)), *(p.points for p in parts)]),
    )


def pooled_matches(features: Features, pool: Pool, same_place_m: float, max_ratio: float) -> FrameMatches:
    """Each feature's nearest pooled one, where the next nearest *elsewhere* is farther by the ratio.

    One place appears in several renders of the pool: those do not compete.
    """
    if len(features) == 0 or len(pool) == 0:
        return joined([])
    squared, row = nearest(features.descriptors, pool.descriptors, _NEIGHBOURS)
    place = pool.points[row]
    apart = (np.linalg.norm(place - place[:, :1], axis=2) > same_place_m) & (row >= 0)
    other = np.where(apart.any(axis=1), squared[np.arange(len(row)), apart.argmax(axis=1)], squared[:, -1])
    keep = np.flatnonzero((squared[:, 0] < max_ratio**2 * other) & (row[:, 0] >= 0))
    return FrameMatches(pixels=features.xy[keep].astype(np.float64), points=pool.points[row[keep, 0]])


def guided_matches(
    features: Features,
    pool: Pool,
    camera: Camera,
    cam_from_local: Rigid3,
    radius_px: float,
    same_place_m: float,
    max_ratio: float,
) -> FrameMatches:
    """Each feature's best pooled one among those that a pose puts within `radius_px` of it.

    A match must be the best of both its ends, and beat the next place within the radius by the ratio.
    """
    projected = camera.project(cam_from_local.act(pool.points))
    seen = np.flatnonzero(np.isfinite(projected).all(axis=1))
    if len(features) == 0 or len(seen) == 0:
        return joined([])
    k = min(24, len(seen))
    found = cKDTree(projected[seen]).query(features.xy, k=k, distance_upper_bound=radius_px)
    distance, near = (np.asarray(part).reshape(len(features), k) for part in found)
    missing = ~np.isfinite(distance)
    row = seen[np.where(missing, 0, near)]
    squared = np.empty(row.shape, np.float32)
    wanted = features.descriptors.astype(np.float32)
    for column in range(k):
        difference = pool.descriptors[row[:, column]].astype(np.float32) - wanted
        squared[:, column] = np.einsum("nd,nd->n", difference, difference)
    squared[missing] = np.inf
    best = squared.argmin(axis=1)
    lowest = squared[np.arange(len(row)), best]
    chosen = row[np.arange(len(row)), best]
    apart = np.linalg.norm(pool.points[row] - pool.points[chosen][:, None], axis=2) > same_place_m
    other = np.where(apart, squared, np.inf).min(axis=1)
    keep = np.isfinite(lowest) & (lowest < max_ratio**2 * other)
    keep &= _best_of_their_place(pool.points[chosen], lowest, keep, same_place_m / 4.0)
    return FrameMatches(pixels=features.xy[keep].astype(np.float64), points=pool.points[chosen[keep]])


def _best_of_their_place(
    points: FloatArray, squared: NDArray[np.float32], among: NDArray[np.bool_], cell_m: float
) -> NDArray[np.bool_]:
    """Of the matches that claim one place of the scan, the one with the most similar descriptor."""
    rows = np.flatnonzero(among)
    rows = rows[np.argsort(squared[rows], kind="stable")]
    cells = np.floor(points[rows] / cell_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    result = np.zeros(len(points), dtype=bool)
    result[rows[first]] = True
    return result
