"""How well two pictures of one place agree: mutual information, gradient correlation, oriented gradients."""

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray

_LEAST_PIXELS = 16


def mutual_information(
    first: NDArray[np.generic],
    second: NDArray[np.generic],
    valid: NDArray[np.bool_] | None = None,
    *,
    bins: int = 32,
    normalised: bool = False,
    smoothing_bins: float = 0.0,
) -> float:
    """Mutual information of two grey pictures of one shape, in nats (paper, equations 4 and 5).

    I = H(A) + H(B) - H(A, B) of the joint histogram over valid pixels. Normalised it is (H(A) + H(B)) / H(A,
    B) - 1 (Studholme, Hill, Hawkes 1999, less one): it does not grow when the overlap shrinks to something
    busy.

    Args:
        bins: of each axis, equally wide between the 1st and the 99th percentile; what lies outside falls into
            the first and the last.
        smoothing_bins: sigma of a Gaussian over the joint histogram, which makes the measure smooth in the
            pose when pixels are few.

    Returns:
        0.0 where fewer than 16 pixels are valid or one picture is of one value.
    """
    a, b = _valid_values(first, second, valid)
    if len(a) < _LEAST_PIXELS:
        return 0.0
    return information_of(
        joint_histogram(_binned(a, bins), _binned(b, bins), bins), normalised, smoothing_bins
    )


def joint_histogram(a: NDArray[np.int64], b: NDArray[np.int64], bins: int) -> FloatArray:
    """Counts (bins, bins) of pairs of bin numbers (n,)."""
    return np.bincount(a * bins + b, minlength=bins * bins).reshape(bins, bins).astype(np.float64)


def information_of(joint: FloatArray, normalised: bool = False, smoothing_bins: float = 0.0) -> float:
    """Mutual information, in nats or normalised, of a joint histogram of counts."""
    if smoothing_bins > 0:
        joint = cv2.GaussianBlur(joint, (0, 0), smoothing_bins, borderType=cv2.BORDER_CONSTANT)
    p = joint / max(float(joint.sum()), 1e-300)
    own = _entropy(p.sum(axis=1)) + _entropy(p.sum(axis=0))
    both = _entropy(p.ravel())
    if normalised:
        return own / both - 1.0 if both > 1e-12 else 0.0
    return max(own - both, 0.0)


def gradient_correlation(
    first: NDArray[np.generic],
    second: NDArray[np.generic],
    valid: NDArray[np.bool_] | None = None,
    *,
    magnitudes: bool = False,
) -> float:
    """Mean of the normalised correlations of horizontal and of vertical derivatives, in [-1, 1].

    Penney and others, "A comparison of similarity measures for use in 2-D-3-D medical image registration",
    IEEE Trans. Medical Imaging 1998 (the paper's reference 11). Derivatives are central differences at
    pixels whose four neighbours are valid.

    Args:
        magnitudes: correlate the lengths of the gradients instead: for laser intensity, where what is bright
            in the photo may be dark.

    Returns:
        0.0 where fewer than 16 pixels count or one of the derivatives is constant.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    _check_shapes(a, b, valid)
    ok = np.ones(a.shape, bool) if valid is None else valid
    ok = ok[1:-1, :-2] & ok[1:-1, 2:] & ok[:-2, 1:-1] & ok[2:, 1:-1]
    (ax, ay), (bx, by) = ([g[ok] for g in _derivatives(picture)] for picture in (a, b))
    if magnitudes:
        return correlation(np.hypot(ax, ay), np.hypot(bx, by))
    return 0.5 * (correlation(ax, bx) + correlation(ay, by))


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Pearson's correlation of two vectors (n,); 0.0 for fewer than 16 or constant ones."""
    if len(a) < _LEAST_PIXELS:
        return 0.0
    x, y = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / norm if norm > 1e-12 else 0.0


def oriented_agreement(
    first: NDArray[np.float32], second: NDArray[np.float32], valid: NDArray[np.bool_] | None = None
) -> float:
    """Correlation, in [-1, 1], of oriented-gradient channels (k, h, w) over valid pixels (h, w)."""
    if first.shape != second.shape or first.ndim != 3:
        raise InvalidValueError(
            f"oriented_agreement: expected two (k, h, w) of one shape, found {first.shape} and {second.shape}"
        )
    a, b = (first, second) if valid is None else (first[:, valid], second[:, valid])
    norm = float(np.sqrt(np.sum(a * a, dtype=np.float64) * np.sum(b * b, dtype=np.float64)))
    return float(np.sum(a * b, dtype=np.float64)) / norm if norm > 1e-12 else 0.0


def _derivatives(picture: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Central differences along x and y, (h - 2, w - 2)."""
    dx = 0.5 * (picture[1:-1, 2:] - picture[1:-1, :-2])
    dy = 0.5 * (picture[2:, 1:-1] - picture[:-2, 1:-1])
    return dx, dy


def _binned(values: FloatArray, bins: int) -> NDArray[np.int64]:
    low, high = np.percentile(values, (1.0, 99.0))
    if high <= low:
        low, high = float(values.min()), float(values.max())
    width = (high - low) / bins if high > low else 1.0
    return np.asarray(np.clip(np.floor((values - low) / width), 0, bins - 1), dtype=np.int64)


def _entropy(p: FloatArray) -> float:
    q = p[p > 0]
    return float(-np.sum(q * np.log(q)))


def _valid_values(
    first: NDArray[np.generic], second: NDArray[np.generic], valid: NDArray[np.bool_] | None
) -> tuple[FloatArray, FloatArray]:
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    _check_shapes(a, b, valid)
    return (a.ravel(), b.ravel()) if valid is None else (a[valid], b[valid])


def _check_shapes(a: FloatArray, b: FloatArray, valid: NDArray[np.bool_] | None) -> None:
    shapes = [a.shape, b.shape] + ([] if valid is None else [valid.shape])
    if a.ndim != 2 or len(set(shapes)) != 1:
        raise InvalidValueError(f"agreement: expected pictures and mask of one shape (h, w), found {shapes}")
