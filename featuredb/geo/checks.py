"""Checks of coordinate arrays before they meet PROJ, which answers nonsense by infinity or by a number."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geometry.arrays import FloatArray


class Points(NamedTuple):
    """Points as rows, and whether the caller gave a single one without the row axis."""

    rows: FloatArray
    single: bool

    def shaped_like_input(self, rows: FloatArray) -> FloatArray:
        return np.asarray(rows[0] if self.single else rows, dtype=np.float64)


def check_place(name: str, latitude_deg: float, longitude_deg: float) -> None:
    """
    Raises:
        InvalidValueError: no latitude in [-90, 90] and longitude in [-180, 180] degrees.
    """
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):  # false for NaN too
        raise InvalidValueError(
            f"{name}: expected latitude in [-90, 90] and longitude in [-180, 180] degrees, found "
            f"{latitude_deg}, {longitude_deg}"
        )


def as_points(name: str, value: ArrayLike) -> Points:
    """Rows (n, 3) float64 of an array (n, 3) or of one point (3,).

    Raises:
        InvalidValueError: another shape, not numbers, NaN or infinity.
    """
    try:
        array: Any = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(
            f"{name}: expected numbers of shape (n, 3) or (3,), found {value!r}"
        ) from error
    if array.ndim not in (1, 2) or array.shape[-1] != 3:
        raise InvalidValueError(f"{name}: expected shape (n, 3) or (3,), found {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidValueError(f"{name}: expected finite numbers, found NaN or infinity")
    return Points(rows=np.atleast_2d(array), single=array.ndim == 1)


def as_geodetic(name: str, value: ArrayLike) -> Points:
    """As `as_points`, and each row is a latitude in [-90, 90] and a longitude in [-180, 180] degrees.

    Raises:
        GeodesyError: out of range, for example because the order is longitude, latitude or because it is UTM.
    """
    points = as_points(name, value)
    bad = (np.abs(points.rows[:, 0]) > 90.0) | (np.abs(points.rows[:, 1]) > 180.0)
    if bad.any():
        raise GeodesyError(
            f"{name}: expected rows of latitude in [-90, 90], longitude in [-180, 180] degrees and height in "
            f"metres, found {points.rows[bad][0].tolist()}; check the order of the columns"
        )
    return points


def as_utm(name: str, value: ArrayLike) -> Points:
    """As `as_points`, and no row looks like degrees.

    A point with both |easting| and |northing| of at most 360 m would lie 500 km from its central meridian and
    on the equator: nobody's map, but what latitude and longitude look like when they are taken for UTM.

    Raises:
        GeodesyError: a row looks like degrees.
    """
    points = as_points(name, value)
    bad = (np.abs(points.rows[:, :2]) <= 360.0).all(axis=1)
    if bad.any():
        raise GeodesyError(
            f"{name}: expected easting, northing and height in metres, found {points.rows[bad][0].tolist()}, "
            "which look like degrees; transform them to this zone"
        )
    return points
