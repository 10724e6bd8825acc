"""Whether a grown map lies where the scans in store have the ground and the roofs.

A grown map says how far off it may be: where a scan covers it, the rigid motion that brings the map's points
onto the scan's surface must be no larger than that.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import MissingExtraError, ScanError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp, so3_log
from featuredb.geometry.sim3 import point_jacobian
from featuredb.lidar.load import load_cloud
from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from featuredb.store import Database
from featuredb.store.tables import LIDAR
from ingest.growth.gates import SIGMAS, Gate, sigmas_limit
from ingest.growth.map_places import growth_of, place_sigmas_m, with_growth
from ingest.growth.place.component import GrownMap
from ingest.growth.values import LEAST_PHOTOS, MAD, Refused
from ingest.register.structure.surface_fit import MIN_REACH_M, Surface, nearest_planes, reach_of, surface_near

NOT_ASKED = "SCAN_NOT_ASKED"  # reason of a gate that another installation may pass

_LOG = logging.getLogger(__name__)
# Metres of a fit, in turn; 0: `SIGMAS`.
_NARROW, _WIDE_TO_NARROW = 0.0, (MIN_REACH_M, MIN_REACH_M / 2, MIN_REACH_M / 4, 0.0)
_ROUNDS = 5  # of nearest planes, each cut
_OPEN = np.diag([1.0] * 3 + [1e-8] * 3)  # 1 rad and 10 km: what nothing holds
_LEAST_POINTS, _MOST_POINTS = 100, 8000  # over the scan; fewer decide nothing, more say nothing new
_SCAN_SIGMA_M = 0.1  # of a scan on Earth, per axis: what airborne scans promise
_CELL_M = 5.0  # points of one patch of roof are off together; a cell of this size counts as one
# Of the points over the scan, those within its reach. Honest maps have 0.4 and more, maps that float or are
# sunk by 10 m up to 0.15. It is asked only of maps whose claim is smaller than the reach.
_LEAST_NEAR = 0.1
_MARGIN_M = 20.0  # of scan around the map
# Of the squared distances, by which a far place must lie better than the one nearby: flat ground lies
# anywhere, and a fit from afar slides.
_LEAST_GAIN = 0.1


def checked_by_scan(database: Database, grown: GrownMap) -> tuple[GrownMap | Refused, str]:
    """The map with the gate in its evidence, or its refusal; and why a scan could not be compared, or "".

    Raises:
        StoreError: the scans cannot be read.
    """
    feature_map = grown.feature_map
    points = _points(feature_map) if database.has(LIDAR) else np.zeros((0, 3))
    if len(points) < _LEAST_POINTS:
        return grown, ""
    low, high = points[:, :2].min(axis=0) - _MARGIN_M, points[:, :2].max(axis=0) + _MARGIN_M
    gate, why = None, ""
    try:
        cloud = load_cloud(database, feature_map.frame, (*low.tolist(), *high.tolist()))
        if len(cloud.xyz) and cloud.height_datum != feature_map.height_datum:
            why = f"its heights are {feature_map.height_datum}, theirs {cloud.height_datum}"
        elif len(cloud.xyz):
            gate = cloud_gate(cloud, points, feature_map.placement.covariance)
    except MissingExtraError as error:
        text = f"a scan is there that could not be asked; it waits until it can be ({error})"
        gate = replace(_gate(np.inf, ""), reason=NOT_ASKED, message=text)
    except ScanError as error:  # heights of several datums
        why = str(error)
    if why:
        why = f"map {feature_map.map_id} was not compared with the scans in store: {why}"
        _LOG.warning("%s", why)
    if gate is None:
        return grown, why
    if not gate.passes:
        return Refused.by(gate, *grown.placement.gates), ""
    told = {**growth_of(feature_map.placement.evidence).get("gates", {}), gate.name: gate.as_json()}
    return replace(grown, feature_map=with_growth(feature_map, gates=told)), ""


def cloud_gate(cloud: PointCloud, points: FloatArray, covariance: FloatArray) -> Gate | None:
    """The gate for points (n, 3) in the cloud's local frame, of a placement with that covariance (7, 7)."""
    surface = surface_near(cloud, points)
    if surface is None:
        return None
    over = points[_over_scan(surface, points)]
    if len(over) < _LEAST_POINTS:
        return None
    reach = reach_of(surface)
    near = np.isfinite(nearest_planes(surface, over, reach)[0])
    middle = over.mean(axis=0)
    claimed_m = SIGMAS * float(np.hypot(place_sigmas_m(covariance, middle[None])[0], _SCAN_SIGMA_M))
    if near.mean() < _LEAST_NEAR:
        if claimed_m > reach:
            return None
        return _gate(np.inf, f"{near.mean():.0%} of its points lie within {reach:.1f} m of the scan")
    laid = _Laid(surface=surface, points=over, middle=middle)
    here, there = laid.fitted((_NARROW,)), laid.fitted(_WIDE_TO_NARROW)
    sigma = laid.sigma_m(there)
    gain = 1.0 - laid.cost(there, sigma) / max(laid.cost(here, sigma), 1e-9)
    best = there if gain > _LEAST_GAIN else here
    shift_m = float(np.linalg.norm(best.act(middle) - middle))
    text = f"it would have to move by {shift_m:.2f} m to lie on the scan"
    chi2 = laid.chi_square(best, covariance, sigma)
    return _gate(chi2, f"{text}; its placement allows {claimed_m:.2f} m")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Laid:
    """Points (n, 3) laid on a surface; motions are rigid, in the cloud's local frame."""

    surface: Surface
    points: FloatArray
    middle: FloatArray

    def residuals(self, move: Rigid3) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Distances (n,) from the planes, normals (n, 3), places (n, 3)."""
        moved = move.act(self.points)
        return *nearest_planes(self.surface, moved, np.inf), moved

    def sigma_m(self, move: Rigid3) -> float:
        """Standard deviation of those distances that are not of something else."""
        distance = np.abs(self.residuals(move)[0])
        return max(MAD * float(np.median(distance)), 0.02)  # below is the scan's own noise

    def weights(self, places: FloatArray) -> FloatArray:
        """(n,) such that the points of one cell weigh one together."""
        cells = np.floor(places / _CELL_M).astype(np.int64)
        _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        return np.asarray(1.0 / count[cell.reshape(-1)])

    def cost(self, move: Rigid3, sigma_m: float) -> float:
        """Truncated squares of the distances."""
        distance, _, _ = self.residuals(move)
        return float((self.weights(self.points) * np.minimum((distance / sigma_m) ** 2, SIGMAS**2)).sum())

    def normal_equations(self, move: Rigid3, cut_m: float, sigma_m: float) -> tuple[FloatArray, FloatArray]:
        """Information (6, 6) and gradient (6,) of turn and shift at the middle."""
        distance, normals, places = self.residuals(move)
        good = np.abs(distance) < cut_m
        arm = places[good] - move.act(self.middle)
        rows = np.concatenate([np.cross(arm, normals[good]), normals[good]], axis=1)
        weight = self.weights(places[good]) / sigma_m**2
        return np.asarray(rows.T @ (weight[:, None] * rows)), np.asarray(rows.T @ (weight * distance[good]))

    def fitted(self, cuts: Sequence[float]) -> Rigid3:
        """Point to plane from where the points are; each cut (metres; 0: three sigma) in turn."""
        move = Rigid3.identity()
        for cut in cuts:
            for _ in range(_ROUNDS):
                sigma = self.sigma_m(move)
                information, gradient = self.normal_equations(move, cut or SIGMAS * sigma, sigma)
                step = -np.linalg.solve(information + _OPEN, gradient)
                at = move.act(self.middle)
                turn = so3_exp(step[:3])
                move = Rigid3(rotation=turn, translation=at + step[3:] - turn @ at) @ move
        return move

    def chi_square(self, move: Rigid3, covariance: FloatArray, sigma_m: float) -> float:
        """Of the motion against what the placement (7, 7), the scan and the fit leave open."""
        at_middle = np.concatenate([np.eye(7)[1:4], point_jacobian(self.middle)])  # turn and shift there
        information, _ = self.normal_equations(move, SIGMAS * sigma_m, sigma_m)
        allowed = at_middle @ covariance @ at_middle.T + np.linalg.inv(information + _OPEN)
        # What the scan may be off differs from one end of the map to the other.
        half = float(np.percentile(np.linalg.norm(self.points - self.middle, axis=1), 90.0))
        allowed += np.diag([1.0 / half**2] * 3 + [1.0] * 3) * _SCAN_SIGMA_M**2
        delta = np.concatenate([so3_log(move.rotation), move.act(self.middle) - self.middle])
        return float(delta @ np.linalg.solve(allowed, delta))


def _gate(chi2: float, what: str) -> Gate:
    limit = sigmas_limit(6)
    message = f"{what} (chi-square {chi2:.1f}, {limit:.1f} allowed); it waits until maps and scan agree"
    return Gate.at_most("scan", "CONTRADICTS_SCAN", chi2, limit, message)


def _points(feature_map: FeatureMap) -> FloatArray:
    """Points (n, 3) that enough photos see; single far ones would load a county of scan."""
    views = np.bincount(feature_map.observations.point_index, minlength=len(feature_map.points))
    points = feature_map.points_local()[views >= LEAST_PHOTOS]
    if not len(points):
        return points
    low, high = np.percentile(points, (1.0, 99.0), axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    return np.asarray(inside[:: -(-max(len(inside), 1) // _MOST_POINTS)])


def _over_scan(surface: Surface, points: FloatArray) -> NDArray[np.bool_]:
    """Points with scan around them in plan: elsewhere there is a hole, and its rim says nothing."""
    cell_m = max(MIN_REACH_M, 2.0 * surface.spacing_m)

    def cells(xyz: FloatArray) -> NDArray[np.int64]:
        rows = np.floor(xyz[:, :2] / cell_m).astype(np.int64)
        return np.asarray(rows[:, 0] * (1 << 32) + rows[:, 1])

    return np.isin(cells(points), cells(surface.points + surface.middle))
