"""Features of a photo as if seen more from the side: simulated tilts (ASIFT, Morel and Yu 2009).

A surface seen obliquely is, up to scale, the surface seen from the front, turned and squeezed in one
direction. SIFT follows turns and scales but no squeezing. Here the photo itself is turned, squeezed and
described several times over. The descriptors are those of `extract`, so maps made without tilts take such
queries: only one side needs the tilts, since a ratio test asks whether a *map point* is unique.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions, extract
from featuredb.features.features import Features


@dataclass(frozen=True, slots=True, kw_only=True)
class TiltOptions:
    """Which tilts are simulated.

    Attributes:
        tilts: squeezing factors beside 1, ascending; root 2, 2 and 2 root 2 stand for 45, 60 and 69 degrees
            between the view and a flat surface's normal.
        turn_step_deg: step of the squeezed direction at a tilt of 1, smaller for stronger tilts in proportion
            (Morel and Yu: 72).
        features_per_tilt: of each simulated photo, at most.
    """

    tilts: tuple[float, ...] = (2.0**0.5, 2.0, 2.0**1.5)
    turn_step_deg: float = 72.0
    features_per_tilt: int = 1500

    def __post_init__(self) -> None:
        if any(tilt <= 1.0 for tilt in self.tilts):
            raise InvalidValueError(f"TiltOptions.tilts: expected factors above 1, found {self.tilts}")
        if not (0 < self.turn_step_deg <= 180 and self.features_per_tilt >= 1):
            raise InvalidValueError(f"TiltOptions: value out of range in {self}")


def extract_tilted(
    gray: NDArray[np.uint8], options: ExtractorOptions | None = None, tilts: TiltOptions | None = None
) -> Features:
    """Features of the photo, then those of its simulated tilts, all in the photo's own pixels.

    Args:
        gray: (h, w) uint8, pixels as stored in the file.

    Raises:
        ImageError: as `extract`.
    """
    options, tilts = options or ExtractorOptions(), tilts or TiltOptions()
    own = extract(gray, options)
    h, w = gray.shape
    factor = min(1.0, options.max_side_px / max(h, w))
    size = (max(1, round(w * factor)), max(1, round(h * factor)))
    small = gray if factor == 1.0 else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    ratio = np.array([w / size[0], h / size[1]])
    found = [own]
    for tilt in tilts.tilts:
        for turn in np.arange(0.0, 180.0 - 1e-6, tilts.turn_step_deg / tilt):
            warped, photo_from_warped = tilted(np.asarray(small, dtype=np.uint8), tilt, float(turn))
            if min(warped.shape) < 32:
                continue
            features = extract(
                warped, replace(options, max_side_px=32_000, max_features=tilts.features_per_tilt)
            )
            found.append(_back(features, photo_from_warped, ratio, w, h))
    return _concatenated(found)


def tilted(
    gray: NDArray[np.uint8], tilt: float, turn_deg: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """The photo turned by an angle and squeezed across by a factor, smoothed for it.

    Returns:
        The picture, and (2, 3) the affine map from its pixels to the photo's; first pixel centre at 0.5.
    """
    h, w = gray.shape
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[c, -s], [s, c]])
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]], dtype=np.float64) @ turn.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    wide, high_px = (int(np.ceil(v)) for v in high - low)
    # Without smoothing across, what is finer than the new pixels turns into false features.
    forward = np.column_stack([turn, -low])
    turned = _warp(gray, forward, (wide, high_px))
    sigma = 0.8 * np.sqrt(tilt**2 - 1.0)
    smooth = cv2.GaussianBlur(turned, (0, 0), sigmaX=sigma, sigmaY=1e-3) if tilt > 1 else turned
    squeeze = np.diag([1.0 / tilt, 1.0])
    narrow = max(1, int(np.ceil(wide / tilt)))
    warped = _warp(
        np.asarray(smooth, dtype=np.uint8), np.column_stack([squeeze, np.zeros(2)]), (narrow, high_px)
    )
    back = turn.T @ np.diag([tilt, 1.0])
    return warped, np.column_stack([back, turn.T @ low])


def _warp(gray: NDArray[np.uint8], forward: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Affine warp; OpenCV counts pixel centres from 0, we from 0.5."""
    half = np.array([0.5, 0.5])
    shift = forward[:, :2] @ half + forward[:, 2] - half
    matrix = np.column_stack([forward[:, :2], shift])
    return np.asarray(
        cv2.warpAffine(gray, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
        dtype=np.uint8,
    )


def _back(
    features: Features, photo_from_warped: NDArray[np.float64], ratio: NDArray[np.float64], w: int, h: int
) -> Features:
    """Keypoints in the photo's full-size pixels; those of the border that was filled in are left out."""
    xy = (features.xy @ photo_from_warped[:, :2].T + photo_from_warped[:, 2]) * ratio
    spread = np.sqrt(abs(np.linalg.det(photo_from_warped[:, :2]))) * ratio.mean()
    radius = 3.0 * features.scale * spread  # a descriptor reaches some three diameters far
    inside = (np.minimum(xy, [w, h] - xy) > np.minimum(radius, 0.1 * min(w, h))[:, None]).all(axis=1)
    direction = np.radians(features.angle.astype(np.float64))
    turned = np.stack([np.cos(direction), np.sin(direction)], axis=1) @ photo_from_warped[:, :2].T
    return Features(
        xy=xy[inside].astype(np.float32),
        scale=(features.scale * spread)[inside].astype(np.float32),
        angle=(np.degrees(np.arctan2(turned[:, 1], turned[:, 0])) % 360.0)[inside].astype(np.float32)
        % np.float32(360.0),
        response=features.response[inside],
        descriptors=features.descriptors[inside],
        width=w,
        height=h,
        fingerprint=features.fingerprint,
    )


def _concatenated(parts: list[Features]) -> Features:
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("xy", "scale", "angle", "response", "descriptors")
    }
    first = parts[0]
    return Features(width=first.width, height=first.height, fingerprint=first.fingerprint, **arrays)
