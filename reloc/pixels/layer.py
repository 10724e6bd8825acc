"""GIS layers: GeoJSON's points, lines and polygons in a local frame, with heights of the file or a scan."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geo.crs.survey import geodetic_from_survey, survey_crs
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.render.cloud import PointCloud

_CRS84 = "EPSG:4326"  # x is longitude in it, as in all systems here
_STEP_M = 0.5  # between vertices of a line that is laid on a scan
_MOST_STEPS = 4000  # of one line: two kilometres, beyond which vertices lie farther apart
_REACH_M = 5.0  # to the scan's nearest point in plan, from which a height is taken


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Shape:
    """A point (1, 3) or a line (n, 3) in a local frame, metres; NaN where the scan gives no height."""

    points: FloatArray
    name: str

    @property
    def is_point(self) -> bool:
        return len(self.points) == 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Layer:
    """What a file holds.

    Attributes:
        lines: (n, 3) each, latitude, longitude (degrees), height (m), NaN where the file has none.
        names: of each, "" where the feature has none.
    """

    lines: tuple[FloatArray, ...]
    names: tuple[str, ...]

    @property
    def has_heights(self) -> bool:
        return all(np.isfinite(line).all() for line in self.lines)


def read_layer(path: Path) -> Layer:
    """Points, lines and the rings of polygons of a GeoJSON file.

    Coordinates are longitude and latitude of WGS84, or of the system that a member `crs` of 2008's GeoJSON
    names. A feature's property `name` is its name.

    Raises:
        InvalidValueError: the file cannot be read, is no GeoJSON or has a system that PROJ does not know.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        crs = survey_crs(_crs_of(document))
        lines, names = [], []
        for name, line in _lines(document):
            found = np.full((len(line), 3), np.nan)
            for row, position in zip(found, line, strict=True):
                row[: min(len(position), 3)] = position[:3]
            lines.append(geodetic_from_survey(crs, found))
            names.append(name)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, GeodesyError) as error:
        raise InvalidValueError(f"{path}: expected GeoJSON, found {type(error).__name__}: {error}") from error
    return Layer(lines=tuple(lines), names=tuple(names))


def laid_on(layer: Layer, frame: LocalFrame, cloud: PointCloud | None) -> list[Shape]:
    """The layer in a local frame; vertices without heights, and what joins them, are laid on the scan.

    A height is that of the highest of the scan's four points that are nearest in plan.

    Args:
        cloud: in that frame; None: all lines must have heights.

    Raises:
        InvalidValueError: heights are missing, and there is no scan.
    """
    if cloud is None and not layer.has_heights:
        raise InvalidValueError(
            "layer: expected heights, or a scan around the camera to lay it on, found neither"
        )
    tree = None if cloud is None or layer.has_heights else cKDTree(cloud.xyz[:, :2])
    shapes = []
    for line, name in zip(layer.lines, layer.names, strict=True):
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
