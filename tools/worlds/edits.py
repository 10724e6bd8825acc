"""Pictures that are not of the town as it is: copies, crops, watermarks, borders, forgeries; rooms, faces."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import Device, SensorOptions, expose, look_pose, scene_look
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.blocks import box, face
from featuredb.simworld.town.scene import Ellipsoids, Faces, Scene
from featuredb.simworld.town.texture import Image8

_SKIN = (1.9, 1.25, 1.9)  # factors on the leaf texture's green


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
        elif edit.kind in ("cropped", "bordered"):
            x0, y0, w, h = _window(camera.width, camera.height, edit, np.random.default_rng((seed, 91, i)))
            first = 2 if camera.model == "OPENCV" else 1  # people's others have one focal length
            cx, cy = camera.params[first : first + 2]
            params = (*camera.params[:first], cx - x0, cy - y0, *camera.params[first + 2 :])
            camera = replace(camera, width=w, height=h, params=params)
    return camera


def _resized_size(width: int, height: int, factor: float) -> tuple[int, int]:
    return max(16, round(width * factor)), max(16, round(height * factor))


def _window(width: int, height: int, edit: Edit, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """x0, y0, width, height of a cropped or bordered picture; sides are cut unevenly."""
    if edit.kind == "bordered":
        border = max(1, round(width * edit.amount))
        return -border, -border, width + 2 * border, height + 2 * border
    w, h = round(width * (1 - edit.amount)), round(height * (1 - edit.amount))
    return int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1)), w, h


def _resized(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    size = _resized_size(image.shape[1], image.shape[0], edit.amount)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _cropped(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    x0, y0, w, h = _window(image.shape[1], image.shape[0], edit, rng)
    return image[y0 : y0 + h, x0 : x0 + w]


def _bordered(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    b = -_window(image.shape[1], image.shape[0], edit, rng)[0]
    grey = int(rng.choice([0, 20, 245, 255]))
    return np.pad(image, ((b, b), (b, b), (0, 0)), constant_values=grey)


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
        colour = rng.choice([(96, 112, 64), (150, 146, 140), (190, 180, 160)])
        mask = np.zeros(image.shape[:2], np.uint8)
        centre = ((x0 + x1) // 2, (y0 + y1) // 2)
        cv2.ellipse(mask, centre, ((x1 - x0) // 2 + 1, (y1 - y0) // 2 + 1), 0.0, 0.0, 360.0, 255, -1)
        soft = cv2.GaussianBlur(mask, (0, 0), 4.0)[..., None].astype(np.float32) / 255.0
        grain = rng.normal(0.0, 4.0, image.shape).astype(np.float32)
        painted = result * (1 - soft) + (colour.astype(np.float32) + grain) * soft
        result = np.clip(painted, 0, 255).astype(np.uint8)
    return result


def _warped(image: Image8, edit: Edit, rng: np.random.Generator) -> Image8:
    """A smooth displacement that no lens has."""
    h, w = image.shape[:2]
    field = rng.uniform(-1, 1, (2, 5, 6)).astype(np.float32) * np.float32(edit.amount * w)
    dx, dy = (cv2.resize(f, (w, h), interpolation=cv2.INTER_CUBIC) for f in field)
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    warped = cv2.remap(image, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(warped, dtype=np.uint8)


_EDITORS: dict[str, Callable[[Image8, Edit, np.random.Generator], Image8]] = {
    "resized": _resized,
    "cropped": _cropped,
    "bordered": _bordered,
    "watermarked": _watermarked,
    "mirrored": lambda image, edit, rng: image[:, ::-1],
    "pasted": _pasted,
    "moved": _moved,
    "painted_over": _painted_over,
    "warped": _warped,
}


def indoor_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A room (h, w, 3) uint8 that nobody else has; `scene` lends its textures only."""
    rng = np.random.default_rng((seed, 95))
    size = rng.uniform(4.0, 7.0, 2)
    faces = _room(rng, size)
    plants = rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (3, 3)) * [*size, 1.0]
    centre = np.array([*(rng.uniform(-0.25, 0.25, 2) * size), rng.uniform(1.4, 1.7)])
    pose = look_pose(centre, float(rng.uniform(0, 360)), float(rng.normal(-8, 6)), float(rng.normal(0, 2)))
    radii, tints = 0.25 * rng.uniform(0.7, 1.3, (3, 3)), rng.uniform(0.8, 1.2, (3, 3))
    return expose(_drawn(scene, faces, _balls(plants, radii, tints, rng), device, pose)[0], rng, sensor)


def portrait_photo(scene: Scene, device: Device, seed: int, sensor: SensorOptions) -> Image8:
    """A person who fills the frame, in a room out of focus."""
    rng = np.random.default_rng((seed, 96))
    size = rng.uniform(4.0, 7.0, 2)
    pose = look_pose((0.0, -0.3 * size[1], 1.55), float(rng.normal(0, 8)), float(rng.normal(-3, 2)))
    nothing = np.zeros((0, 3))
    wall, _ = _drawn(scene, _room(rng, size), _balls(nothing, nothing, nothing, rng), device, pose)
    wall = np.asarray(cv2.GaussianBlur(wall, (0, 0), 0.012 * device.camera.width), dtype=np.uint8)
    ahead = pose.inverse().rotation[:, 2]
    at = pose.center + ahead * float(rng.uniform(0.9, 1.4)) + rng.normal(0, [0.12, 0.0, 0.0])
    body = at + np.array([[0, 0, 0.02], [0, 0, -0.45], [0, 0.03, 0.10]])
    radii = np.array([[0.105, 0.12, 0.145], [0.26, 0.16, 0.36], [0.115, 0.125, 0.11]])
    tints = np.array([_SKIN, rng.uniform(0.2, 2.2, 3), rng.uniform(0.3, 1.2, 3)])
    person, depth = _drawn(scene, Faces.concatenate([]), _balls(body, radii, tints, rng), device, pose)
    skin = cv2.GaussianBlur(person, (0, 0), 2.0)
    return expose(np.where(np.isfinite(depth)[..., None], skin, wall).astype(np.uint8), rng, sensor)


def _drawn(
    scene: Scene, faces: Faces, balls: Ellipsoids, device: Device, pose: Rigid3
) -> tuple[Image8, NDArray[np.float32]]:
    """Picture and depth."""
    rendered = render(faces, balls, device.camera, pose, look=scene_look(scene), supersample=2)
    assert rendered.rgb is not None
    return rendered.rgb, rendered.depth


def _balls(centers: FloatArray, radii: FloatArray, tints: FloatArray, rng: np.random.Generator) -> Ellipsoids:
    """Ellipsoids; arrays are (n, 3)."""
    return Ellipsoids(
        center=centers,
        radii=radii,
        tint=tints,
        texture_uv=rng.uniform(0, 500, (len(centers), 2)),
        object_id=np.arange(1, 1 + len(centers), dtype=np.int32),
    )


def _room(rng: np.random.Generator, size: FloatArray) -> Faces:
    """Walls, floor, ceiling, pictures, furniture; the floor's middle at the origin."""

    def start() -> tuple[float, float]:
        return float(rng.uniform(0, 500)), float(rng.uniform(0, 500))

    def tint(low: float, high: float) -> tuple[float, float, float]:
        red, green, blue = rng.uniform(low, high, 3)
        return float(red), float(green), float(blue)

    x, y, z = 0.5 * size[0], 0.5 * size[1], float(rng.uniform(2.4, 3.0))
    wall = tint(0.75, 1.2)
    corners = np.array([[-x, -y, 0], [-x, y, 0], [x, y, 0], [x, -y, 0]])
    floor = face(corners[0], corners[3] - corners[0], corners[1] - corners[0], "wood", 1, detail=start())
    ceiling = face((-x, -y, z), (0, 2 * y, 0), (2 * x, 0, 0), "plain", 2, tint=(1.15,) * 3)
    parts = [floor, ceiling]
    for i in range(4):
        corner, edge = corners[i], corners[(i + 1) % 4] - corners[i]
        parts.append(face(corner, edge, (0, 0, z), "plain", 3 + i, detail=start(), tint=wall))
        length = float(np.linalg.norm(edge))
        inward = np.cross(edge, [0, 0, 1]) / length
        for _ in range(int(rng.integers(1, 4))):  # pictures on the wall
            w, h = rng.uniform(0.3, 1.0, 2)
            along = rng.uniform(0.1, 0.9 - w / length) * edge
            origin = corner + along + inward * 0.02 + [0, 0, rng.uniform(1.0, z - h - 0.1)]
            texture = str(rng.choice(["leaves", "fields", "wood", "car"]))
            unit, colour = edge / length, tint(0.3, 1.3)
            parts.append(face(origin, w * unit, (0, 0, h), texture, 20, detail=start(), tint=colour))
    for i in range(int(rng.integers(4, 9))):
        w, d, h = (float(v) for v in rng.uniform([0.4, 0.4, 0.4], [1.8, 1.0, 1.9]))
        at = rng.uniform(-0.45, 0.45, 2) * size
        at *= max(1.5 / max(float(np.linalg.norm(at)), 0.3), 1.0)
        texture, yaw_deg = str(rng.choice(["wood", "plain"])), float(rng.choice([0, 90]))
        look: dict[str, Any] = {"texture": texture, "detail": start(), "tint": tint(0.4, 1.2)}
        parts.append(box(float(at[0]), float(at[1]), 0.0, (w, d, h), 30 + i, yaw_deg=yaw_deg, **look))
    return Faces.concatenate(parts)
