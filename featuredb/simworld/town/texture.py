"""Random fields with the spectra of natural surfaces; a texture: an image with its size and pyramid."""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

Image32 = NDArray[np.float32]


def fractal(
    height: int, width: int, rng: np.random.Generator, *, octaves: int = 7, gain: float = 1.5
) -> Image32:
    """Noise (height, width) float32 with zero mean and unit standard deviation; each coarser octave is `gain`
    times as strong (gain 2 is close to a 1/f^2 spectrum, 1 is white). Not periodic."""
    field: Image32 = np.zeros((2, 2), np.float32)
    for k in range(octaves - 1, -1, -1):
        size = max(2, -(-height // 2**k)), max(2, -(-width // 2**k))
        field = np.asarray(cv2.resize(field, size[::-1], interpolation=cv2.INTER_CUBIC))
        field += rng.standard_normal(size, dtype=np.float32) * np.float32(gain**k)
    return _normalised(field)


def periodic(
    size: int, rng: np.random.Generator, *, exponent: float = 1.0, low: float = 1.0, high: float = 1e9
) -> Image32:
    """Noise (size, size) float32 that tiles without a seam, zero mean, unit standard deviation.

    Amplitude falls with 1 / f^exponent between `low` and `high` cycles per tile and is zero outside.
    """
    spectrum = np.fft.rfft2(rng.standard_normal((size, size), dtype=np.float32))
    fy, fx = np.fft.fftfreq(size, 1 / size), np.fft.rfftfreq(size, 1 / size)
    f = np.hypot(fy[:, None], fx[None])
    weight = np.where((f >= low) & (f <= high), 1.0 / np.maximum(f, 1.0) ** exponent, 0.0)
    return _normalised(np.fft.irfft2(spectrum * weight, s=(size, size)).astype(np.float32))


def _normalised(field: Image32) -> Image32:
    mean, deviation = cv2.meanStdDev(field)
    field -= np.float32(mean[0, 0])
    field *= np.float32(1.0 / deviation[0, 0])
    return field


Image8 = NDArray[np.uint8]

_SMALLEST_LEVEL_PX = 8  # a level below this is one colour for all that matters


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Texture:
    """Levels (h, w, 3) uint8 RGB, each half the one before, by area average.

    Row and column run with v and u; texel (row i, column j) of level 0 covers u in [j, j+1) * texel_m.

    Attributes:
        texel_m: size of a texel of level 0, metres.
    """

    levels: tuple[Image8, ...]
    texel_m: float

    @classmethod
    def from_image(cls, image: Image8, texel_m: float) -> Self:
        """Build the pyramid; odd sizes lose their last row or column in the next level."""
        levels = [np.ascontiguousarray(image)]
        while min(levels[-1].shape[:2]) >= 2 * _SMALLEST_LEVEL_PX:
            above = levels[-1]
            h, w = above.shape[0] // 2, above.shape[1] // 2
            half = cv2.resize(above[: 2 * h, : 2 * w], (w, h), interpolation=cv2.INTER_AREA)
            levels.append(np.asarray(half, dtype=np.uint8))
        return cls(levels=tuple(levels), texel_m=texel_m)

    @property
    def extent_m(self) -> tuple[float, float]:
        """Width (u) and height (v) of the image, metres."""
        height, width = self.levels[0].shape[:2]
        return width * self.texel_m, height * self.texel_m

    def sample(self, u: NDArray[np.float32], v: NDArray[np.float32], level: int) -> Image8:
        """Bilinear colours (..., 3) uint8 at u, v (2-D arrays, metres), of one level; the texture repeats."""
        scale = np.float32(1.0 / (self.texel_m * 2**level))
        return np.asarray(
            cv2.remap(
                self.levels[level],
                u * scale - np.float32(0.5),
                v * scale - np.float32(0.5),
                cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_WRAP,
            ),
            dtype=np.uint8,
        )


def to_image(rgb: NDArray[np.float32]) -> Image8:
    """Colours in 0..255 as float to uint8."""
    image: Image8 = np.clip(rgb + 0.5, 0, 255).astype(np.uint8)
    return image
