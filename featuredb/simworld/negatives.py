"""Pictures that no map of the town may claim."""

from typing import Literal, get_args

import cv2
import numpy as np

from featuredb.simworld.town.texture import Image8, fractal, to_image

NegativeKind = Literal["other_town", "blank", "noise", "text", "mirrored", "blurred"]
NEGATIVE_KINDS: tuple[NegativeKind, ...] = get_args(NegativeKind)

_WORDS = (
    "bridge", "river", "market", "street", "house", "stone", "window", "garden", "tower", "signal",
    "north", "east", "height", "record", "camera", "survey", "harbour", "station", "letter",
    "number", "morning", "evening", "window", "yellow", "copper",
)  # fmt: skip
_BLUR_SHARE = 0.035  # of the width: nothing smaller than a house front survives


def blank(rng: np.random.Generator, width: int, height: int) -> Image8:
    """One colour, a slow gradient, a little sensor noise."""
    ends = rng.uniform(20, 235, (2, 3)).astype(np.float32)
    ramp = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = np.broadcast_to(ends[0] + 0.15 * (ends[1] - ends[0]) * ramp, (height, width, 3))
    return to_image(image + rng.normal(0, 1.5, (height, width, 3)).astype(np.float32))


def noise(rng: np.random.Generator, width: int, height: int) -> Image8:
    """White to 1/f noise, grey or coloured."""
    gain = float(rng.uniform(1.0, 2.0))
    fields = [fractal(height, width, rng, octaves=int(rng.integers(1, 8)), gain=gain) for _ in range(3)]
    if rng.random() < 0.5:
        fields = [fields[0]] * 3
    return to_image(128 + 40 * np.stack(fields, axis=-1))


def text(rng: np.random.Generator, width: int, height: int) -> Image8:
    """A photographed page: lines of words, a little turned."""
    page = np.full((height, width, 3), 242, np.uint8)
    scale = float(rng.uniform(0.5, 1.3)) * width / 1200
    line = int(34 * scale)
    for y in range(line, height - line // 2, max(line, 8)):
        words = " ".join(str(w) for w in rng.choice(_WORDS, 40))
        cv2.putText(
            page,
            words,
            (int(0.05 * width), y),
            cv2.FONT_HERSHEY_COMPLEX,
            scale,
            (20, 20, 28),
            max(1, int(2 * scale)),
            cv2.LINE_AA,
        )
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), float(rng.normal(0, 5)), 1.0)
    turned = cv2.warpAffine(page, turn, (width, height), borderValue=(120, 100, 80))
    return to_image(turned + rng.normal(0, 2.0, page.shape).astype(np.float32))


def mirrored(photo: Image8) -> Image8:
    """The photo seen in a mirror: every texture is there, no camera in the town can see it so."""
    return np.ascontiguousarray(photo[:, ::-1])


def blurred(photo: Image8, rng: np.random.Generator) -> Image8:
    """The photo so far out of focus that it cannot be placed."""
    sigma = _BLUR_SHARE * photo.shape[1]
    soft = np.asarray(cv2.GaussianBlur(photo, (0, 0), sigma), dtype=np.float32)
    return to_image(soft + rng.normal(0, 2.0, photo.shape).astype(np.float32))
