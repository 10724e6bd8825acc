"""Places: what lies together is drawn together, in one local frame.

The page computes in metres of a topocentric frame. Such a frame is level at its origin only, so maps that are
far from each other get one each, and the page shows one place at a time.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.store import UtmBox

# Over this distance the vertical turns by 0.18 degrees and the ground falls away by 31 m.
_TOGETHER_M = 20_000.0
# Of a scan that is larger than the maps, this much is shown around them.
SCAN_MARGIN_M = 50.0


Spot = tuple[FloatArray, int]  # where something lies: (3,) easting, northing, height in metres; the zone


def spot_of(box: UtmBox, epsg: int) -> Spot:
    """The middle of a box in plan, at its foot."""
    easting, northing = (box.min_easting + box.max_easting) / 2.0, (box.min_northing + box.max_northing) / 2.0
    return np.array([easting, northing, box.min_height]), epsg


def group(spots: Sequence[Spot]) -> list[tuple[LocalFrame, list[int]]]:
    """Places, the one with most spots first: frame at the middle of the spots, and their rows.

    Spots within 20 km of each other, directly or through others, are one place.
    """
    if not spots:
        return []
    (easting, northing, height), epsg = spots[0]
    frame = LocalFrame.from_utm(float(easting), float(northing), float(height), epsg)
    enu = np.array([frame.enu_from_utm(utm, epsg) for utm, epsg in spots])
    near = cKDTree(enu).query_pairs(_TOGETHER_M, output_type="ndarray")
    links = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(spots), len(spots)))
    count, label = connected_components(links, directed=False)
    places = [np.flatnonzero(label == k) for k in range(count)]
    places.sort(key=lambda rows: (-len(rows), int(rows[0])))
    return [(_frame_at(frame, enu[rows].mean(axis=0)), rows.tolist()) for rows in places]


def scan_box(
    frame: LocalFrame, boxes: Sequence[FloatArray], epsg: int
) -> tuple[float, float, float, float] | None:
    """(e0, n0, e1, n1) in the zone of a scan of what is shown of it: 50 m around the maps.

    Args:
        boxes: corners (2, 3) of each map's points in the place's frame; without any all of the scan is shown.
    """
    if not boxes:
        return None
    (e0, n0, up), (e1, n1, _) = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    around = [
        (e, n, up)
        for e in (e0 - SCAN_MARGIN_M, e1 + SCAN_MARGIN_M)
        for n in (n0 - SCAN_MARGIN_M, n1 + SCAN_MARGIN_M)
    ]
    utm = frame.utm_from_enu(np.array(around), epsg)
    low, high = utm.min(axis=0), utm.max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _frame_at(frame: LocalFrame, enu: FloatArray) -> LocalFrame:
    latitude, longitude, height = frame.geodetic_from_enu(enu)
    return LocalFrame(
        latitude_deg=float(latitude), longitude_deg=float(longitude), height_m=round(float(height), 3)
    )
