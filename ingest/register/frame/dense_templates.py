"""2D-3D correspondences between a photo and a rendering by dense templates."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.camera import Camera
from featuredb.render.rendering import Rendering
from ingest.register.frame.oriented_gradients import FloatImage, GradientOptions, oriented_gradients
from ingest.register.frame.score_maps import TemplateOptions, cut_templates, search_around
from ingest.register.frame.source_pictures import source_picture
from ingest.register.frame_registration import RenderSource


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseMatchOptions:
    """Which peaks are taken for matches; lengths in pixels of the rendering.

    Attributes:
        min_score: height of a peak in standard deviations of its map. The highest of some thousand chance
            values is near 3.5; below that a peak says nothing.
        min_lead: by how much it exceeds the highest value further than `rival_px` from it.
        rival_px: half the size of a peak.
        neighbours: how many nearest matches are asked whether they moved alike.
        agreeing: how many of them must have, within `alike_px` plus `alike_rel` of the distance between them.
    """

    min_score: float = 3.0
    min_lead: float = 0.15
    rival_px: int = 5
    neighbours: int = 8
    agreeing: int = 2
    alike_px: float = 2.5
    alike_rel: float = 0.06  # five degrees, or five percent of scale, and a little parallax
    gradients: GradientOptions = field(default_factory=GradientOptions)
    templates: TemplateOptions = field(default_factory=lambda: TemplateOptions(max_count=600))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DenseMatches:
    """Correspondences, best first.

    Attributes:
        pixels: (n, 2) float64, full-size photo pixels.
        points_local: (n, 3) float64, metres.
        scores: (n,) float64, height of the peak in standard deviations of its map.
        searched: how many templates were searched for.
    """

    pixels: FloatArray
    points_local: FloatArray
    scores: FloatArray
    searched: int

    def __post_init__(self) -> None:
        n = len(self.scores)
        for name, shape in (("pixels", (n, 2)), ("points_local", (n, 3)), ("scores", (n,))):
            object.__setattr__(self, name, frozen_array(f"DenseMatches.{name}", getattr(self, name), shape))

    def __len__(self) -> int:
        return len(self.scores)


def dense_matches(
    photo_gray: NDArray[np.uint8],
    camera: Camera,
    rendering: Rendering,
    search_px: int,
    source: RenderSource = "intensity",
    options: DenseMatchOptions | None = None,
) -> DenseMatches:
    """Pieces of a rendering found again in the photo around where the rendering's pose puts them.

    Args:
        photo_gray: (h, w) uint8 of `camera`'s size.
        camera: of the photo at full size.
        rendering: made with the photo's own lens, `camera.scaled_to(...)`, so that nothing has to be warped.
        search_px: radius of the search in pixels of the rendering.
        source: which picture of the rendering is compared.
    """
    options = options or DenseMatchOptions()
    picture = source_picture(rendering, source)
    channels = oriented_gradients(picture, rendering.valid, options.gradients)
    templates = cut_templates(channels, rendering, options.templates)
    size = (rendering.camera.width, rendering.camera.height)
    small = np.asarray(cv2.resize(photo_gray, size, interpolation=cv2.INTER_AREA))
    photo = oriented_gradients(small, None, options.gradients)
    maps = search_around(templates, photo, rendering.camera, rendering.cam_from_local, search_px)
    if len(maps) == 0:
        return _none(len(templates))
    cells, scores, lead = peaks(maps.maps, options.rival_px)
    pixels = maps.origin + cells
    moved = cells - search_px
    good = np.flatnonzero((scores >= options.min_score) & (lead >= options.min_lead))
    good = good[_agreeing(pixels[good] - moved[good], moved[good], options)]
    good = good[np.argsort(-scores[good], kind="stable")]
    full = pixels[good] * (camera.width / size[0], camera.height / size[1])
    return DenseMatches(
        pixels=full, points_local=maps.points_local[good], scores=scores[good], searched=len(templates)
    )


def peaks(maps: FloatImage, rival_px: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Highest cells of maps (n, h, w): positions (n, 2) as (x, y) to a fraction of a cell, heights, leads.

    The lead is the height over that of the highest cell further than `rival_px` away in x or y.
    """
    n, height, width = maps.shape
    best = maps.reshape(n, -1).argmax(axis=1)
    rows, columns = np.divmod(best, width)
    values = maps.reshape(n, -1)[np.arange(n), best].astype(np.float64)
    rival = np.empty(n)
    for i, (row, column) in enumerate(zip(rows, columns, strict=True)):
        rest = maps[i].copy()
        rest[
            max(row - rival_px, 0) : row + rival_px + 1, max(column - rival_px, 0) : column + rival_px + 1
        ] = -9.0
        rival[i] = rest.max()
    # A peak on the border has its true top outside.
    border = (rows == 0) | (columns == 0) | (rows == height - 1) | (columns == width - 1)
    r, c = np.clip(rows, 1, height - 2), np.clip(columns, 1, width - 2)
    index = np.arange(n)
    dx = _parabola(maps[index, r, c - 1], maps[index, r, c], maps[index, r, c + 1])
    dy = _parabola(maps[index, r - 1, c], maps[index, r, c], maps[index, r + 1, c])
    lead = np.where(border, -np.inf, values - rival)
    return np.stack([columns + dx, rows + dy], axis=1), values, lead


def _parabola(left: FloatImage, middle: FloatImage, right: FloatImage) -> FloatArray:
    curvature = np.maximum(2.0 * middle - left - right, 1e-6)
    return np.asarray(np.clip(0.5 * (right - left) / curvature, -0.5, 0.5), dtype=np.float64)


def _agreeing(start: FloatArray, moved: FloatArray, options: DenseMatchOptions) -> NDArray[np.bool_]:
    """Which displacements (n, 2) of places (n, 2) are shared by enough neighbours."""
    if len(start) <= options.agreeing:
        return np.zeros(len(start), bool)
    count = min(options.neighbours + 1, len(start))
    found = cKDTree(start).query(start, k=count)
    distance, index = np.asarray(found[0]), np.asarray(found[1])
    apart = np.linalg.norm(moved[index[:, 1:]] - moved[:, None], axis=2)
    alike = apart <= options.alike_px + options.alike_rel * distance[:, 1:]
    return np.asarray(alike.sum(axis=1) >= options.agreeing)


def _none(searched: int) -> DenseMatches:
    return DenseMatches(
        pixels=np.zeros((0, 2)), points_local=np.zeros((0, 3)), scores=np.zeros(0), searched=searched
    )
