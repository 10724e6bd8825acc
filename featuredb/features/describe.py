"""Descriptors at keypoints that another program has found: this extractor's, in its own scale space."""

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.features.extractor import (
    OCTAVE_LAYERS,
    SIGMA,
    ExtractorOptions,
    create_sift,
    rootsift_8bit,
)
from featuredb.features.shrink import shrunk
from featuredb.geometry.arrays import FloatArray

# The smallest diameter that the extractor finds: half a layer below the first, in the doubled image.
_FINEST_PX = 0.999 * 2.0 * SIGMA * 2.0 ** (0.5 / OCTAVE_LAYERS - 1.0)


def describe_at(
    gray: NDArray[np.uint8],
    xy: NDArray[np.float32],
    scale: NDArray[np.float32],
    angle: NDArray[np.float32],
) -> NDArray[np.uint8]:
    """RootSIFT (n, 128) at given keypoints.

    The photo is shrunk as for extraction, unless a keypoint is finer than what then is left of it. A diameter
    says in which octave and layer of the scale space the extractor would have found the keypoint; one that
    lies between two layers may get the other one.

    Args:
        gray: (h, w) uint8.
        xy: (n, 2) full-size pixels, centre of the top-left pixel (0.5, 0.5). scale: (n,) diameters in pixels.
        angle: (n,) degrees clockwise from the x axis.

    Raises:
        ImageError: OpenCV does not describe all of them.
    """
    if not len(xy):
        return np.zeros((0, 128), np.uint8)
    small, places, diameters = shrunk_for(gray, xy, scale)
    keypoints = [
        cv2.KeyPoint(x, y, diameter, float(turn), 1.0, _packed(diameter), row)
        for row, ((x, y), diameter, turn) in enumerate(
            zip(places.tolist(), diameters.tolist(), angle, strict=True)
        )
    ]
    kept, raw = create_sift().compute(small, keypoints)
    if [k.class_id for k in kept] != list(range(len(xy))):
        raise ImageError(f"expected descriptors of {len(xy)} keypoints, OpenCV gives {len(kept)}")
    return rootsift_8bit(raw)


def shrunk_for(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], FloatArray, FloatArray]:
    """The photo as it is described, and there the keypoints' places (n, 2), as OpenCV counts, and diameters.

    Args:
        gray, xy, scale: as for `describe_at`, at least one keypoint.
    """
    small = shrunk(gray, ExtractorOptions().max_side_px)
    if float(scale.min()) * max(small.shape) / max(gray.shape) < _FINEST_PX:
        small = gray
    ratio = np.array(small.shape[::-1]) / gray.shape[::-1]
    return small, xy.astype(np.float64) * ratio - 0.5, scale.astype(np.float64) * ratio.mean()


def octave_and_layer(diameter: float) -> tuple[int, int]:
    """Where the extractor's scale space has a keypoint of this diameter in pixels of the shrunk photo.

    Octave -1 is the doubled image.
    """
    step = round(OCTAVE_LAYERS * float(np.log2(diameter / (2.0 * SIGMA))))
    octave = max((step - 1) // OCTAVE_LAYERS, -1)
    return octave, max(step - OCTAVE_LAYERS * octave, 0)


def _packed(diameter: float) -> int:
    """OpenCV's packed octave and layer of a keypoint's diameter."""
    octave, layer = octave_and_layer(diameter)
    return (octave & 255) | (layer << 8)
