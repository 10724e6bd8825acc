"""Points for the page: as many as it draws smoothly, as float32 offsets and colours.

Which points: every map and scan orders its own by a permutation with a fixed seed and gives the first ones.
So the same database shows the same points, no part of a map is favoured, and the page can draw any first part
of what it has while the view moves.
"""

from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import ArrayLike, NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import MapPoints
from featuredb.store import Database
from featuredb.store.scans import ScanSummary, count_points, scan_points

_SEED = 0
_UTM = ("easting", "northing", "height")
_RGB = ("red", "green", "blue")
_GREY = 128  # of points that have neither colour nor intensity
# Points of a scan that are read to choose from; what a level beyond it would add is left out.
_MOST_READ = 20_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrawnPoints:
    """Points of one map or scan."""

    origin: FloatArray  # (3,) of the offsets, metres in the place's frame
    offsets: NDArray[np.float32]  # (n, 3) metres; any first k of them are a sample of all
    rgb: NDArray[np.uint8]  # (n, 3)
    of: int  # how many points there are

    def __len__(self) -> int:
        return len(self.offsets)

    def first(self, count: int) -> "DrawnPoints":
        """At most `count` of them."""
        return replace(self, offsets=self.offsets[:count], rgb=self.rgb[:count])

    def box(self) -> FloatArray:
        """Corners (2, 3), lowest and highest, around all but the strays that every reconstruction has.

        From the first to the last hundredth of the points along each axis, and a tenth more on each side;
        zeros where there are none.
        """
        if len(self) == 0:
            return np.zeros((2, 3))
        low, high = np.percentile(self.offsets.astype(np.float64), (1.0, 99.0), axis=0)
        margin = 0.1 * (high - low)
        return np.array([low - margin, high + margin]) + self.origin

    def packed(self) -> bytes:
        """Little-endian float32 x, y, z of all points, then red, green, blue of all, then zeros to a multiple
        of four bytes."""
        data = self.offsets.astype("<f4").tobytes() + self.rgb.tobytes()
        return data + bytes(-len(data) % 4)


def shares(wanted: ArrayLike, limit: int) -> NDArray[np.int64]:
    """How many of each group's points (k,) are drawn: all, or in proportion, at most `limit` together."""
    counts = np.array(wanted, dtype=np.int64)
    total = int(counts.sum())
    if total > limit:
        counts = counts * limit // total  # whole numbers: a rounded ratio loses a point
    return counts


def sampled(count: int, wanted: int) -> NDArray[np.int64]:
    """Rows (min(count, wanted),) of `count`, without order, the same ones each time."""
    order = np.random.default_rng(_SEED).permutation(count)
    return np.asarray(order[:wanted], dtype=np.int64)


def map_points(points: MapPoints, epsg: int, frame: LocalFrame, wanted: int) -> DrawnPoints:
    """At most `wanted` points of a map in the place's frame."""
    rows = sampled(len(points), wanted)
    return drawn_points(frame.enu_from_utm(points.utm[rows], epsg), points.rgb[rows], len(points))


def scan_points_in(
    database: Database,
    scan: ScanSummary,
    frame: LocalFrame,
    box: tuple[float, float, float, float] | None,  # (e0, n0, e1, n1), metres in its zone; None for all
    wanted: int,
) -> DrawnPoints:
    """At most `wanted` points of a scan: its coarsest levels of detail, of the last one a part.

    Raises:
        StoreError: the points cannot be read.
    """
    colour = _RGB if scan.colour else (("intensity",) if scan.has_intensity else ())
    utm, rgb, of, found = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)], 0, 0
    for level in range(len(scan.level_points)):
        count = count_points(database, scan, level, box)
        of += count
        if count == 0 or found >= wanted or of > _MOST_READ:
            continue
        table = scan_points(database, scan, level, box, (*_UTM, *colour))
        rows = sampled(len(table), wanted - found)
        found += len(rows)
        utm.append(np.stack([table[name].to_numpy()[rows] for name in _UTM], axis=1))
        rgb.append(_colours(table, colour)[rows])
    places, colours = np.concatenate(utm), np.concatenate(rgb)
    mixed = sampled(len(places), len(places))
    return drawn_points(frame.enu_from_utm(places[mixed], scan.epsg), colours[mixed], of)


def _colours(table: pa.Table, names: tuple[str, ...]) -> NDArray[np.uint8]:
    """(n, 3) of three columns, of one as grey, or of none."""
    if not names:
        return np.full((len(table), 3), _GREY, np.uint8)
    columns = [pc.fill_null(table[name], _GREY).to_numpy().astype(np.uint8) for name in names]
    return np.stack(columns * (3 // len(columns)), axis=1)


def drawn_points(enu: FloatArray, rgb: NDArray[np.uint8], of: int) -> DrawnPoints:
    """Points (n, 3) in the place's frame as they are drawn, of so many that there are."""
    origin = np.zeros(3) if len(enu) == 0 else np.round((enu.min(axis=0) + enu.max(axis=0)) / 2.0)
    return DrawnPoints(
        origin=origin,
        offsets=np.ascontiguousarray(enu - origin, dtype=np.float32),
        rgb=np.ascontiguousarray(rgb),
        of=of,
    )
