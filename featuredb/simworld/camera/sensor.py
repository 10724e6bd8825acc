"""From a rendered picture to a photo: lens, exposure, noise, JPEG."""

import io
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from featuredb.simworld.town.texture import Image8, to_image


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """What a small camera does to the light.

    Attributes:
        blur_px: standard deviation of lens and motion blur.
        vignetting: share of light lost in the corner.
        exposure_sigma_ev: spread of the exposure between photos, stops.
        white_balance_sigma: spread of the red and blue gains between photos.
        read_noise: standard deviation in grey levels, independent of the light.
        shot_noise: standard deviation in grey levels at mid grey (128), growing with the root of the light.
    """

    blur_px: float = 0.55  # a sharp lens over a Bayer pattern
    vignetting: float = 0.22
    exposure_sigma_ev: float = 0.16
    white_balance_sigma: float = 0.03
    read_noise: float = 1.0
    shot_noise: float = 2.2


def expose(rgb: Image8, rng: np.random.Generator, options: SensorOptions) -> Image8:
    """The photo (h, w, 3) uint8 that a sensor makes of the light `rgb` (h, w, 3) uint8."""
    light = cv2.GaussianBlur(rgb, (0, 0), options.blur_px) if options.blur_px > 0 else rgb
    exposure = 2.0 ** rng.normal(0.0, options.exposure_sigma_ev)
    balance = 1.0 + np.array([1.0, 0.0, 1.0]) * rng.normal(0.0, options.white_balance_sigma, 3)
    gains = (exposure * balance).astype(np.float32)
    photo: NDArray[np.float32] = np.asarray(light, dtype=np.float32) * gains
    photo *= _vignette(rgb.shape[0], rgb.shape[1], options.vignetting)[..., None]
    variance = photo * np.float32(options.shot_noise**2 / 128.0) + np.float32(options.read_noise**2)
    photo += np.sqrt(variance) * rng.standard_normal(photo.shape, dtype=np.float32)
    return to_image(photo)


@lru_cache(maxsize=8)
def _vignette(height: int, width: int, loss: float) -> NDArray[np.float32]:
    """Gain (height, width), 1 in the centre, 1 - loss in the corner, falling with r^2."""
    y = (np.arange(height, dtype=np.float32) + 0.5 - 0.5 * height)[:, None]
    x = (np.arange(width, dtype=np.float32) + 0.5 - 0.5 * width)[None]
    r2 = (x * x + y * y) / (0.25 * (height**2 + width**2))
    return np.asarray(1.0 - loss * r2, dtype=np.float32)


def jpeg_bytes(photo: Image8, exif: Image.Exif | None = None, quality: int = 90) -> bytes:
    """The photo as JPEG, 4:2:0, with the EXIF block if given."""
    buffer = io.BytesIO()
    extra = {"exif": exif} if exif is not None else {}
    Image.fromarray(photo).save(buffer, format="JPEG", quality=quality, **extra)
    return buffer.getvalue()
