"""Random fields with the spectra of natural surfaces."""

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
