"""GIS layers over a photo: GeoJSON's points, lines and polygons where the answered camera sees them.

Their heights are the file's, or a scan's. What stands behind the scan is not drawn.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.crs.survey import geodetic_from_survey, survey_crs
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from reloc.answered_view import AnsweredView
from reloc.pixels.surfaces import resampled

_CRS84 = "EPSG:4326"  # x is longitude in it, as in all systems here
_STEP_M = 0.5  # between vertices of a line that is laid on a scan
_MOST_STEPS = 4000  # of one line: two kilometres, beyond which vertices lie farther apart
_REACH_M = 5.0  # to the scan's nearest point in plan, from which a height is taken


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """A point (1, 3) or a line (n, 3).

    In a local frame, metres, NaN where the scan gives no height; of a file latitude, longitude (degrees) and
    height (m), NaN where it has none. `name`: "" where the feature has none.
    """

    points: FloatArray
    name: str


def read_layer(path: Path) -> list[Shape]:
    """Points, lines and the rings of polygons of a GeoJSON file.

    Coordinates are longitude and latitude of WGS84, or of the system that a member `crs` of 2008's GeoJSON
    names. A feature's property `name` is its name.

    Raises:
        InvalidValueError: the file cannot be read, is no GeoJSON or has a system that PROJ does not know.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        crs = survey_crs(_crs_of(document))
        layer = []
        for name, line in _lines(document):
            found = np.full((len(line), 3), np.nan)
            for row, position in zip(found, line, strict=True):
                row[: min(len(position), 3)] = position[:3]
            layer.append(Shape(points=geodetic_from_survey(crs, found), name=name))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, GeodesyError) as error:
        raise InvalidValueError(f"{path}: expected GeoJSON, found {type(error).__name__}: {error}") from error
    return layer


def laid_on(layer: Sequence[Shape], frame: LocalFrame, cloud: PointCloud | None) -> list[Shape]:
    """The layer in a local frame; vertices without heights, and what joins them, are laid on the scan.

    A height is that of the highest of the scan's four points that are nearest in plan.

    Args:
        cloud: in that frame; None: all lines must have heights.

    Raises:
        InvalidValueError: heights are missing, and there is no scan.
    """
    has_heights = all(np.isfinite(shape.points).all() for shape in layer)
    if cloud is None and not has_heights:
        raise InvalidValueError(
            "layer: expected heights, or a scan around the camera to lay it on, found neither"
        )
    tree = None if cloud is None or has_heights else cKDTree(cloud.xyz[:, :2])
    shapes = []
    for line, name in ((shape.points, shape.name) for shape in layer):
        flat = ~np.isfinite(line[:, 2])
        points = frame.enu_from_geodetic(np.where(flat[:, None] & [False, False, True], frame.height_m, line))
        if flat.any() and tree is not None and cloud is not None:
            points = _dense(np.where(flat[:, None] & [False, False, True], np.nan, points))
            missing = np.isnan(points[:, 2])
            points[missing, 2] = _heights(points[missing], cloud, tree)
        shapes.append(Shape(points=points, name=name))
    return shapes


def _heights(points: FloatArray, cloud: PointCloud, tree: cKDTree) -> FloatArray:
    distance, rows = tree.query(points[:, :2], k=min(4, len(cloud)), distance_upper_bound=_REACH_M)
    distance, rows = (np.asarray(found).reshape(len(points), -1) for found in (distance, rows))
    # What is too far has the row behind the last.
    z = np.append(cloud.xyz[:, 2].astype(np.float64), -np.inf)[rows]
    return np.where(np.isfinite(distance[:, 0]), z.max(axis=1), np.nan)


def _dense(points: FloatArray) -> FloatArray:
    """A line with vertices no farther apart than a step; NaN heights beside vertices that have none."""
    if len(points) == 1:
        return points
    length = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    step = max(_STEP_M, float(length.sum()) / _MOST_STEPS)
    counts = np.maximum(np.ceil(length / step), 1).astype(int)
    rows = np.arange(len(points))
    at = np.concatenate([*(row + np.arange(n) / n for row, n in enumerate(counts)), rows[-1:]])
    return np.column_stack([np.interp(at, rows, points[:, axis]) for axis in range(3)])


def _crs_of(document: dict[str, Any]) -> str:
    name = (document.get("crs") or {}).get("properties", {}).get("name", "")
    if not name or name.endswith("CRS84"):
        return _CRS84
    return "EPSG:" + name.rsplit(":", 1)[-1] if "EPSG" in name.upper() else str(name)


def _lines(document: dict[str, Any], name: str = "") -> Iterator[tuple[str, list[list[float]]]]:
    kind = document["type"]
    if kind == "FeatureCollection":
        for feature in document["features"]:
            yield from _lines(feature)
    elif kind == "Feature":
        if document["geometry"] is not None:
            yield from _lines(document["geometry"], str((document.get("properties") or {}).get("name", "")))
    elif kind == "GeometryCollection":
        for geometry in document["geometries"]:
            yield from _lines(geometry, name)
    else:
        for line in _of_geometry(kind, document["coordinates"]):
            yield name, line


def _of_geometry(kind: str, places: Any) -> list[list[list[float]]]:
    if kind == "Point":
        return [[places]]
    if kind == "MultiPoint":
        return [[place] for place in places]
    if kind == "LineString":
        return [places]
    if kind in ("MultiLineString", "Polygon"):
        return list(places)
    if kind == "MultiPolygon":
        return [ring for polygon in places for ring in polygon]
    raise ValueError(f"geometry of type {kind!r}")


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
        if len(shape.points) == 1:
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
