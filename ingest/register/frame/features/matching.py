"""Features of renders, pooled with the scan points that they show, and their matches with a photo."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.index.nearest import nearest
from featuredb.render.renderer import Rendering
from ingest.register.frame.views import source_image
from ingest.register.frame_registration import RenderSource

# The product's, with a lower contrast threshold than photos get, since renders are smooth.
_EXTRACTOR = ExtractorOptions(
    first_octave_px=3200, max_features=3000, oversample=1.5, contrast_threshold=0.008
)
# A feature whose surroundings differ by more than this share in depth lies on a silhouette: what it shows is
# two things, and its depth is a guess.
_MAX_DEPTH_STEP = 0.04
_CLEAR_OF_VOID = 0.75  # a feature must keep so many of its radii away from where the render is empty


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pool:
    """Features of renders with their scan points.

    Attributes:
        points: (n, 3) local frame, metres.
        descriptors: (n, 128) uint8.
    """

    points: FloatArray
    descriptors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)


def pool_features(rendering: Rendering, source: RenderSource, *, upright: bool = True) -> Pool:
    """Features of a render, lifted to the scan by its depth.

    Args:
        upright: without orientations of their own; the photo is turned as the render is.

    Raises:
        InvalidValueError: the scan does not have `source`.
    """
    image = filled(source_image(rendering, source), rendering.valid)
    features = extract(image, replace(_EXTRACTOR, upright=upright))
    points, good = lift(rendering, features.xy)
    clear = cv2.distanceTransform(np.pad(rendering.valid, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    column = np.clip(features.xy[:, 0].astype(np.int64), 0, image.shape[1] - 1)
    row = np.clip(features.xy[:, 1].astype(np.int64), 0, image.shape[0] - 1)
    good &= clear[row, column] >= _CLEAR_OF_VOID * 0.5 * features.scale
    return Pool(points=points[good], descriptors=features.descriptors[good])


def filled(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The image with its empty parts filled by what lies around them, so that their borders are no edges."""
    if valid.all():
        return image
    weight, value = valid.astype(np.float32), np.where(valid, image, 0).astype(np.float32)
    result = value
    missing = ~valid
    for size in (15, 61, 241):
        w = cv2.blur(weight, (size, size))
        guess = cv2.blur(value, (size, size)) / np.maximum(w, 1e-6)
        use = missing & (w > 1e-3)
        result = np.where(use, guess, result)
        missing &= ~use
    rest = float(value[valid].mean()) if valid.any() else 0.0
    return np.asarray(np.clip(np.where(missing, rest, result), 0, 255), dtype=np.uint8)


def lift(rendering: Rendering, xy: NDArray[np.floating]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Scan points (n, 3) under pixels (n, 2) of a render, and which of them can be trusted.

    Not trusted: nothing seen, a closed hole, or a silhouette among the pixel and its neighbours. Points that
    are not trusted are zero.
    """
    height, width = rendering.depth.shape
    column = np.floor(xy[:, 0]).astype(np.int64)
    row = np.floor(xy[:, 1]).astype(np.int64)
    good = (column >= 1) & (column < width - 1) & (row >= 1) & (row < height - 1)
    column, row = np.clip(column, 1, width - 2), np.clip(row, 1, height - 2)
    around = np.stack(
        [rendering.depth[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], axis=1
    )
    depth = rendering.depth[row, column].astype(np.float64)
    good &= np.isfinite(around).all(axis=1) & (rendering.index[row, column] >= 0)
    span = np.where(good, np.ptp(np.where(np.isfinite(around), around, 0.0), axis=1), np.inf)
    good &= span <= _MAX_DEPTH_STEP * np.where(good, depth, 1.0)
    rays = np.column_stack([rendering.camera.unproject(xy), np.ones(len(xy))])
    good &= np.isfinite(rays).all(axis=1)
    in_camera = np.where(good[:, None], rays * np.where(good, depth, 0.0)[:, None], 0.0)
    points = rendering.cam_from_local.inverse().act(in_camera)
    return np.where(good[:, None], points, 0.0), good


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


NO_MATCHES = FrameMatches(pixels=np.empty((0, 2)), points=np.empty((0, 3)))


def pooled_matches(features: Features, pool: Pool, same_place_m: float, max_ratio: float) -> FrameMatches:
    """Each feature's nearest pooled one, where the next nearest *elsewhere* is farther by the ratio.

    One place appears in several renders of the pool: those do not compete.
    """
    if len(features) == 0 or len(pool) == 0:
        return NO_MATCHES
    squared, row = nearest(features.descriptors, pool.descriptors, _NEIGHBOURS)
    place = pool.points[row]
    apart = (np.linalg.norm(place - place[:, :1], axis=2) > same_place_m) & (row >= 0)
    other = np.where(apart.any(axis=1), squared[np.arange(len(row)), apart.argmax(axis=1)], squared[:, -1])
    keep = np.flatnonzero((squared[:, 0] < max_ratio**2 * other) & (row[:, 0] >= 0))
    return FrameMatches(pixels=features.xy[keep].astype(np.float64), points=pool.points[row[keep, 0]])
