"""Layers over a photo: lines where the answered camera sees them, and no scan stands before them."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from reloc.answered_view import AnsweredView
from reloc.pixels.layer import Shape
from reloc.pixels.surfaces import resampled

_DEPTH_PX = 1600  # longer side of the picture that decides what is hidden
_COLOURS_RGB = ((255, 70, 50), (60, 200, 255), (255, 210, 40), (110, 230, 90), (230, 110, 255))
_STEP_PX = 6.0  # between points of a line at which visibility is asked
_MOST_PIECES = 20_000
_SIXTEENTHS = 4  # OpenCV's shift
_BEFORE_REL = 0.005  # of the distance; with a spacing of the scan what may stand before a line laid on it


def draw_layer(
    rgb: NDArray[np.uint8], view: AnsweredView, shapes: Sequence[Shape], cloud: PointCloud | None
) -> NDArray[np.uint8]:
    """A copy of the photo (h, w, 3) with the shapes in it; each name has its own colour.

    Args:
        rgb: of the view's camera, or resampled.
        shapes: in the view's frame. cloud: in the same; None hides nothing.
    """
    picture = np.ascontiguousarray(rgb).copy()
    scale = np.array([picture.shape[1] / view.camera.width, picture.shape[0] / view.camera.height])
    thick = max(1, round(max(picture.shape[:2]) / 900))
    colours = {name: _COLOURS_RGB[i % 5] for i, name in enumerate(dict.fromkeys(s.name for s in shapes))}
    seen = _Visibility(view, cloud)
    for shape in shapes:
        pen = (colours[shape.name], thick, cv2.LINE_AA)
        if shape.is_point:
            pixels, shown = seen(shape.points)
            for x, y in pixels[shown] * scale:
                cv2.circle(picture, _sixteenths(x, y), 16 * 4 * thick, *pen, _SIXTEENTHS)
                where = (int(x) + 6 * thick, int(y))
                cv2.putText(picture, shape.name, where, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * thick, *pen)
            continue
        pixels, shown = seen(_cut(view, shape.points))
        both = shown[1:] & shown[:-1]
        for a, b in zip((pixels[:-1] * scale)[both], (pixels[1:] * scale)[both], strict=True):
            cv2.line(picture, _sixteenths(*a), _sixteenths(*b), *pen, _SIXTEENTHS)
    return picture


def _sixteenths(x: float, y: float) -> tuple[int, int]:
    """A pixel as OpenCV draws it with that shift: the centre of the top-left one is (0, 0)."""
    return round(16.0 * (float(x) - 0.5)), round(16.0 * (float(y) - 0.5))


class _Visibility:
    """Which points a camera sees past the scan."""

    def __init__(self, view: AnsweredView, cloud: PointCloud | None) -> None:
        self.view = view
        self.spacing_m = 0.0
        self.depth: NDArray[np.float32] | None = None
        if cloud is not None and len(cloud):
            camera = view.camera
            small = resampled(camera, min(1.0, _DEPTH_PX / max(camera.width, camera.height)))
            self.depth = render(cloud, small, view.cam_from_local, RenderOptions(attributes=False)).depth
            self.spacing_m = 0.0 if cloud.spacing_m is None else float(np.median(cloud.spacing_m))

    def __call__(self, points: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Pixels (n, 2) of points (n, 3), and which of them are seen."""
        camera = self.view.camera
        in_camera = self.view.cam_from_local.act(np.where(np.isfinite(points), points, 0.0))
        pixels = camera.project(in_camera)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
        shown: NDArray[np.bool_] = np.logical_and(inside, np.isfinite(points).all(axis=1))
        if self.depth is not None:
            at = (pixels[shown] * (self.depth.shape[1] / camera.width)).astype(int)
            scan = self.depth[at[:, 1], at[:, 0]]
            depth = in_camera[shown, 2]
            shown[shown] = ~(scan < depth * (1.0 - _BEFORE_REL) - self.spacing_m)
        return pixels, shown


def _cut(view: AnsweredView, points: FloatArray) -> FloatArray:
    """The line with so many points between its vertices that each piece is short in the picture."""
    pieces = []
    centre, focal = view.cam_from_local.center, view.camera.focal_px
    for a, b in pairwise(points):
        nearest = max(float(np.linalg.norm(0.5 * (a + b) - centre)), 1.0)
        count = np.linalg.norm(b - a) * focal / nearest / _STEP_PX if np.isfinite(a + b).all() else 1
        steps = np.linspace(0.0, 1.0, int(np.clip(count, 1, _MOST_PIECES)), endpoint=False)
        pieces.append(a + steps[:, None] * (b - a))
    return np.concatenate([*pieces, points[-1:]])
