"""Paints the town's ground as seen from above, one large image without repetition: in light, and in infrared.

In a laser's near infrared plants are bright, asphalt, slate and bitumen dark, water is black; there are no
shadows.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.scene import REFLECTANCE, Building, GroundPlan, Scene, texture_index
from featuredb.simworld.town.texture import Texture, fractal, periodic

# Label: colour, and reflectance at 1064 nm; each with the strength of its 1/f noise and of its fine noise.
# In the infrared grass outshines stone, and asphalt is dark.
_KINDS = {
    "grass": ((98, 116, 62, 0.18, 0.10), (0.46, 0.14, 0.10)),
    "asphalt": ((98, 98, 100, 0.06, 0.055), (0.11, 0.10, 0.05)),
    "pavement": ((156, 150, 142, 0.07, 0.05), (0.27, 0.06, 0.05)),
    "gravel": ((164, 152, 132, 0.10, 0.20), (0.30, 0.08, 0.12)),
    "soil": ((116, 92, 66, 0.22, 0.16), (0.24, 0.18, 0.12)),
    "cobbles": ((134, 122, 112, 0.10, 0.10), (0.20, 0.08, 0.08)),
    "bank": ((124, 116, 96, 0.20, 0.22), (0.34, 0.20, 0.14)),
}
_LABEL = {name: i for i, name in enumerate(_KINDS)}
SIDEWALK_M = 2.2
_SHADOW = 0.5  # light left in the shade
_PAINT_GAMMA = 1.5  # what is painted over a material differs from it in the infrared more than in light


class _Painter:
    """The canvas with its coordinates: x to the columns, y (north in town axes) to the rows, metres."""

    def __init__(self, plan: GroundPlan, texel_m: float) -> None:
        self.plan, self.texel = plan, texel_m
        self.shape = tuple(round(s / texel_m) for s in reversed(plan.size))
        self.labels: NDArray[np.uint8] = np.zeros(self.shape, np.uint8)
        self.rng = np.random.default_rng((plan.seed, 31))

    def pixels(self, points: FloatArray) -> NDArray[np.int32]:
        """Fixed-point (4 fractional bits) pixels of points (n, 2) in metres, for cv2."""
        centred = (np.asarray(points) + 0.5 * np.array(self.plan.size)) / self.texel - 0.5
        return np.round(centred * 16).astype(np.int32)

    def polygon(
        self, image: NDArray[np.uint8], points: FloatArray, value: int | tuple[int, int, int]
    ) -> None:
        colour = value if isinstance(value, tuple) else (value,)
        line = cv2.LINE_AA if isinstance(value, tuple) else cv2.LINE_8
        cv2.fillPoly(image, [self.pixels(points)], colour, line, 4)

    def rectangle(
        self,
        image: NDArray[np.uint8],
        box: tuple[float, float, float, float],
        value: int | tuple[int, int, int],
    ) -> None:
        x0, y0, x1, y1 = box
        self.polygon(image, np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), value)


def paint_ground(plan: GroundPlan, texel_m: float) -> Texture:
    """The ground's texture; texel (0, 0) is at the town's (-width / 2, -height / 2)."""
    painter = _Painter(plan, texel_m)
    _paint_labels(painter)
    image = _colours(painter)
    _paint_marks(painter, image)
    _scatter(painter, image)
    return Texture.from_image(_with_shadows(painter, image), texel_m)


def paint_infrared(plan: GroundPlan, texel_m: float) -> NDArray[np.float32]:
    """Reflectance (h, w) float32 of the ground in the near infrared, texel for texel that of `paint_ground`.

    The same materials, markings, cracks and litter lie at the same places; noise is its own, and there are no
    shadows.
    """
    painter = _Painter(plan, texel_m)
    _paint_labels(painter)
    _colours(painter)  # for its random numbers, which come before those of the markings
    greys, levels = np.zeros(256, np.uint8), np.zeros((3, 256), np.float32)
    for label, (colour, infrared) in enumerate(_KINDS.values()):
        greys[label] = round(sum(colour[:3]) / 3)
        levels[:, label] = infrared
    before = cv2.LUT(painter.labels, greys)
    image = cv2.merge([before] * 3)
    _paint_marks(painter, image)
    _scatter(painter, image)
    factors = (np.arange(256, dtype=np.float32)[None] / np.maximum(greys[:, None], 1)) ** _PAINT_GAMMA
    rng = np.random.default_rng((plan.seed, 32))
    h, w = painter.shape
    coarse, fine = fractal(h, w, rng, octaves=8, gain=1.4), rng.standard_normal((h, w), dtype=np.float32)
    result = np.empty((h, w), np.float32)
    for r in range(0, h, 256):  # in bands, for memory's sake
        rows = slice(r, min(r + 256, h))
        labels = painter.labels[rows]
        base, low, high = (cv2.LUT(labels, table) for table in levels)
        result[rows] = (
            base * (1.0 + low * coarse[rows] + high * fine[rows]) * factors[labels, image[rows, :, 1]]
        )
    return np.clip(result, 0.01, 0.95)


def _paint_labels(p: _Painter) -> None:
    plan = p.plan
    for garden in plan.gardens:
        p.rectangle(p.labels, garden, _LABEL["soil"])
    y0, y1 = plan.river
    p.rectangle(p.labels, (-plan.size[0], y0 - 1.5, plan.size[0], y1 + 1.5), _LABEL["bank"])
    for extra, kind in ((SIDEWALK_M, "pavement"), (0.0, "asphalt")):
        for s in plan.streets:
            half = 0.5 * s.width + extra
            box = (s.start, s.at - half, s.end, s.at + half)
            p.rectangle(p.labels, box if s.along == "x" else (box[1], box[0], box[3], box[2]), _LABEL[kind])
    for box in plan.plazas:
        p.rectangle(p.labels, box, _LABEL["cobbles"])
    for box in plan.car_parks:
        p.rectangle(p.labels, box, _LABEL["asphalt"])
    for i, b in enumerate(plan.buildings):  # a strip of paving or gravel around each house
        c = b.footprint()
        kind = ("gravel", "pavement", "soil")[i % 3]
        p.polygon(
            p.labels,
            c + (c - c.mean(0)) * (1.2 / np.linalg.norm(c - c.mean(0), axis=1))[:, None],
            _LABEL[kind],
        )


def _colours(p: _Painter) -> NDArray[np.uint8]:
    """Base colour of each label times (1 + noise)."""
    h, w = p.shape
    tables = np.zeros((5, 256), np.float32)  # red, green, blue, coarse, fine of each label
    for label, (colour, _) in enumerate(_KINDS.values()):
        tables[:, label] = colour
    low, high = fractal(h, w, p.rng, octaves=8, gain=1.35), p.rng.standard_normal((h, w), dtype=np.float32)
    hue = cv2.resize(fractal(h // 8 + 1, w // 8 + 1, p.rng, octaves=6, gain=1.8), (w, h))
    image = np.empty((h, w, 3), np.uint8)
    for r in range(0, h, 256):  # in bands, for memory's sake
        rows = slice(r, min(r + 256, h))
        red, green, blue, coarse, fine = (cv2.LUT(p.labels[rows], table) for table in tables)
        level = 1.0 + coarse * low[rows] + fine * high[rows]
        cast = coarse * hue[rows]
        for channel, (base, shift) in enumerate(((red, 34.0), (green, 0.0), (blue, -14.0))):
            image[rows, :, channel] = cv2.convertScaleAbs(
                np.maximum(base * level + np.float32(shift) * cast, 0)
            )
    return image


def _paint_marks(p: _Painter, image: NDArray[np.uint8]) -> None:
    """Road markings, paving joints, cracks, patches, manholes, parking bays."""
    white = (206, 204, 196)
    for s in p.plan.streets:

        def strip(a: float, b: float, c0: float, c1: float, s=s) -> tuple[float, float, float, float]:  # type: ignore[no-untyped-def]
            low, high = s.at + c0, s.at + c1
            return (a, low, b, high) if s.along == "x" else (low, a, high, b)

        half = 0.5 * s.width
        for a in np.arange(s.start, s.end, 6.0):
            p.rectangle(image, strip(a, a + 3.0, -0.07, 0.07), white)
        for a in np.arange(s.start, s.end, 0.9):  # paving joints
            for side in (-1, 1):
                c = side * (half + 0.5 * SIDEWALK_M)
                p.rectangle(image, strip(a, a + 0.06, c - 1.05, c + 1.05), (124, 118, 110))
        for side in (-1, 1):  # kerbs
            c = side * half
            p.rectangle(image, strip(s.start, s.end, c - 0.1, c + 0.1), (184, 180, 172))
        for _ in range(int((s.end - s.start) / 5)):
            a, c = p.rng.uniform(s.start, s.end), p.rng.uniform(-half, half - 1)
            length, grey = p.rng.uniform(0.5, 5), int(p.rng.integers(62, 128))
            p.rectangle(image, strip(a, a + length, c, c + p.rng.uniform(0.3, 1.4)), (grey, grey, grey))
        for a in np.arange(s.start + 14, s.end, 37.0):  # crossings
            for c in np.arange(-half + 0.5, half - 0.4, 1.0):
                p.rectangle(image, strip(a, a + 3.0, c, c + 0.5), white)
    for x0, y0, x1, y1 in p.plan.car_parks:
        for x in np.arange(x0 + 1, x1 - 1, 2.5):
            for y in np.arange(y0 + 5, y1 - 0.1, 11.0):
                p.rectangle(image, (x, y - 5, x + 0.12, min(y + 5, y1)), white)
    _paint_cracks(p, image)


def _paint_cracks(p: _Painter, image: NDArray[np.uint8]) -> None:
    size = np.array(p.plan.size)
    for _ in range(int(size.prod() / 60)):
        start = p.rng.uniform(-0.5, 0.5, 2) * size
        walk = np.cumsum(p.rng.normal(0, 0.45, (int(p.rng.integers(3, 9)), 2)), axis=0) + start
        grey = int(p.rng.integers(48, 90))
        cv2.polylines(image, [p.pixels(walk)], False, (grey, grey, grey), 1, cv2.LINE_AA, 4)


def _scatter(p: _Painter, image: NDArray[np.uint8]) -> None:
    """Stones, leaves, manholes, molehills, litter: small things, one and a half per square metre or so."""
    size = np.array(p.plan.size)
    n = int(size.prod() * 0.4)
    centres = p.pixels(p.rng.uniform(-0.5, 0.5, (n, 2)) * size)
    radii = np.maximum(p.rng.lognormal(np.log(0.07), 0.55, n) / p.texel, 0.8)
    greys = p.rng.normal(112, 32, n).clip(40, 215)
    casts = p.rng.normal(1.0, 0.05, (n, 3)).clip(0.85, 1.1) * [1.03, 1.0, 0.93]
    for centre, radius, grey, cast in zip(centres.tolist(), radii, greys, casts, strict=True):
        colour = tuple(float(min(c, 255.0)) for c in grey * cast)
        cv2.circle(image, centre, int(16 * min(radius, 9.0)), colour, -1, cv2.LINE_AA, 4)


def _with_shadows(p: _Painter, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Darken what the sun does not reach, buildings and trees taken as prisms and balls."""
    lit = np.full(p.shape, 255, np.uint8)
    east, north, up = p.plan.to_sun
    per_metre = -np.array([east, north]) / up
    for b in p.plan.buildings:
        p.polygon(lit, _shadow_outline(b, per_metre, float(p.plan.height(b.y))), 0)
    for x, y, radius in p.plan.trees:
        shift = per_metre * (1.6 * radius)
        centre = p.pixels(np.array([[x + shift[0], y + shift[1]]]))[0]
        cv2.circle(lit, centre.tolist(), int(16 * radius / p.texel), (0,), -1, cv2.LINE_8, 4)
    soft = cv2.GaussianBlur(lit, (0, 0), 0.12 / p.texel)
    light = np.asarray(cv2.convertScaleAbs(soft, alpha=1.0 - _SHADOW, beta=255.0 * _SHADOW))
    return np.asarray(cv2.multiply(image, cv2.merge([light] * 3), scale=1.0 / 255.0), dtype=np.uint8)


def _shadow_outline(b: Building, per_metre: FloatArray, ground: float) -> FloatArray:
    corners = b.footprint()
    eaves = corners + per_metre * max(b.eaves - ground, 0.0)
    points = [corners, eaves]
    if b.ridge > 0:
        ends = 0.5 * (corners[[0, 1]] + corners[[3, 2]])
        points.append(ends + per_metre * max(b.eaves + b.ridge - ground, 0.0))
    hull = cv2.convexHull(np.concatenate(points).astype(np.float32))
    return np.asarray(hull[:, 0], dtype=np.float64)


_PATCHES = 0.10  # relative strength of weathering, patches of decimetres to metres
_PATCH_TEXEL_M = 0.12
_OBJECT_SPREAD = 0.13  # two roofs of one material differ by about as much
_CAR_SPREAD = 0.55  # paints differ most, and not as their colours do


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reflectance:
    """Reflectance of a scene in the near infrared.

    Attributes:
        ground: (h, w) float32 of the painted rectangle, rows to the north in town axes.
        patches: (p, p) float32 periodic factors.
    """

    ground: NDArray[np.float32]
    ground_texel_m: float
    patches: NDArray[np.float32]

    def at(
        self, scene: Scene, xyz: FloatArray, texture: NDArray[np.integer], object_id: NDArray[np.integer]
    ) -> FloatArray:
        """Reflectance (n,) at points (n, 3) of the local frame on faces of these textures and objects."""
        value = np.array(list(REFLECTANCE.values()))[texture]
        town = xyz @ scene.enu_from_town
        painted = texture == texture_index("ground")
        size = np.asarray(scene.plan.size)
        cell = np.floor((town[painted, :2] + 0.5 * size) / self.ground_texel_m).astype(np.int64)
        column, row = (cell[:, k].clip(0, self.ground.shape[1 - k] - 1) for k in (0, 1))
        value[painted] = self.ground[row, column]
        # Each object has its own age and make, by its number.
        of_object = np.random.default_rng((scene.seed, 91)).standard_normal(65_536)[object_id % 65_536]
        spread = np.where(texture == texture_index("car"), _CAR_SPREAD, _OBJECT_SPREAD)
        value = np.where(painted, value, value * np.exp(spread * of_object))
        patch = np.floor(town[:, :2] / _PATCH_TEXEL_M).astype(np.int64) % len(self.patches)
        return np.asarray(value * self.patches[patch[:, 1], patch[:, 0]], dtype=np.float64)


def scene_reflectance(scene: Scene) -> Reflectance:
    """The reflectance of a scene; painted once per process."""
    return _painted(scene.seed, scene.plan, scene.texel_m)


@lru_cache(maxsize=2)
def _painted(seed: int, plan: GroundPlan, texel_m: float) -> Reflectance:
    fine = paint_infrared(plan, texel_m)
    # A laser's footprint is some 12 cm wide: nothing finer comes back.
    shrink = max(1, round(_PATCH_TEXEL_M / texel_m))
    h, w = fine.shape[0] // shrink, fine.shape[1] // shrink
    ground = cv2.resize(fine[: h * shrink, : w * shrink], (w, h), interpolation=cv2.INTER_AREA)
    patches = 1.0 + _PATCHES * periodic(1024, np.random.default_rng((seed, 92)), exponent=0.8, low=4)
    return Reflectance(
        ground=np.asarray(ground, dtype=np.float32),
        ground_texel_m=texel_m * shrink,
        patches=np.clip(patches, 0.4, 1.8).astype(np.float32),
    )
