"""Small LAS and LAZ files of every kind, written by laspy itself and not by our own writer."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from numpy.typing import NDArray
from pyproj import CRS

WEST, SOUTH = 500_000.0, 5_000_000.0  # on the central meridian of zone 32, at 45.15 degrees north


def wkt_of(crs: str) -> str:
    """WKT as LAS 1.4 wants it."""
    return str(CRS.from_user_input(crs).to_wkt("WKT1_GDAL"))


def grid_points(count: int = 3000, seed: int = 0, spacing: float = 0.5) -> NDArray[np.float64]:
    """(n, 3) points of a rolling surface, jittered around a grid that starts at (WEST, SOUTH)."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    east, north = np.divmod(np.arange(count), side)
    plan = np.stack([east, north], axis=1) * spacing + rng.uniform(-0.1, 0.1, (count, 2)) * spacing
    height = 100.0 + np.sin(plan[:, 0] / 9.0) + np.cos(plan[:, 1] / 7.0)
    return np.column_stack([plan + np.array([WEST, SOUTH]), height])


def write_scan(
    path: Path,
    xyz: NDArray[np.float64],
    *,
    crs: str | None = "EPSG:32632",
    version: str = "1.4",
    point_format: int = 7,
    scale: float = 0.001,
    **columns: Any,
) -> Path:
    """Write points; `columns` by laspy's names (intensity, classification, withheld, red, ...)."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = np.full(3, scale), np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    if crs is not None:
        header.vlrs.append(WktCoordinateSystemVlr(wkt_of(crs) if ":" in crs else crs))
        header.global_encoding.wkt = version == "1.4"
    las = laspy.LasData(header)
    if len(xyz):
        las.x, las.y, las.z = xyz.T
    for name, value in columns.items():
        las[name] = value
    las.write(path)
    return path
