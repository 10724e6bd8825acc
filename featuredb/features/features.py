"""The features of one image."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import freeze

DESCRIPTOR_SIZE = 128


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Keypoints with RootSIFT descriptors of one image, in the image's own full-size pixels.

    Attributes:
        xy: (n, 2) float32, pixels of the full-size image; centre of the top-left pixel is (0.5, 0.5).
        scale: (n,) float32, keypoint diameter in full-size pixels.
        angle: (n,) float32, degrees in [0, 360), clockwise from the x axis (OpenCV); 0 when upright.
        response: (n,) float32, the detector's contrast; larger is stronger.
        descriptors: (n, 128) uint8, round(512 sqrt(d / |d|_1)) clipped to 255; length about 512.
        width, height: full size of the image in pixels.
        fingerprint: which extractor made the descriptors; only equal fingerprints may be compared.
    """

    xy: NDArray[np.float32]
    scale: NDArray[np.float32]
    angle: NDArray[np.float32]
    response: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    width: int
    height: int
    fingerprint: str

    def __post_init__(self) -> None:
        freeze(self, np.float32, xy=(None, 2))
        n = len(self.xy)
        freeze(self, np.float32, scale=(n,), angle=(n,), response=(n,))
        freeze(self, np.uint8, descriptors=(n, DESCRIPTOR_SIZE))
        if self.width <= 0 or self.height <= 0:
            raise InvalidValueError(f"Features: expected a size > 0, found {self.width}x{self.height}")

    def __len__(self) -> int:
        return len(self.xy)

    def take(self, rows: NDArray[Any]) -> "Features":
        """The features of the given rows (index or boolean array (n,)), in that order."""
        arrays = ("xy", "scale", "angle", "response", "descriptors")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})
