"""Matches of two photos and their geometry: the strongest features find it, all features are held to it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import TwoView, verify_pair
from ingest.sfm.overlays import without_overlay

_DESCRIPTOR_LENGTH = 512.0  # of 8-bit RootSIFT
_AROUND = 0.15  # of the longer side: what lies further from all first matches is not in both photos
_STRIP = 400  # features that are matched at once; more lie along more epipolar lines
_AT_ONCE = 500  # queries, whose products are in memory


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """How pairs are matched and verified.

    Attributes:
        max_ratio: angle to the nearest descriptor over angle to the second nearest (Lowe's 0.8),
            below it in both directions.
        max_angle_rad: no match between descriptors further apart (COLMAP's 0.7).
        max_error_px: of the two-view geometry, at `error_reference_side_px`, growing with the image.
        error_reference_side_px: keypoints are located on images of about this size.
        first_features: strongest features of each photo, which find the geometry.
        least_first: a pair with fewer verified matches among them is not matched further. 300 of 304 pairs
            of `seneca` and `brighton` have as many that all features verify, and 5 to 14 % of the others.
        band: matches of all features lie so near the epipolar lines of the first, as a share of the longer
            side. Of the verified matches of `seneca` and `brighton` 99.95 % do.
        min_inliers: pairs with fewer verified matches do not count. Pairs of `brighton` and `lewis` had
            none at all; repeated structure gives more, and two good photos hundreds.
        seed: of RANSAC.
    """

    max_ratio: float = 0.8
    max_angle_rad: float = 0.7
    max_error_px: float = 2.0
    error_reference_side_px: int = 1600
    first_features: int = 3000
    least_first: int = 8
    band: float = 0.02
    min_inliers: int = 20
    seed: int = 0


def pair_geometry(
    a: Features, b: Features, cameras: tuple[Camera, Camera], focal_known: bool, options: MatchOptions
) -> TwoView:
    """Verified matches of two photos.

    The strongest features tell whether two photos show the same at all, for a sixteenth of the time, and how
    the cameras stood: each of the others is compared with those near its epipolar line alone.

    Args:
        focal_known: both cameras have a focal length to be trusted.
    """
    sizes = (a.width, a.height), (b.width, b.height)
    zoom = max(1.0, max(max(sizes)) / options.error_reference_side_px)

    def verified(matches: NDArray[np.uint32], least: int) -> TwoView:
        return verify_pair(
            cameras[0],
            a.xy,
            cameras[1],
            b.xy,
            without_overlay(a.xy, b.xy, *sizes, matches),
            focal_known=focal_known,
            max_error_px=options.max_error_px * zoom,
            least_inliers=least,
            seed=options.seed,
        )

    count = options.first_features
    first = mutual_matches(a.descriptors[:count], b.descriptors[:count], options)
    if max(len(a), len(b)) <= count:
        return verified(first, options.min_inliers)
    view = verified(first, options.least_first)
    if not len(view.inliers) or view.is_watermark:
        return view
    return verified(guided_matches(a, b, view, cameras, options), options.min_inliers)


def guided_matches(
    a: Features, b: Features, first: TwoView, cameras: tuple[Camera, Camera], options: MatchOptions
) -> NDArray[np.uint32]:
    """Mutual matches of two photos near the epipolar lines of their geometry: rows (m, 2) of a and b."""
    side = max(a.width, a.height, b.width, b.height)
    in_a = _around(a, first.inliers[:, 0], _AROUND * side)
    in_b = _around(b, first.inliers[:, 1], _AROUND * side)
    part_a, part_b = _Part.of(a, in_a), _Part.of(b, in_b)
    fundamental, band_px = _fundamental(first, cameras), options.band * side
    nearest_b = _nearest_along(part_a, part_b, fundamental, band_px, options)
    rows = np.flatnonzero(nearest_b >= 0)
    candidates, place = np.unique(nearest_b[rows], return_inverse=True)
    nearest_a = _nearest_along(part_b.rows(candidates), part_a, fundamental.T, band_px, options)
    mutual = rows[nearest_a[place] == rows]
    return np.stack([in_a[mutual], in_b[nearest_b[mutual]]], axis=1).astype(np.uint32)


def _fundamental(view: TwoView, cameras: tuple[Camera, Camera]) -> FloatArray:
    """Of the essential matrix where there is one: of a plane, any epipole would do for the other."""
    if not view.essential.any():
        return view.fundamental
    inverse_a, inverse_b = (np.linalg.inv(c.to_pycolmap().calibration_matrix()) for c in cameras)
    return np.asarray(inverse_b.T @ view.essential @ inverse_a)


def mutual_matches(
    descriptors_a: NDArray[np.uint8], descriptors_b: NDArray[np.uint8], options: MatchOptions
) -> NDArray[np.uint32]:
    """Mutual nearest neighbours that pass the ratio test in both directions: rows (m, 2) of a and b."""
    if len(descriptors_a) < 2 or len(descriptors_b) < 2:
        return np.zeros((0, 2), np.uint32)
    nearest_b = _distinct_nearest(descriptors_a, descriptors_b, options)
    rows = np.flatnonzero(nearest_b >= 0)
    candidates, place = np.unique(nearest_b[rows], return_inverse=True)
    nearest_a = _distinct_nearest(descriptors_b[candidates], descriptors_a, options)
    mutual = nearest_a[place] == rows
    return np.stack([rows[mutual], nearest_b[rows[mutual]]], axis=1).astype(np.uint32)


def _distinct_nearest(
    queries: NDArray[np.uint8], base: NDArray[np.uint8], options: MatchOptions
) -> NDArray[np.int64]:
    """Row of base (n,) nearest to each query, -1 where it is too far or the second nearest is as near.

    Integers of this size are exact in float32, so the order of summation does not matter. FAISS takes three
    times as long for some hundred queries.
    """
    of_base = base.astype(np.float32)
    half_squares = 0.5 * np.einsum("ij,ij->i", of_base, of_base)
    found = np.full(len(queries), -1, np.int64)
    for start in range(0, len(queries), _AT_ONCE):
        own = queries[start : start + _AT_ONCE].astype(np.float32)
        closeness = own @ of_base.T  # half of what the distance falls short of the squares by
        closeness -= half_squares
        each, rows = np.arange(len(own)), closeness.argmax(axis=1)
        first = closeness[each, rows]
        closeness[each, rows] = -np.inf
        squares = np.einsum("ij,ij->i", own, own)
        angles, others = (_angles(squares - 2.0 * near) for near in (first, closeness.max(axis=1)))
        good = (angles < options.max_ratio * others) & (angles <= options.max_angle_rad)
        found[start : start + _AT_ONCE] = np.where(good, rows, -1)
    return found


def _angles(squared: NDArray[np.float32]) -> NDArray[np.float32]:
    """Between descriptors at these squared distances, radians."""
    chord = np.sqrt(np.maximum(squared, 0.0)) / (2.0 * _DESCRIPTOR_LENGTH)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Some features of a photo: pixels (n, 2) float64 and descriptors (n, 128)."""

    xy: FloatArray
    descriptors: NDArray[np.uint8]

    @classmethod
    def of(cls, photo: Features, rows: NDArray[np.int64]) -> "_Part":
        return cls(photo.xy[rows].astype(np.float64), photo.descriptors[rows])

    def rows(self, chosen: NDArray[np.int64]) -> "_Part":
        """Some of them."""
        return _Part(self.xy[chosen], self.descriptors[chosen])


def _around(photo: Features, rows: NDArray[np.uint32], margin_px: float) -> NDArray[np.int64]:
    """Rows of the features in the box around these, made larger on each side."""
    low, high = photo.xy[rows].min(axis=0) - margin_px, photo.xy[rows].max(axis=0) + margin_px
    return np.flatnonzero(((photo.xy >= low) & (photo.xy <= high)).all(axis=1))


def _nearest_along(
    queries: _Part, base: _Part, fundamental: FloatArray, band_px: float, options: MatchOptions
) -> NDArray[np.int64]:
    """As `_distinct_nearest`, each query among what lies near its epipolar line.

    Queries go in strips along the epipolar lines of their own photo. What lies between the lines of a
    strip's corners is near one of the strip's.
    """
    found = np.full(len(queries.xy), -1, np.int64)
    pixels = np.column_stack([base.xy, np.ones(len(base.xy))])
    along = _along(fundamental, pixels)
    across = queries.xy @ along
    order = np.argsort(across[:, 0], kind="stable")
    for strip in np.array_split(order, max(1, round(len(order) / _STRIP))):
        (left, top), (right, bottom) = across[strip].min(axis=0), across[strip].max(axis=0)
        corners = np.array([[left, top], [left, bottom], [right, top], [right, bottom]]) @ along.T
        lines = np.column_stack([corners, np.ones(4)]) @ fundamental.T
        off, reach = lines @ pixels.T, band_px * np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
        near = np.flatnonzero((off <= reach).any(axis=0) & (off >= -reach).any(axis=0))
        if len(near) >= 2:
            rows = _distinct_nearest(queries.descriptors[strip], base.descriptors[near], options)
            found[strip] = np.where(rows >= 0, near[rows], -1)
    return found


def _along(fundamental: FloatArray, pixels: FloatArray) -> FloatArray:
    """Axes (2, 2), as columns, across and along the epipolar line of the middle of these pixels (n, 3)."""
    normal = (fundamental.T @ pixels.mean(axis=0))[:2]
    size = float(np.linalg.norm(normal))
    x, y = normal / size if size > 0.0 else (1.0, 0.0)
    return np.array([[x, -y], [y, x]])
