"""How a map moves when it is placed anew, and how it lies on a scan."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_log
from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud

_MAX_POINTS = 20_000  # of a map; more say nothing new of it
_PLAN_REACH_M = 2.0  # a map point with no scan this near in plan lies over a hole or beyond the border


@dataclass(frozen=True, slots=True, kw_only=True)
class MapMove:
    """The similarity between two placements of a map, about the middle of its points.

    Attributes:
        horizontal_m, up_m: of the middle.
        heading_deg, tilt_deg: turns about the vertical, and about a horizontal axis.
        scale: new metres per old metre.
        horizontal_sigmas, heading_sigmas, tilt_sigmas, scale_sigmas: in standard deviations of the old
            placement.
    """

    horizontal_m: float
    up_m: float
    heading_deg: float
    tilt_deg: float
    scale: float
    horizontal_sigmas: float
    heading_sigmas: float
    tilt_sigmas: float
    scale_sigmas: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapResidual:
    """How a map lies on a scan.

    Attributes:
        distance_m: (k,) from each map point that has scan around it to the nearest scan point.
        points: of the map, all.
    """

    distance_m: FloatArray
    points: int

    @property
    def median_m(self) -> float:
        """NaN where nothing could be compared."""
        return float(np.median(self.distance_m)) if len(self.distance_m) else float("nan")

    def as_figures(self) -> dict[str, float]:
        """JSON-able."""
        if not len(self.distance_m):
            return {"points": self.points, "compared": 0}
        p50, p90 = np.percentile(self.distance_m, (50, 90))
        return {
            "points": self.points,
            "compared": len(self.distance_m),
            "median_m": float(p50),
            "p90_m": float(p90),
        }


def map_move(old: FeatureMap, new: FeatureMap) -> MapMove:
    """From the placements of the same map in one local frame."""
    move = new.placement.local_from_sfm @ old.placement.local_from_sfm.inverse()
    turn = so3_log(move.rotation)
    middle = np.median(old.points_local(), axis=0)
    shift = move.act(middle) - middle
    covariance = old.placement.covariance
    jacobian = point_jacobian(middle)
    spread = jacobian @ covariance @ jacobian.T
    heading, tilt = float(abs(turn[2])), float(np.hypot(turn[0], turn[1]))
    return MapMove(
        horizontal_m=float(np.hypot(shift[0], shift[1])),
        up_m=float(shift[2]),
        heading_deg=float(np.degrees(turn[2])),
        tilt_deg=float(np.degrees(tilt)),
        scale=move.scale,
        horizontal_sigmas=float(np.hypot(*shift[:2]) / np.sqrt(np.linalg.eigvalsh(spread[:2, :2])[-1])),
        heading_sigmas=heading / float(np.sqrt(covariance[3, 3])),
        tilt_sigmas=tilt / float(np.sqrt(max(covariance[1, 1], covariance[2, 2]))),
        scale_sigmas=abs(float(np.log(move.scale))) / float(np.sqrt(covariance[0, 0])),
    )


def map_residuals(old: FeatureMap, new: FeatureMap, cloud: PointCloud) -> tuple[MapResidual, MapResidual]:
    """Distances of the same map points from the scan, before and after.

    Compared are the points that have scan around them in plan at the new place: elsewhere the scan has a
    hole, and the distance to its rim says nothing.
    """
    step = max(1, len(old.points) // _MAX_POINTS)
    before = old.points_local(cloud.frame)[::step]
    after = new.points_local(cloud.frame)[::step]
    low = np.minimum(before.min(axis=0), after.min(axis=0))[:2] - _PLAN_REACH_M
    high = np.maximum(before.max(axis=0), after.max(axis=0))[:2] + _PLAN_REACH_M
    near = ((cloud.xyz[:, :2] >= low) & (cloud.xyz[:, :2] <= high)).all(axis=1)
    scan = cloud.xyz[near].astype(np.float64)
    in_plan, _ = cKDTree(scan[:, :2]).query(after[:, :2], distance_upper_bound=_PLAN_REACH_M)
    compared = np.isfinite(in_plan)
    tree = cKDTree(scan)
    first, second = (
        MapResidual(distance_m=np.asarray(tree.query(points[compared])[0]), points=len(old.points))
        for points in (before, after)
    )
    return first, second
