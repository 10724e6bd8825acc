"""Where a map lies on a scan near where it is said to be: its picture from above, then its heights.

The photos are laid out as one picture from straight above (`ingest.register.anchor.start.ortho`), which is
compared with the scan's at all places, headings and sizes that the placement leaves open. A map that is
tilted by some degrees looks the same from above; its points against the scan's surface tell tilt and height.
"""

from collections.abc import Sequence

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.start.from_ortho import PictureTry, ScanSearch
from ingest.register.anchor.start.ortho import OrthoPicture, picture_of_scan
from ingest.register.frame.dense.pictures import plan_spacing_m
from ingest.register.frame_registration import RenderSource

_REACH = 2.5  # standard deviations of the placement
_MOST_REACH_M = 100.0  # the scan is loaded to some 60 m around the map
_LEAST_REACH_M, _LEAST_TURN, _LEAST_SIZE = 5.0, np.radians(4.0), 0.02
_TURN_STEP, _SIZE_STEP = np.radians(2.0), 0.02  # three cells at the rim of the picture
_MOST_TRIES = 1000  # of sizes and headings
_MOST_CELLS = 700  # along the longer side of the part of the scan that is searched
_CELL = 0.7  # of the spacing of its points
_APART = 0.1  # of the picture: another place
_PLACES = 4
_WRONG_PLACES = 3  # of each right angle
_COVER = 0.3  # of the picture that the scan shows
_QUARTERS = (0.5 * np.pi, np.pi, 1.5 * np.pi)
_LEVEL_ROUNDS, _WEIGHT_ROUNDS = 2, 20  # of tilting the points, and of Cauchy's weights
_LEAST_POINTS = 30
_LEAST_M = 1e-3


def starts_from_above(
    feature_map: FeatureMap, picture: OrthoPicture, cloud: PointCloud, source: RenderSource
) -> tuple[list[Sim3], list[Sim3]]:
    """Similarities of a map's frame under which it looks like the scan from above.

    Args:
        picture: of the map, in its frame.
        cloud: the scan around the map, in the map's frame.

    Returns:
        The places within what the placement leaves open, apart from each other, best first; none where that
        is too much. And the best few of those that are turned by one, two and three right angles: streets of
        most towns are square to each other, so these agree as wrong places do.
    """
    points = feature_map.points_local(cloud.frame)
    reach_m, turn, size = _left_open(feature_map, picture)
    low, high = _around(picture, reach_m)
    cell_m = max(float((high - low).max()) / _MOST_CELLS, _CELL * plan_spacing_m(cloud))
    drawn = picture_of_scan(cloud, source, cell_m, (low, high))
    sizes = picture.cell * np.exp(_steps(size, _SIZE_STEP))
    turns = _steps(turn, _TURN_STEP).tolist()
    if not drawn.valid.any() or len(sizes) * len(turns) > _MOST_TRIES:
        return [], []
    search = ScanSearch(drawn, _COVER)
    height = float(np.median(picture.height[picture.valid]))  # about as it is

    def best(around: float) -> list[Sim3]:
        """Similarities, best first, with headings about one."""
        found = [search.best(picture, one, around + angle) for one in sizes.tolist() for angle in turns]
        tries = sorted((one for one in found if one is not None), key=lambda one: -one.correlation)
        return [
            _levelled(one.similarity(picture, height), points, drawn) for one in _distinct(tries, picture)
        ]

    quarters = _QUARTERS if turn < 0.5 * _QUARTERS[0] else ()
    return best(0.0), [one for quarter in quarters for one in best(quarter)[:_WRONG_PLACES]]


def _left_open(feature_map: FeatureMap, picture: OrthoPicture) -> tuple[float, float, float]:
    """How far the map may be off: metres in plan, radians of heading, logarithm of its size."""
    covariance = feature_map.placement.covariance
    middle = np.array([*picture.middle, float(np.median(picture.height[picture.valid]))])
    jacobian = point_jacobian(middle[None])[0]
    plan = (jacobian @ covariance @ jacobian.T)[:2, :2]
    sigmas = np.sqrt([np.linalg.eigvalsh(plan)[-1], covariance[3, 3], covariance[0, 0]])
    reach, turn, size = np.maximum(_REACH * sigmas, [_LEAST_REACH_M, _LEAST_TURN, _LEAST_SIZE]).tolist()
    return min(reach, _MOST_REACH_M), min(turn, float(np.pi)), size


def _steps(reach: float, step: float) -> FloatArray:
    count = int(np.ceil(reach / step))
    return np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)


def _around(picture: OrthoPicture, reach_m: float) -> tuple[FloatArray, FloatArray]:
    """Least and largest x and y of where the map may lie, however it is turned."""
    rows, columns = np.nonzero(picture.valid)
    corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    middle = picture.corner + picture.cell * corners.mean(axis=0)
    half = 0.5 * picture.cell * float(np.linalg.norm(corners[1] - corners[0])) + reach_m
    return np.asarray(middle - half, np.float64), np.asarray(middle + half, np.float64)


def _distinct(tries: Sequence[PictureTry], picture: OrthoPicture) -> list[PictureTry]:
    """The first of those that lie apart from every better one."""
    kept: list[PictureTry] = []
    apart = _APART * picture.cell * max(picture.gray.shape)
    for one in tries:
        if all(float(np.linalg.norm(one.middle - other.middle)) > apart for other in kept):
            kept.append(one)
        if len(kept) == _PLACES:
            break
    return kept


def _levelled(new_from_old: Sim3, points: FloatArray, scan: OrthoPicture) -> Sim3:
    """Tilted and lifted until the points (n, 3) lie on the scan's surface, most of them."""
    for _ in range(_LEVEL_ROUNDS):
        placed = new_from_old.act(points)
        lack = _surface(scan, placed[:, :2]) - placed[:, 2]
        there = np.isfinite(lack)
        if there.sum() < _LEAST_POINTS:
            break
        placed, lack = placed[there], lack[there]
        middle = np.median(placed, axis=0)
        rows = np.column_stack([np.ones(len(lack)), placed[:, :2] - middle[:2]])
        plane = np.array([float(np.median(lack)), 0.0, 0.0])
        for _ in range(_WEIGHT_ROUNDS):
            off = lack - rows @ plane
            weight = 1.0 / (1.0 + (off / (1.4826 * np.median(np.abs(off)) + _LEAST_M)) ** 2)
            root = np.sqrt(weight)
            plane = np.linalg.lstsq(rows * root[:, None], root * lack)[0]
        turn = so3_exp([plane[2], -plane[1], 0.0])
        lifted = middle + np.array([0.0, 0.0, plane[0]])
        new_from_old = Sim3(scale=1.0, rotation=turn, translation=lifted - turn @ middle) @ new_from_old
    return new_from_old


def _surface(scan: OrthoPicture, plan: FloatArray) -> FloatArray:
    """Heights (n,) of the scan at places (n, 2); NaN where it shows nothing."""
    cells = np.floor((plan - scan.corner) / scan.cell).astype(np.int64)
    inside = np.asarray(((cells >= 0) & (cells < scan.gray.shape[::-1])).all(axis=1))
    columns, rows = np.where(inside[:, None], cells, 0).T
    known = inside & scan.valid[rows, columns]
    return np.asarray(np.where(known, scan.height[rows, columns], np.nan))
