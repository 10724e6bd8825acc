"""What has come into a dataset, gathered while its maps pass by one after the other."""

from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from featuredb.export.dataset.layout import Partition
from featuredb.export.selection import licence_of
from featuredb.geo.utm import geodetic_from_utm
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.store.durable.log import utc
from featuredb.store.tables import BOUNDS

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
    geometry = {"type": "Polygon", "coordinates": [_ring(lon_lat)]}
    if len(lon_lat) == 1:
        geometry = {"type": "Point", "coordinates": lon_lat[0].tolist()}
    elif east_of_it:
        parts = [_cut(lon_lat, east_side=False), _cut(lon_lat, east_side=True) - [_TURN_DEG, 0.0]]
        geometry = {"type": "MultiPolygon", "coordinates": [[_ring(part)] for part in parts]}
        east -= _TURN_DEG
    return Footprint(geometry=geometry, bbox=(west, south, east, north))


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapEntry:
    """One map of the dataset, as its catalogue needs it.

    Attributes:
        row: its columns in maps.parquet, but for the geometry.
        licences: of its photos, by number of them; "" where nobody has said.
        taken: when its first and its last photo were taken; None where no photo says so. Times without a zone
            are taken for UTC.
    """

    row: dict[str, Any]
    footprint: Footprint
    partition: Partition
    licences: Counter[str]
    taken: tuple[datetime, datetime] | None

    @property
    def plan_box(self) -> list[float]:
        """Smallest easting and northing, largest ones of its points, metres; empty without points."""
        return [self.row[name] for name in (*BOUNDS[0:2], *BOUNDS[3:5])] if self.row["points"] else []


@dataclass(frozen=True, slots=True, kw_only=True)
class Contents:
    """All maps of the dataset, in its order, and the scans beside them (see `lidar_part`)."""

    maps: list[MapEntry] = field(default_factory=list)
    scans: list[dict[str, Any]] = field(default_factory=list)

    def total(self, column: str) -> int:
        """Sum of `images`, `points`, `observations` or `descriptors`."""
        return sum(int(entry.row[column]) for entry in self.maps)

    def count(self, column: str) -> Counter[str]:
        """How many maps have each value of a column."""
        return Counter(str(entry.row[column]) for entry in self.maps)

    def licences(self) -> Counter[str]:
        """How many photos have each licence."""
        return sum((entry.licences for entry in self.maps), Counter[str]())

    def partitions(self) -> list[Partition]:
        return sorted({entry.partition for entry in self.maps})

    def bbox(self) -> tuple[float, float, float, float]:
        """West, south, east, north in degrees of everything: the narrowest way around the Earth."""
        boxes = np.array([entry.footprint.bbox for entry in self.maps])
        south, north = float(boxes[:, 1].min()), float(boxes[:, 3].max())
        west, east = _around(boxes[:, 0], boxes[:, 2])
        return west, south, east, north

    def taken(self) -> tuple[datetime, datetime] | None:
        """The first and the last time of all photos."""
        known = [entry.taken for entry in self.maps if entry.taken is not None]
        return (min(first for first, _ in known), max(last for _, last in known)) if known else None


def entry_of(feature_map: FeatureMap, row: dict[str, Any]) -> MapEntry:
    """What is kept of a map when it has passed."""
    times = [utc(i.capture_time) for i in feature_map.images if i.capture_time is not None]
    return MapEntry(
        row=row,
        footprint=footprint_of(feature_map),
        partition=Partition(feature_map.epsg, feature_map.height_datum),
        licences=Counter(licence_of(image, feature_map) for image in feature_map.images),
        taken=(min(times), max(times)) if times else None,
    )


def _around(west: FloatArray, east: FloatArray) -> tuple[float, float]:
    """The shortest interval of longitude that holds all of these, which may cross the antimeridian."""
    order = np.argsort(west, kind="stable")
    starts = west[order]
    ends = np.where(east[order] < starts, east[order] + 360.0, east[order])
    reach = np.maximum.accumulate(ends)
    # The largest gap between one interval's reach and the next one's start is what is left out.
    gaps = np.append(starts[1:], starts[0] + 360.0) - reach
    start = float(starts[(int(np.argmax(gaps)) + 1) % len(starts)])
    width = float(((starts - start) % 360.0 + (ends - starts)).max())
    if width >= 360.0:
        return -180.0, 180.0
    return start, start + width - (360.0 if start + width > 180.0 else 0.0)
