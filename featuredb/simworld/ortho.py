"""An ortho image of the town, taken from an aircraft on another day and laid over the terrain.

As ordinary ortho images do, it knows the terrain and not what stands on it: roofs lean away from the point
below each aerial photo, hide what is behind them, and jump at the seams between photos.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import render_view
from featuredb.simworld.town.scene import DayOptions, Scene, another_day
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.town.town import WATER_LEVEL_M

_TRUE_ORTHO_HEIGHT_M = 60_000.0  # from up there nothing leans by more than centimetres
_LEAN_MARGIN_M = 12.0  # what an aerial photo shows beyond its part: terrain and the rays' slant
_GRID_STEP_PX = 64  # UTM is smooth: between points so far apart bilinear interpolation errs by micrometres
_BLUR_PX = 0.5
_NOISE = 2.0  # grey values


@dataclass(frozen=True, slots=True, kw_only=True)
class OrthoOptions:
    """An ortho image. The same options and scene give the same pixels.

    Attributes:
        lean: buildings lean as in an ordinary ortho image; without, it is a true ortho image.
        flight_height_m: of the aerial photos over the town's origin.
        spacing_m: between aerial photos, both ways.
        shift_m: east, north: how far from its place it shows everything; real ones and real scans disagree.
        season: factors on red, green, blue of what is green.
        day: what differs from the day of the photos: sun, cars, leaves.
    """

    seed: int = 1
    pixel_m: float = 0.15
    lean: bool = True
    flight_height_m: float = 1200.0
    spacing_m: float = 260.0
    margin_m: float = 30.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    season: tuple[float, float, float] = (1.18, 1.0, 0.80)
    contrast: float = 0.92
    gamma: float = 0.88
    day: DayOptions = field(
        default_factory=lambda: DayOptions(seed=3, to_sun=(0.52, -0.24, 0.66), leaf_tint=(1.25, 1.0, 0.7))
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ortho:
    """An ortho image in UTM; pixel (row, column) covers [west + column * pixel_m, ...) and runs south.

    Attributes:
        rgb: (h, w, 3) uint8.
        west, north: outer corner of the top-left pixel, metres.
    """

    rgb: Image8
    epsg: int
    west: float
    north: float
    pixel_m: float


def make_ortho(scene: Scene, options: OrthoOptions = OrthoOptions()) -> Ortho:
    """Photograph the town from the air on the options' day and rectify over its terrain."""
    today = another_day(scene, options.day)
    west, north, width, height = _extent(scene, options)
    ground = _ground_points(scene, west, north, width, height, options.pixel_m)
    rgb = np.zeros((height, width, 3), np.uint8)
    stations = _stations(scene, options)
    town = ground[..., :2] @ scene.enu_from_town[:2, :2].astype(np.float32)
    owner = _nearest(town, stations)
    for i, station in enumerate(stations):
        mine = owner == i
        x0, y0, w, h = cv2.boundingRect(mine.view(np.uint8))
        if w == 0:
            continue
        window = slice(y0, y0 + h), slice(x0, x0 + w)
        picture = _rectified(today, options, scene.enu_from_town @ station, ground[window], i)
        cv2.copyTo(picture, mine[window].view(np.uint8), rgb[window])
    return Ortho(
        rgb=_developed(rgb, options),
        epsg=scene.epsg,
        west=west + options.shift_m[0],
        north=north + options.shift_m[1],
        pixel_m=options.pixel_m,
    )


def _extent(scene: Scene, options: OrthoOptions) -> tuple[float, float, int, int]:
    """West, north, width, height in pixels of the upright rectangle around the town."""
    half = 0.5 * np.asarray(scene.plan.size) + options.margin_m
    corners = np.array([[a * half[0], b * half[1], 0.0] for a in (-1, 1) for b in (-1, 1)])
    utm = scene.frame.utm_from_enu(corners @ scene.enu_from_town.T, scene.epsg)
    west, south = np.floor(utm[:, :2].min(axis=0))
    east, north = np.ceil(utm[:, :2].max(axis=0))
    size = round((east - west) / options.pixel_m), round((north - south) / options.pixel_m)
    return float(west), float(north), *size


def _ground_points(
    scene: Scene, west: float, north: float, width: int, height: int, pixel_m: float
) -> NDArray[np.float32]:
    """Points (h, w, 3) of the terrain in the local frame below the centres of the pixels."""
    columns = np.arange(-_GRID_STEP_PX, width + 2 * _GRID_STEP_PX, _GRID_STEP_PX)
    rows = np.arange(-_GRID_STEP_PX, height + 2 * _GRID_STEP_PX, _GRID_STEP_PX)
    x, y = np.meshgrid(west + (columns + 0.5) * pixel_m, north - (rows + 0.5) * pixel_m)
    level = np.full_like(x, scene.frame.height_m)
    coarse = scene.frame.enu_from_utm(np.stack([x, y, level], axis=-1).reshape(-1, 3), scene.epsg)
    grid = coarse.reshape(*x.shape, 3)[..., :2].astype(np.float32)
    step = np.float32(1 / _GRID_STEP_PX)
    u, v = np.meshgrid(
        np.arange(width, dtype=np.float32) * step + 1, np.arange(height, dtype=np.float32) * step + 1
    )
    points = np.empty((height, width, 3), np.float32)
    # cv2.remap knows 1/32 of a cell only; two matrix products interpolate exactly.
    rows_from, columns_from = _weights(v[:, 0], len(rows)), _weights(u[0], len(columns))
    for k in range(2):
        points[..., k] = rows_from @ grid[..., k] @ columns_from.T
    y_town = points[..., :2] @ scene.enu_from_town[:2, 1].astype(np.float32)
    # The river's bed is under water.
    points[..., 2] = np.maximum(scene.plan.height(y_town), WATER_LEVEL_M)
    return points


def _weights(position: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Weights (n, count) of linear interpolation at positions (n,) between nodes 0..count-1."""
    distance = np.abs(position[:, None] - np.arange(count, dtype=np.float32)[None])
    return np.asarray(np.clip(1.0 - distance, 0.0, 1.0), dtype=np.float32)


def _stations(scene: Scene, options: OrthoOptions) -> FloatArray:
    """Positions (n, 3) of the aerial photos, town axes."""
    if not options.lean:
        return np.array([[0.0, 0.0, _TRUE_ORTHO_HEIGHT_M]])
    rng = np.random.default_rng((scene.seed, options.seed, 71))
    size = np.asarray(scene.plan.size) + 2 * options.margin_m
    counts = np.maximum(1, np.ceil(size / options.spacing_m)).astype(int)
    axes = [(np.arange(n) - 0.5 * (n - 1)) * options.spacing_m for n in counts]
    # The block of photos was not flown for this town: it lies anyhow.
    offset = rng.uniform(-0.35, 0.35, 2) * options.spacing_m
    return np.array(
        [[x + offset[0], y + offset[1], options.flight_height_m] for x in axes[0] for y in axes[1]]
    )


def _nearest(points: NDArray[np.float32], stations: FloatArray) -> NDArray[np.int32]:
    """Index (h, w) of the station nearest in plan."""
    best = np.full(points.shape[:2], np.inf, np.float32)
    owner = np.zeros(points.shape[:2], np.int32)
    for i, (x, y, _) in enumerate(stations.tolist()):
        square = (points[..., 0] - np.float32(x)) ** 2 + (points[..., 1] - np.float32(y)) ** 2
        owner[square < best] = i
        np.minimum(best, square, out=best)
    return owner


def _rectified(
    scene: Scene, options: OrthoOptions, station: FloatArray, ground: NDArray[np.float32], number: int
) -> Image8:
    """The part (h, w, 3) of the ortho image that one aerial photo gives."""
    # Straight down with the image's top to the north.
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    pose = Rigid3(rotation=rotation, translation=-rotation @ station)
    depth = station[2] - ground[..., 2]
    u = (ground[..., 0] - np.float32(station[0])) / depth
    v = -(ground[..., 1] - np.float32(station[1])) / depth
    margin = _LEAN_MARGIN_M / station[2]
    focal = float(station[2]) / options.pixel_m
    low = np.array([u.min(), v.min()]) - margin
    width, height = (int(np.ceil((c.max() + margin - a) * focal)) for c, a in zip((u, v), low, strict=True))
    camera = Camera(
        model="PINHOLE",
        width=width,
        height=height,
        params=(focal, focal, float(-low[0] * focal), float(-low[1] * focal)),
    )
    photo = render_view(scene, camera, pose, moment=9000 + 100 * options.seed + number)
    x, y = (c.astype(np.float64) * focal - a * focal - 0.5 for c, a in zip((u, v), low, strict=True))
    return np.asarray(
        cv2.remap(photo, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR), dtype=np.uint8
    )


def _developed(rgb: Image8, options: OrthoOptions) -> Image8:
    """Another camera's colours, another season's greens, some blur and noise."""
    rng = np.random.default_rng((options.seed, 72))
    result = np.empty_like(rgb)
    table = 255.0 * (np.arange(256) / 255.0) ** options.gamma
    table = (128.0 + options.contrast * (table - 128.0)).astype(np.float32)
    season = np.asarray(options.season, dtype=np.float32)
    soft = cv2.GaussianBlur(rgb, (0, 0), _BLUR_PX)
    for r in range(0, len(rgb), 512):  # in bands, for memory's sake
        band = table[soft[r : r + 512]]
        # Excess green, the usual index of what grows, from none to full in some twenty grey values.
        green = np.clip((2 * band[..., 1] - band[..., 0] - band[..., 2] - 6.0) / 20.0, 0.0, 1.0)
        band *= 1.0 + green[..., None] * (season - 1.0)
        band += rng.standard_normal(band.shape, dtype=np.float32) * np.float32(_NOISE)
        result[r : r + 512] = np.clip(band + 0.5, 0, 255)
    return result
