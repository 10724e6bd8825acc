"""What people do to photos after they were taken: copies, crops, watermarks, borders, forgeries."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.simworld.town.texture import Image8

_TWO_FOCALS = ("OPENCV", "PINHOLE", "FULL_OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """One step of editing.

    Attributes:
        kind: what is done.
        amount: resized: factor on both sides. cropped: share of width and height that is cut off.
            bordered: width of the frame as a share of the picture's width. watermarked: opacity.
            pasted, moved, painted_over: share of the picture's area that is touched. warped: largest shift
            as a share of the width. mirrored: not used.
        text: of a watermark.
    """

    kind: str
    amount: float = 1.0
    text: str = ""

    def __post_init__(self) -> None:
        if self.kind not in _EDITORS:
            raise InvalidValueError(f"Edit.kind: expected one of {', '.join(_EDITORS)}, found {self.kind!r}")
        if not 0.0 < self.amount <= 4.0:
            raise InvalidValueError(f"Edit.amount: expected a number in (0, 4], found {self.amount}")


def edited(image: Image8, edits: tuple[Edit, ...], seed: int) -> Image8:
    """The picture (h, w, 3) after all edits, in their order; the same for the same seed."""
    for i, edit in enumerate(edits):
        image = _EDITORS[edit.kind](image, edit, np.random.default_rng((seed, 91, i)))
    return np.ascontiguousarray(image)


def edited_camera(camera: Camera, edits: tuple[Edit, ...], seed: int) -> Camera | None:
    """Intrinsics of the edited picture; None where no camera sees the world so (a mirror).

    Edits that only repaint pixels leave them as they are.
    """
    for i, edit in enumerate(edits):
        if edit.kind == "mirrored":
            return None
        if edit.kind == "resized":
            camera = camera.scaled_to(*_resized_size(camera.width, camera.height, edit.amount))
        elif edit.kind == "cropped":
            x0, y0, width, height = _crop(
                camera.width, camera.height, edit.amount, np.random.default_rng((seed, 91, i))
            )
            camera = _shifted(camera, -x0, -y0, width, height)
        elif edit.kind == "bordered":
            border = _border_px(camera.width, edit.amount)
            camera = _shifted(camera, border, border, camera.width + 2 * border, camera.height + 2 * border)
    return camera


def _resized_size(width: int, height: int, factor: float) -> tuple[int, int]:
    return max(16, round(width * factor)), max(16, round(height * factor))


def _shifted(camera: Camera, dx: float, dy: float, width: int, height: int) -> Camera:
    params = list(camera.params)
    first = 2 if camera.model in _TWO_FOCALS else 1
    params[first] += dx
    params[first + 1] += dy
    return replace(camera, width=width, height=height, params=tuple(params))


def _crop(width: int, height: int, share: float, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """x0, y0, width, height of what is kept; people cut more from one side than from the other."""
    new_w, new_h = round(width * (1 - share)), round(height * (1 - share))
    return int(rng.integers(0, width - new_w + 1)), int(rng.integers(0, height - new_h + 1)), new_w, new_h


def _border_px(width: int, share: float) -> int:
    return max(1, round(width * share))


def _resized(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    size = _resized_size(image.shape[1], image.shape[0], edit.amount)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _cropped(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    x0, y0, w, h = _crop(image.shape[1], image.shape[0], edit.amount, rng)
    return image[y0 : y0 + h, x0 : x0 + w]


def _bordered(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    b = _border_px(image.shape[1], edit.amount)
    grey = int(rng.choice([0, 20, 245, 255]))
    return np.asarray(
        cv2.copyMakeBorder(image, b, b, b, b, cv2.BORDER_CONSTANT, value=(grey,) * 3), dtype=np.uint8
    )


def _watermarked(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """A name across the lower right corner and a large pale one across the middle."""
    h, w = image.shape[:2]
    layer = image.copy()
    text, scale = edit.text or "(c) photo", w / 900.0
    for (x, y), font, size, grey, thick in (
        ((0.60, 0.95), cv2.FONT_HERSHEY_DUPLEX, scale, 255, 2),
        ((0.12, 0.55), cv2.FONT_HERSHEY_TRIPLEX, 2.2 * scale, 235, 5),
    ):
        at, width = (int(x * w), int(y * h)), max(1, round(thick * scale))
        cv2.putText(layer, text, at, font, size, (grey,) * 3, width, cv2.LINE_AA)
    return np.asarray(cv2.addWeighted(layer, edit.amount, image, 1.0 - edit.amount, 0.0), dtype=np.uint8)


def _mirrored(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    return image[:, ::-1]


def _patch(image: Image8, share: float, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """A rectangle x0, y0, x1, y1 of about that share of the area."""
    h, w = image.shape[:2]
    aspect = float(rng.uniform(0.7, 1.4))
    side = np.sqrt(share * h * w)
    pw, ph = min(round(side * aspect), w - 2), min(round(side / aspect), h - 2)
    x0, y0 = int(rng.integers(0, w - pw)), int(rng.integers(0, max(1, h - ph)))
    return x0, y0, x0 + pw, y0 + ph


def _pasted(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """Pieces of the picture stamped over other places, at another size, as with a cloning brush."""
    result = image.copy()
    for _ in range(3):
        x0, y0, x1, y1 = _patch(image, edit.amount / 3, rng)
        factor = float(rng.uniform(0.8, 1.25))
        piece = cv2.resize(image[y0:y1, x0:x1], None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        h, w = min(piece.shape[0], image.shape[0] - 1), min(piece.shape[1], image.shape[1] - 1)
        ty, tx = int(rng.integers(0, image.shape[0] - h)), int(rng.integers(0, image.shape[1] - w))
        result[ty : ty + h, tx : tx + w] = piece[:h, :w]
    return result


def _moved(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """One large piece shifted by a few per cent of the width, the gap filled from what lies around it."""
    x0, y0, x1, y1 = _patch(image, edit.amount, rng)
    h, w = image.shape[:2]
    shift = rng.choice([-1, 1], 2) * rng.uniform(0.03, 0.09, 2) * w
    dx = int(np.clip(shift[0], -x0, w - x1))
    dy = int(np.clip(0.5 * shift[1], -y0, h - y1))
    result = cv2.GaussianBlur(image, (0, 0), 0.02 * w)
    keep = np.ones((h, w), dtype=bool)
    keep[y0:y1, x0:x1] = False
    result[keep] = image[keep]
    result[y0 + dy : y1 + dy, x0 + dx : x1 + dx] = image[y0:y1, x0:x1]
    return np.asarray(result, dtype=np.uint8)


def _painted_over(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """Blobs of grass or wall colour over things that somebody does not want to be seen."""
    result = image.copy()
    for _ in range(4):
        x0, y0, x1, y1 = _patch(image, edit.amount / 4, rng)
        colour = tuple(int(c) for c in rng.choice([(96, 112, 64), (150, 146, 140), (190, 180, 160)]))
        mask = np.zeros(image.shape[:2], np.uint8)
        centre = ((x0 + x1) // 2, (y0 + y1) // 2)
        cv2.ellipse(mask, centre, ((x1 - x0) // 2 + 1, (y1 - y0) // 2 + 1), 0.0, 0.0, 360.0, 255, -1)
        soft = cv2.GaussianBlur(mask, (0, 0), 4.0)[..., None].astype(np.float32) / 255.0
        grain = rng.normal(0.0, 4.0, image.shape).astype(np.float32)
        result = np.clip(result * (1 - soft) + (np.array(colour, np.float32) + grain) * soft, 0, 255).astype(
            np.uint8
        )
    return result


def _warped(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """A smooth displacement that no lens has."""
    h, w = image.shape[:2]
    field = rng.uniform(-1, 1, (2, 5, 6)).astype(np.float32) * np.float32(edit.amount * w)
    dx, dy = (cv2.resize(f, (w, h), interpolation=cv2.INTER_CUBIC) for f in field)
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    return np.asarray(
        cv2.remap(image, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101), dtype=np.uint8
    )


_EDITORS: dict[str, Callable[[Image8, Edit, np.random.Generator], Image8]] = {
    "resized": _resized,
    "cropped": _cropped,
    "bordered": _bordered,
    "watermarked": _watermarked,
    "mirrored": _mirrored,
    "pasted": _pasted,
    "moved": _moved,
    "painted_over": _painted_over,
    "warped": _warped,
}
