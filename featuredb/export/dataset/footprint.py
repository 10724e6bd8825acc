"""Where a map lies, as an area in longitude and latitude."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from featuredb.geo.utm import geodetic_from_utm
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap

_HALF_TURN_DEG, _TURN_DEG = 180.0, 360.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Footprint:
    """The hull of a map's points and cameras in plan, in WGS84 degrees.

    Attributes:
        geometry: GeoJSON: a Polygon; a MultiPolygon where it crosses the antimeridian; a Point where hull and
            box have no area.
        bbox: west, south, east, north; west is larger than east across the antimeridian.
    """

    geometry: dict[str, Any]
    bbox: tuple[float, float, float, float]


def footprint_of(feature_map: FeatureMap) -> Footprint:
    """The area of a map; its frame's origin where it has neither points nor images."""
    frame, epsg = feature_map.frame, feature_map.epsg
    cameras = np.array([i.cam_from_local.center for i in feature_map.images], np.float64).reshape(-1, 3)
    plan = np.concatenate([feature_map.points.utm, frame.utm_from_enu(cameras, epsg)])[:, :2]
    if len(plan) == 0:
        plan = frame.utm_from_enu(np.zeros((1, 3)), epsg)[:, :2]
    corners = _hull(plan)
    lat_lon = geodetic_from_utm(np.column_stack([corners, np.zeros(len(corners))]), epsg)[:, :2]
    return _footprint(np.ascontiguousarray(lat_lon[:, ::-1]))


def _hull(plan: FloatArray) -> FloatArray:
    """Corners (k, 2), counterclockwise; those of the box, or one point, where there is no hull."""
    low, high = plan.min(axis=0), plan.max(axis=0)
    try:
        # Around the middle, since the hull's arithmetic knows no eastings of six digits.
        return np.asarray(plan[ConvexHull(plan - (low + high) / 2.0).vertices])
    except (QhullError, ValueError):
        if (high - low).min() > 0:
            return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        return np.asarray(((low + high) / 2.0)[None])


def _footprint(lon_lat: FloatArray) -> Footprint:
    east_of_it = np.ptp(lon_lat[:, 0]) > _HALF_TURN_DEG
    if east_of_it:
        lon_lat = lon_lat + (lon_lat[:, :1] < 0) * np.array([_TURN_DEG, 0.0])
    (west, south), (east, north) = lon_lat.min(axis=0).tolist(), lon_lat.max(axis=0).tolist()
    if len(lon_lat) == 1:
        return Footprint(
            geometry={"type": "Point", "coordinates": lon_lat[0].tolist()}, bbox=(west, south, east, north)
        )
    if not east_of_it:
        return Footprint(
            geometry={"type": "Polygon", "coordinates": [_ring(lon_lat)]}, bbox=(west, south, east, north)
        )
    parts = [_cut(lon_lat, east_side=False), _cut(lon_lat, east_side=True) - [_TURN_DEG, 0.0]]
    return Footprint(
        geometry={"type": "MultiPolygon", "coordinates": [[_ring(part)] for part in parts]},
        bbox=(west, south, east - _TURN_DEG, north),
    )


def _ring(corners: FloatArray) -> list[list[float]]:
    return [*corners.tolist(), corners[0].tolist()]


def _cut(corners: FloatArray, *, east_side: bool) -> FloatArray:
    """The part of a convex polygon on one side of the antimeridian, which is at 180 degrees here."""
    kept: list[FloatArray] = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inside = (a[0] >= _HALF_TURN_DEG) == east_side
        if inside:
            kept.append(a)
        if (a[0] >= _HALF_TURN_DEG) != (b[0] >= _HALF_TURN_DEG):
            share = (_HALF_TURN_DEG - a[0]) / (b[0] - a[0])
            kept.append(np.array([_HALF_TURN_DEG, a[1] + share * (b[1] - a[1])]))
    return np.array(kept)
