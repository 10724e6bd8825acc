"""The local metric frame: topocentric east, north, up at an origin on the WGS84 ellipsoid.

All metric work (SfM, PnP, rendering) happens in such a frame. It is a rigid transform of geocentric space, so
distances and angles in it are true; UTM's scale, UTM's convergence and the Earth's curvature come in exactly,
through geodetic and geocentric coordinates, and nowhere else.

Heights enter this geometry as ellipsoidal heights, whatever their datum, which is carried beside them. The
geoid is up to about 100 m, usually some 30 m, away from the ellipsoid; taking a height above the one for a
height above the other moves the frame along the vertical and changes horizontal scale by 30 m in 6,371 km,
5 parts in a million: 5 mm in a map of 1 km. UTM coordinates that go in come out the same in any case.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geo.checks import as_geodetic, as_points, check_place
from featuredb.geo.projections import ecef_from_geodetic, enu_from_ecef_rotation, geodetic_from_ecef
from featuredb.geo.utm import geodetic_from_utm, meridian_convergence_deg, utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalFrame:
    """East, north, up in metres around an origin; equal origins are equal frames.

    Attributes:
        latitude_deg, longitude_deg: WGS84 degrees of the origin.
        height_m: height of the origin in metres, taken as ellipsoidal (see the module).
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float

    def __post_init__(self) -> None:
        for name in ("latitude_deg", "longitude_deg", "height_m"):
            object.__setattr__(self, name, float(getattr(self, name)))
        check_place("LocalFrame", self.latitude_deg, self.longitude_deg)
        if not np.isfinite(self.height_m):
            raise InvalidValueError(f"LocalFrame.height_m: expected a finite number, found {self.height_m}")

    @classmethod
    def from_utm(cls, easting: float, northing: float, height: float, epsg: int) -> Self:
        """The frame whose origin has these UTM coordinates (metres).

        Raises:
            GeodesyError: not a UTM code, or coordinates that are none.
        """
        latitude, longitude, h = geodetic_from_utm((easting, northing, height), epsg)
        return cls(latitude_deg=float(latitude), longitude_deg=float(longitude), height_m=float(h))

    @classmethod
    def about(cls, lat_lon_h: FloatArray) -> Self:
        """The frame at about this place (3,): degrees, degrees, metres; its origin is rounded to metres."""
        latitude, longitude, height = lat_lon_h.tolist()
        return cls(latitude_deg=round(latitude, 5), longitude_deg=round(longitude, 5), height_m=round(height))

    @classmethod
    def amid(cls, lat_lon_h: FloatArray) -> Self:
        """The frame at about the median of places (n, 3), n > 0: degrees, degrees, metres or NaN."""
        latitudes, longitudes, heights = lat_lon_h.T
        # From about the middle: beside the meridian of 180 degrees longitudes jump.
        turns = np.exp(1j * np.radians(longitudes))
        middle = float(np.degrees(np.angle(turns.sum())))
        east = np.degrees(np.angle(turns * np.exp(-1j * np.radians(middle))))
        longitude = (middle + float(np.median(east)) + 180.0) % 360.0 - 180.0
        known = heights[np.isfinite(heights)]
        height = float(np.median(known)) if len(known) else 0.0
        return cls.about(np.array([np.median(latitudes), longitude, height]))

    def enu_from_utm(self, utm: ArrayLike, epsg: int) -> FloatArray:
        """East, north, up in metres of UTM easting, northing, height.

        Args:
            utm: (n, 3) or (3,) float64, metres; heights in the datum of this frame's origin.
            epsg: the zone of `utm`, 326zz or 327zz; it need not be the zone of the origin.

        Raises:
            GeodesyError: not a UTM code, coordinates that look like degrees or that PROJ cannot convert.
            InvalidValueError: wrong shape or not finite.
        """
        return self.enu_from_geodetic(geodetic_from_utm(utm, epsg))

    def utm_from_enu(self, enu: ArrayLike, epsg: int) -> FloatArray:
        """UTM easting, northing, height in metres of points (n, 3) or (3,) of this frame, same shape.

        The inverse of `enu_from_utm`, same errors.
        """
        return utm_from_geodetic(self.geodetic_from_enu(enu), epsg)

    def enu_from_geodetic(self, lat_lon_h: ArrayLike) -> FloatArray:
        """East, north, up in metres of latitude, longitude (degrees), height (m), (n, 3) or (3,).

        Raises:
            GeodesyError: latitude or longitude out of range.
            InvalidValueError: wrong shape or not finite.
        """
        points = as_geodetic("LocalFrame.enu_from_geodetic", lat_lon_h)
        origin, rotation = _origin_and_axes(self)
        return points.shaped_like_input((ecef_from_geodetic(points.rows) - origin) @ rotation.T)

    def geodetic_from_enu(self, enu: ArrayLike) -> FloatArray:
        """Latitude, longitude (degrees), height (m) of points (n, 3) or (3,) of this frame, same shape."""
        points = as_points("LocalFrame.geodetic_from_enu", enu)
        if len(points.rows) == 1:
            return points.shaped_like_input(np.array([_geodetic_of_point(self, *points.rows[0].tolist())]))
        return points.shaped_like_input(geodetic_from_ecef(self._ecef_from_enu(points.rows)))

    def enu_from(self, other: "LocalFrame") -> Rigid3:
        """The transform this_enu_from_other_enu: exact, since both frames are rigid in geocentric space."""
        this_origin, this_rotation = _origin_and_axes(self)
        other_origin, other_rotation = _origin_and_axes(other)
        return Rigid3(
            rotation=this_rotation @ other_rotation.T,
            translation=this_rotation @ (other_origin - this_origin),
        )

    def ecef_from_enu(self) -> Rigid3:
        """The transform from this frame to geocentric X, Y, Z of WGS84 in metres (EPSG:4978)."""
        origin, enu_from_ecef = _origin_and_axes(self)
        return Rigid3(rotation=enu_from_ecef.T, translation=origin)

    def true_enu_from_enu(self, point_enu: ArrayLike) -> FloatArray:
        """Rotation (3, 3) from this frame's axes to true east, north, up at a point (3,) of this frame.

        It is not the identity away from the origin: verticals converge by a degree in 111 km, meridians more.
        """
        latitude, longitude, _ = self.geodetic_from_enu(_one_point(point_enu))
        _, enu_from_ecef = _origin_and_axes(self)
        there_from_ecef = enu_from_ecef_rotation(np.radians(latitude), np.radians(longitude))
        return np.asarray(there_from_ecef @ enu_from_ecef.T, dtype=np.float64)

    def grid_from_enu(self, point_enu: ArrayLike, epsg: int) -> FloatArray:
        """Rotation (3, 3) from this frame's axes to UTM grid axes (east, north, up) at a point (3,).

        True east, north, up at the point, turned about the vertical by the meridian convergence.

        Raises:
            GeodesyError: not a UTM code, or the point is too far from the zone.
        """
        point = _one_point(point_enu)
        latitude, longitude, _ = self.geodetic_from_enu(point)
        convergence = np.radians(meridian_convergence_deg(float(latitude), float(longitude), epsg))
        sin, cos = np.sin(convergence), np.cos(convergence)
        grid_from_true = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(grid_from_true @ self.true_enu_from_enu(point), dtype=np.float64)

    def _ecef_from_enu(self, enu: FloatArray) -> FloatArray:
        origin, rotation = _origin_and_axes(self)
        return np.asarray(enu @ rotation + origin, dtype=np.float64)


def _one_point(value: ArrayLike) -> FloatArray:
    points = as_points("LocalFrame point", value)
    if not points.single:
        raise InvalidValueError(f"LocalFrame: expected one point (3,), found shape {points.rows.shape}")
    point: FloatArray = points.rows[0]
    return point


@lru_cache(maxsize=256)
def _origin_and_axes(frame: LocalFrame) -> tuple[FloatArray, FloatArray]:
    """Geocentric origin (3,) in metres and rotation (3, 3) enu_from_ecef of a frame, read-only."""
    origin = ecef_from_geodetic(np.array([[frame.latitude_deg, frame.longitude_deg, frame.height_m]]))[0]
    rotation = enu_from_ecef_rotation(np.radians(frame.latitude_deg), np.radians(frame.longitude_deg))
    origin.setflags(write=False)
    rotation.setflags(write=False)
    return origin, rotation


@lru_cache(maxsize=64)
def _geodetic_of_point(frame: LocalFrame, east: float, north: float, up: float) -> tuple[float, ...]:
    """One point is asked for again and again: a pose needs its place, true axes and grid axes there."""
    return tuple(geodetic_from_ecef(frame._ecef_from_enu(np.array([[east, north, up]])))[0].tolist())
