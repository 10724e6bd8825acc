"""Descriptors and orientations at keypoints that another program has found: this extractor's.

The photo is shrunk as for extraction, unless a keypoint is finer than what then is left of it. A diameter
says in which octave and layer of the scale space the extractor would have found the keypoint.
"""

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions, rootsift_8bit
from featuredb.features.scale_space import LAYERS, SIGMA, ScaleSpace, ScaleSpacePoints

# The smallest diameter that the extractor finds: half a layer above the first octave's first image.
_FINEST_PX = 0.999 * 2.0 * SIGMA * 2.0 ** (0.5 / LAYERS)


def describe_at(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32], angle: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """RootSIFT (n, 128) at given keypoints.

    Args:
        gray: (h, w) uint8.
        xy: (n, 2) full-size pixels, centre of the top-left pixel (0.5, 0.5). scale: (n,) diameters in pixels.
        angle: (n,) degrees clockwise from the x axis.

    Raises:
        ImageError: a place or diameter is no finite number, or a diameter is not above zero.
    """
    if not len(xy):
        return np.zeros((0, 128), np.uint8)
    space, points = _placed(gray, xy, scale)
    return rootsift_8bit(space.descriptors(points, angle))


def orientations_at(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Orientation (n,) of given keypoints, degrees in [0, 360), clockwise from the x axis: the strongest; 0
    where there is none.

    Args:
        gray, xy, scale: as for `describe_at`.
    """
    if not len(xy):
        return np.zeros(0, np.float32)
    space, points = _placed(gray, xy, scale)
    angles, counts = space.orientations(points)
    return np.where(counts > 0, angles[:, 0], np.float32(0.0))


def _placed(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32]
) -> tuple[ScaleSpace, ScaleSpacePoints]:
    space = ScaleSpace(gray, ExtractorOptions().first_octave_px)
    if float(scale.min()) * max(space.width, space.height) / max(gray.shape) < _FINEST_PX:
        space = ScaleSpace(gray, 2 * max(gray.shape))
    ratio = np.array([space.width, space.height]) / gray.shape[::-1]
    places, diameters = xy.astype(np.float64) * ratio, scale.astype(np.float64) * ratio.mean()
    return space, ScaleSpacePoints.at(places, diameters, len(space.octaves))
