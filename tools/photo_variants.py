"""Photos made worse, and photos that no map can hold, for tools/acceptance_study.py."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from reloc.result import LocaliseRequest

Gray = NDArray[np.uint8]
# Name, pixels, what is asked with, whether the camera still stands where it stood.
Variant = tuple[str, Gray, LocaliseRequest, bool]

_BLUR_SHARES = (0.00125, 0.004)  # of the longer side: 2 and 6.4 pixels at 1600
_DARK_GAIN, _DARK_NOISE = 0.3, 2.0  # a photo at dusk, and the sensor's noise in it
_CROPS = (0.5, 0.25)
_SCALES = (0.5, 0.25)
_TURN_DEG = 40.0


def variants(gray: Gray, request: LocaliseRequest, *, degrade: bool) -> Iterator[Variant]:
    """The photo as it is and without a word about the lens; if `degrade`, worse ones and a mirrored one.

    The middle of the picture stays in the middle and the focal length is scaled along, so that the place of
    the camera and what is known of its lens stay as they were.
    """
    unknown = replace(request, camera=None, camera_key=None, exif_focal_px=None)
    yield "as it is", gray, request, True
    yield "unknown lens", gray, unknown, True
    if not degrade:
        return
    exif_only = replace(request, camera=None, camera_key=None)
    longer = max(gray.shape)
    for share in _BLUR_SHARES:
        yield f"blur {share:.3%}", np.asarray(cv2.GaussianBlur(gray, (0, 0), share * longer)), exif_only, True
    yield "dark", _dark(gray), exif_only, True
    for share in _CROPS:
        yield f"crop {share:.0%}", _crop(gray, share), exif_only, True
    for scale in _SCALES:
        small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        yield f"scale {scale:.0%}", np.asarray(small), _with_focal(exif_only, scale), True
    yield f"turn {_TURN_DEG:.0f}", _turned(gray, _TURN_DEG), exif_only, True
    yield "mirrored", np.ascontiguousarray(gray[:, ::-1]), exif_only, False


def _with_focal(request: LocaliseRequest, factor: float) -> LocaliseRequest:
    focal = request.exif_focal_px
    return request if focal is None else replace(request, exif_focal_px=factor * focal)


def _dark(gray: Gray) -> Gray:
    noise = np.random.default_rng(0).normal(0.0, _DARK_NOISE, gray.shape)
    return np.clip(np.rint(_DARK_GAIN * gray + noise), 0, 255).astype(np.uint8)


def _crop(gray: Gray, share: float) -> Gray:
    height, width = gray.shape
    top, left = round(0.5 * (1 - share) * height), round(0.5 * (1 - share) * width)
    return np.ascontiguousarray(gray[top : height - top, left : width - left])


def _turned(gray: Gray, angle_deg: float) -> Gray:
    height, width = gray.shape
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle_deg, 1.0)
    return np.asarray(cv2.warpAffine(gray, turn, (width, height)), dtype=np.uint8)
