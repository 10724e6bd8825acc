"""Whether two frames show the same: across a blink, a blur or a pan, but not across a cut."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class SameSceneOptions:
    """When two frames show the same at the same focal length.

    Attributes:
        features: of each. max_ratio: of a match's distance to that of the next best one.
        tolerance_rel: by which matches may miss a similarity of the picture, a share of the longer side;
            depth moves them.
        columns, rows: of a grid over the picture. least_cells: share of its cells with features that must
            have some that agree. Logos and captions match, but in few cells.
        max_zoom: between frames a moment apart; more is another lens.
    """

    features: ExtractorOptions = field(
        default_factory=lambda: ExtractorOptions(max_side_px=640, max_features=600)
    )
    max_ratio: float = 0.8
    tolerance_rel: float = 0.02
    columns: int = 8
    rows: int = 6
    least_cells: float = 0.25
    max_zoom: float = 1.1


def same_scene(
    one: NDArray[np.uint8], other: NDArray[np.uint8], options: SameSceneOptions | None = None
) -> bool:
    """Whether two grey frames (h, w) of one size show the same, moved and turned as may be."""
    options = options or SameSceneOptions()
    a, b = (extract(gray, options.features) for gray in (one, other))
    start, end = matched(a, b, options.max_ratio)
    if len(start) < 8:
        return False
    cv2.setRNGSeed(0)  # as in motion.py
    found, agree = cv2.estimateAffinePartial2D(
        start, end, method=cv2.RANSAC, ransacReprojThreshold=options.tolerance_rel * max(one.shape)
    )
    if found is None:
        return False
    zoom = float(np.hypot(found[0, 0], found[1, 0]))
    if not 1.0 / options.max_zoom <= zoom <= options.max_zoom:
        return False
    held = _cells(start[agree.reshape(-1) == 1], one.shape, options)
    return len(held) >= options.least_cells * len(_cells(a.xy, one.shape, options))


def matched(one: Features, other: Features, max_ratio: float) -> tuple[FloatArray, FloatArray]:
    """Pixels (m, 2) of both frames of features that are each other's nearest, and clearly so."""
    if min(len(one), len(other)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    a, b = (f.descriptors.astype(np.float32) for f in (one, other))
    a, b = (d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6) for d in (a, b))
    distance = np.sqrt(np.maximum(2.0 - 2.0 * a @ b.T, 0.0))
    best = distance.argmin(axis=1)
    two = np.partition(distance, 1, axis=1)[:, :2]
    mutual = distance.argmin(axis=0)[best] == np.arange(len(best))
    rows = np.flatnonzero(mutual & (two[:, 0] < max_ratio * two[:, 1]))
    return one.xy[rows].astype(np.float64), other.xy[best[rows]].astype(np.float64)


def _cells(
    xy: FloatArray | NDArray[np.float32], shape: tuple[int, ...], options: SameSceneOptions
) -> set[int]:
    """Numbers of the cells that pixels (n, 2) lie in."""
    column = (xy[:, 0] * options.columns / shape[1]).astype(int)
    row = (xy[:, 1] * options.rows / shape[0]).astype(int)
    return set((row * options.columns + column).tolist())
