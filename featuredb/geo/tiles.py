"""The store's tiles: squares of one UTM zone, half-open, so that each point lies in exactly one."""

import re

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import GeodesyError, InvalidValueError
from featuredb.geometry.arrays import FloatArray

# A power of two, so that dividing by it and multiplying with it are exact in float64 and the tile of a point
# and the bounds of the tile never disagree by a rounding. 512 m hold a street block with its surroundings:
# what one query's prior touches is one to four tiles.
TILE_SIZE_M = 512.0

_MIN_INDEX, _MAX_INDEX = -99_999, 999_999  # what six characters can hold
_MAX_TILES_TOUCHED = 1_000_000  # 512 km squared; more is a mistaken box, and would fill the memory
_TILE_PATTERN = re.compile(r"E(\d{6}|-\d{5})_N(\d{6}|-\d{5})", re.ASCII)


def tile_of(utm: ArrayLike) -> NDArray[np.str_]:
    """Names (n,) of the tiles in which points lie.

    A name such as "E001262_N010604" holds floor(easting / 512 m) and floor(northing / 512 m). Names sort as
    strings as their numbers do, for coordinates >= 0; a point of a northern zone just south of the equator
    has a negative northing and a name such as "E001262_N-00003", which is legal but sorts elsewhere.

    Args:
        utm: (n, 2) or (n, 3) float64 easting, northing (and height, unused) in metres.

    Raises:
        InvalidValueError: wrong shape or not finite.
        GeodesyError: so far off that it cannot be UTM.
    """
    indices = _tile_indices(utm)
    unique, inverse = np.unique(indices, axis=0, return_inverse=True)
    names = np.array([_name(int(e), int(n)) for e, n in unique], dtype="<U15")
    return names[np.asarray(inverse).reshape(-1)]


def tile_bounds(tile: str) -> tuple[float, float, float, float]:
    """Easting and northing (e0, n0, e1, n1) in metres of a tile: e0 <= e < e1 and n0 <= n < n1.

    Raises:
        InvalidValueError: not a tile's name.
    """
    match = _TILE_PATTERN.fullmatch(tile)
    if match is None:
        raise InvalidValueError(f"expected a tile's name such as 'E001262_N010604', found {tile!r}")
    east, north = int(match[1]) * TILE_SIZE_M, int(match[2]) * TILE_SIZE_M
    return east, north, east + TILE_SIZE_M, north + TILE_SIZE_M


def tiles_touching(e0: float, n0: float, e1: float, n1: float) -> list[str]:
    """Names of all tiles that hold a point of the closed box e0 <= e <= e1, n0 <= n <= n1, metres.

    In order of easting, then northing.

    Raises:
        InvalidValueError: the box is empty, not finite, or touches more than a million tiles.
        GeodesyError: so far off that it cannot be UTM.
    """
    (first_e, first_n), (last_e, last_n) = _tile_indices([[e0, n0], [e1, n1]]).tolist()
    if e1 < e0 or n1 < n0:
        raise InvalidValueError(
            f"tiles_touching: expected e0 <= e1 and n0 <= n1, found {e0}, {n0}, {e1}, {n1}; the order is "
            "(minimum easting, minimum northing, maximum easting, maximum northing)"
        )
    count = (last_e - first_e + 1) * (last_n - first_n + 1)
    if count > _MAX_TILES_TOUCHED:
        raise InvalidValueError(
            f"tiles_touching: the box {e0}, {n0}, {e1}, {n1} touches {count} tiles, more than "
            f"{_MAX_TILES_TOUCHED}; ask for a smaller area"
        )
    return [_name(e, n) for e in range(first_e, last_e + 1) for n in range(first_n, last_n + 1)]


def _tile_indices(utm: ArrayLike) -> NDArray[np.int64]:
    """(n, 2) int64 tile numbers, east then north, of points (n, 2+)."""
    points: FloatArray = np.asarray(utm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise InvalidValueError(f"tiles: expected points (n, 2) or (n, 3), found shape {points.shape}")
    plane = points[:, :2]
    if not np.isfinite(plane).all():
        raise InvalidValueError("tiles: expected finite eastings and northings, found NaN or infinity")
    # The inner floor keeps a denormal below zero below zero; over whole metres the division is exact.
    indices = np.floor(np.floor(plane) / TILE_SIZE_M)
    bad = ((indices < _MIN_INDEX) | (indices > _MAX_INDEX)).any(axis=1)
    if bad.any():
        raise GeodesyError(f"tiles: {plane[bad][0].tolist()} is no UTM easting and northing in metres")
    return indices.astype(np.int64)


def _name(east: int, north: int) -> str:
    return f"E{east:06d}_N{north:06d}"
