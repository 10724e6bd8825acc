"""Procedural textures of facades, roofs, water, leaves; all tile without a seam, all by seed.

Light varies little over them (the sun is in `Faces.tint`); what they must have is structure at all scales,
since that is what features feed on, and honest sameness where a town has it.

Walls and tiled roofs are painted in pieces: with one, every brick wall of the town is cut from the same 24 m,
down to the flower pots; with more, buildings are of one design and yet not the same.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.simworld.town.texture import Texture, periodic, to_image

Canvas = NDArray[np.float32]

BAY_M = 3.0  # one window axis of a facade
STOREY_M = 3.0
_FACADE_TEXEL_M = 0.0234375  # 8 bays of 128 texels, 5 storeys plus a row of brick
_SIZE = 1024
_TILE_TEXEL_M = 0.025
_DETAIL_TEXEL_M = 0.0125

FACADE_LENGTH_M = _SIZE * _FACADE_TEXEL_M
ROOF_LENGTH_M = _SIZE * _TILE_TEXEL_M


def town_textures(seed: int, pieces: int = 1) -> dict[str, Texture]:
    """Every texture but the painted ground and the water, plus `detail`, by name.

    Args:
        pieces: of each wall and each tiled roof, one beside the other along u. With several, the land around
            the town repeats every 1,024 m only, not every 256 m: photos that look out of a long town find
            their twins otherwise.
    """
    painters: dict[str, Callable[[np.random.Generator], Texture]] = {
        "fields": lambda r: _fields(r, pieces),
        "facade_brick": lambda r: _facade(r, (150, 84, 66), pieces, brick=True),
        "facade_plaster": lambda r: _facade(r, (214, 206, 190), pieces, brick=False),
        "facade_ochre": lambda r: _facade(r, (206, 170, 110), pieces, brick=False),
        "facade_panel": lambda r: _facade(r, (168, 172, 176), pieces, brick=False, panel=True),
        "facade_stone": lambda r: _facade(r, (172, 160, 140), pieces, brick=True, course=(0.6, 0.3)),
        "roof_red": lambda r: _tiles(r, (158, 78, 56), pieces),
        "roof_brown": lambda r: _tiles(r, (112, 82, 66), pieces),
        "roof_slate": lambda r: _tiles(r, (92, 96, 104), pieces),
        "roof_bitumen": _bitumen,
        "roof_metal": _metal,
        "plain": lambda r: _noisy(r, (200, 200, 200), 0.05),
        "wood": _wood,
        "car": lambda r: _noisy(r, (205, 205, 205), 0.04, exponent=1.6),
        "leaves": _leaves,
        "detail": _detail,
    }
    return {
        name: painter(np.random.default_rng((seed, 77, i)))
        for i, (name, painter) in enumerate(painters.items())
    }


def water_texture(seed: int) -> Texture:
    """Waves of one moment: another seed has nothing in common with it."""
    rng = np.random.default_rng((seed, 78))
    waves = periodic(512, rng, exponent=0.9, low=6, high=90)
    glints = np.clip(waves - 2.0, 0, 1.5)
    level = 1.0 + 0.16 * waves + 0.9 * glints
    return Texture.from_image(to_image(level[..., None] * np.array([62, 82, 88], np.float32)), 0.06)


def _coloured(base: tuple[int, int, int], level: Canvas) -> Canvas:
    return np.asarray(level[..., None] * np.array(base, np.float32), dtype=np.float32)


def _plain(base: tuple[int, int, int], level: Canvas, texel_m: float) -> Texture:
    """One colour, as light as `level` (size, size) says."""
    return Texture.from_image(to_image(_coloured(base, level.astype(np.float32))), texel_m)


def _noisy(
    rng: np.random.Generator, base: tuple[int, int, int], strength: float, exponent: float = 0.8
) -> Texture:
    return _plain(base, 1 + strength * periodic(512, rng, exponent=exponent), 0.03)


def _detail(rng: np.random.Generator) -> Texture:
    """Grey around 128, multiplied (as value / 128) over other textures: dirt, grain, scratches."""
    level = 1.0 + 0.08 * periodic(_SIZE, rng, exponent=0.75) + 0.04 * periodic(_SIZE, rng, exponent=0.1)
    stains = np.clip(periodic(_SIZE, rng, exponent=1.4, low=3) - 1.2, 0, 2)
    image = _coloured((128, 128, 128), (level - 0.14 * stains).astype(np.float32))
    for _ in range(250):
        centre = tuple(int(c) for c in rng.integers(0, _SIZE, 2))
        cv2.circle(image, centre, int(rng.integers(1, 5)), (float(rng.normal(125, 18)),) * 3, -1, cv2.LINE_AA)
    return Texture.from_image(to_image(image), _DETAIL_TEXEL_M)


def _masonry(rng: np.random.Generator, texel_m: float, course: tuple[float, float]) -> Canvas:
    """Factor (size, size): stones of course (length, height) metres with joints, each of its own shade."""
    columns, rows = (round(_SIZE * texel_m / m) for m in course)
    shade = rng.normal(1.0, 0.10, (rows, columns)).astype(np.float32)
    y = (np.arange(_SIZE) * rows / _SIZE)[:, None]
    x = (np.arange(_SIZE) * columns / _SIZE)[None] + 0.5 * (y.astype(int) % 2)
    stone = shade[y.astype(int) % rows, x.astype(int) % columns]
    joint_x, joint_y = 0.02 / course[0], 0.02 / course[1]
    joint = ((x % 1.0) < joint_x) | ((y % 1.0) < joint_y)
    return np.asarray(np.where(joint, 0.72, stone), dtype=np.float32)


def _facade(
    rng: np.random.Generator,
    base: tuple[int, int, int],
    pieces: int,
    *,
    brick: bool,
    panel: bool = False,
    course: tuple[float, float] = (0.25, 0.094),
) -> Texture:
    """Pieces of eight bays by eight storeys of one design; row 0 is at the ground, so v grows upward."""
    images = []
    design = (0.72, 0.5) if panel else None  # width and height of windows, as shares of bay and storey
    bay, storey = round(BAY_M / _FACADE_TEXEL_M), round(STOREY_M / _FACADE_TEXEL_M)
    for _ in range(pieces):
        level = 1.0 + 0.05 * periodic(_SIZE, rng, exponent=0.9)
        if brick:
            level = level * _masonry(rng, _FACADE_TEXEL_M, course)
        image = _coloured(base, level.astype(np.float32))
        design = design or (float(rng.uniform(0.34, 0.46)), float(rng.uniform(0.46, 0.56)))
        for row in range(_SIZE // storey):
            if panel:
                image[row * storey : row * storey + 3] *= 0.6
            for column in range(_SIZE // bay):
                x0, y0 = column * bay, row * storey
                door = row == 0 and column % 3 == 1
                w, h = int(bay * design[0]), int(storey * (0.72 if door else design[1]))
                left, sill = x0 + (bay - w) // 2, y0 + (2 if door else int(0.3 * storey))
                _window(image, rng, left, sill, w, h, door)
                if panel:
                    image[y0 : y0 + storey, x0 : x0 + 2] *= 0.75
        images.append(image)
    return Texture.from_image(to_image(np.concatenate(images, axis=1)), _FACADE_TEXEL_M)


def _window(
    image: Canvas, rng: np.random.Generator, left: int, sill: int, w: int, h: int, door: bool
) -> None:
    """Paint one window or door in place: frame, panes, something behind them, a sill."""
    frame = (90, 62, 44) if door else (232, 230, 224)
    cv2.rectangle(image, (left - 3, sill - 3), (left + w + 3, sill + h + 3), frame, -1)
    cv2.rectangle(image, (left - 6, sill - 8), (left + w + 6, sill - 4), (150, 146, 140), -1)
    pane = np.linspace(30, 80, h, dtype=np.float32)[:, None, None] * np.array([0.8, 0.95, 1.1], np.float32)
    pane = np.repeat(pane, w, axis=1) * np.float32(rng.uniform(0.6, 1.3))
    if rng.random() < 0.6:  # a curtain or a blind
        drawn = int(rng.uniform(0.15, 0.9) * h)
        pane[h - drawn :] = np.array([190, 180, 160], np.float32) * np.float32(rng.uniform(0.5, 1.1))
        pane[h - drawn :: 4] *= 0.85
    for _ in range(int(rng.integers(0, 4))):  # plants and other things on the sill
        x, y = int(rng.integers(0, w)), int(rng.integers(0, max(2, h // 3)))
        colour = tuple(float(c) for c in rng.uniform(30, 220, 3))
        pane = np.ascontiguousarray(pane)
        cv2.circle(pane, (x, y), int(rng.integers(3, 8)), colour, -1)
    image[sill : sill + h, left : left + w] = pane
    bars = (70, 48, 34) if door else (225, 222, 216)
    cv2.line(image, (left + w // 2, sill), (left + w // 2, sill + h), bars, 2)
    cv2.line(image, (left, sill + (2 * h) // 3), (left + w, sill + (2 * h) // 3), bars, 2)


def _tiles(rng: np.random.Generator, base: tuple[int, int, int], pieces: int) -> Texture:
    """Roof tiles with odd ones, moss and weather."""
    images = [_tiles_piece(rng, base) for _ in range(pieces)]
    return Texture.from_image(to_image(np.concatenate(images, axis=1)), _TILE_TEXEL_M)


def _tiles_piece(rng: np.random.Generator, base: tuple[int, int, int]) -> Canvas:
    level = _masonry(rng, _TILE_TEXEL_M, (0.30, 0.34)) * (1.0 + 0.09 * periodic(_SIZE, rng, exponent=1.0))
    rows = round(_SIZE * _TILE_TEXEL_M / 0.34)
    lap = 1.12 - 0.3 * ((np.arange(_SIZE) * rows / _SIZE) % 1.0)
    image = _coloured(base, (level * lap[:, None]).astype(np.float32))
    moss = np.clip(periodic(_SIZE, rng, exponent=1.2, low=4) - 1.0, 0, 1)[..., None]
    image = image * (1 - 0.6 * moss) + 0.6 * moss * np.array([86, 92, 60], np.float32)
    for _ in range(160):  # replaced tiles
        x, y = (int(c) for c in rng.integers(0, _SIZE - 16, 2))
        image[y : y + 13, x : x + 12] *= np.float32(rng.uniform(0.6, 1.5))
    return np.asarray(image, dtype=np.float32)


def _bitumen(rng: np.random.Generator) -> Texture:
    """A flat roof: almost nothing to hold on to, a seam now and then."""
    level = 1.0 + 0.025 * periodic(_SIZE, rng, exponent=1.3) + 0.012 * periodic(_SIZE, rng, exponent=0.0)
    level[::256] *= 0.9
    return _plain((120, 120, 118), level, 0.03)


def _metal(rng: np.random.Generator) -> Texture:
    """Standing seams, all alike."""
    level = 1.0 + 0.02 * periodic(_SIZE, rng, exponent=1.4)
    level[:, ::32] *= 0.7
    level[:, 1::32] *= 1.2
    return _plain((150, 158, 160), level, 0.02)


def _wood(rng: np.random.Generator) -> Texture:
    level = 1.0 + 0.15 * periodic(512, rng, exponent=0.9)
    level[::24] *= 0.55
    return _plain((140, 104, 70), level, 0.01)


def _leaves(rng: np.random.Generator) -> Texture:
    clumps = periodic(_SIZE, rng, exponent=0.7, low=10) + 0.6 * periodic(_SIZE, rng, exponent=0.0)
    image = _coloured((74, 98, 48), (1.0 + 0.30 * clumps).astype(np.float32))
    image[..., 0] += 8 * periodic(_SIZE, rng, exponent=1.5)
    return Texture.from_image(to_image(image), 0.03)


def _fields(rng: np.random.Generator, pieces: int) -> Texture:
    """Land around the town, coarse; of one look whatever its period."""
    times = 1 if pieces == 1 else 4
    size, low = _SIZE * times, float(times)
    level = 1.0 + 0.16 * periodic(size, rng, exponent=1.0, low=low)
    image = _coloured((112, 122, 74), level.astype(np.float32))
    image[..., 0] += 14 * periodic(size, rng, exponent=1.6, low=low)
    return Texture.from_image(to_image(image), 0.25)
