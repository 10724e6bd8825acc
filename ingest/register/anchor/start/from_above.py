"""A map without a place, found on a scan of some hundred metres by what both show from above.

The scan is drawn from above, side by side. Features of these pictures have places on the scan, those of the
map have points of its frame: where they match, a similarity takes the one to the other. How sure that is: the
expected number of similarities that as many chance matches would fit as well (a-contrario; Moulon, Monasse,
Marlet 2012).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray, joined
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian, similarity_closed_form
from featuredb.index.nearest import nearest
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering, render
from ingest.register.frame.features.matching import pool_features
from ingest.register.frame.views import FEATURES_SPACING_PX, MIN_COVER, available_sources
from ingest.register.frame_registration import RenderSource
from reloc.localise.acceptance import log_nfa

_SIDE_PX = 1000  # of a picture from above; the next one overlaps it by half
_VIEWS = 8  # along a side, at most; fewer where the scan's points show no more
_MOST_DESCRIPTORS = 30_000  # of the map: more say the same again, and take longer
_NEIGHBOURS = 8  # one point of the map has a descriptor in each photo: the next point must be among them
_MAX_RATIO = 0.85  # as localisation has it
_SAMPLE = 3
_BATCH, _BATCHES = 2000, 50  # samples of three: with 5 % of right matches a dozen of them is all right
_MISSED = 1e-3  # chance that no sample was all right, below which no more are drawn
_SCORED = 300  # matches that score a sample
_TOLERANCES_PX = (8.0, 16.0, 32.0)  # of the pictures; the one that says most is taken, and three are paid for
_MIN_LOG_NFA = 3.0  # one map of a thousand would be proposed where it is not
_ROUNDS = 5  # of matches within the tolerance and the similarity that fits them
_CORRELATED = 4.0  # matches that are worth one independent: neighbours share relief and the map's bend


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundPlace:
    """Where a map may lie on a scan; a start for the registration of its photos.

    Attributes:
        local_from_own: similarity. covariance: (7, 7) of its left perturbation.
        evidence: how much more than chance speaks for it: a figure that only places of the same search share.
        sure: whether that is enough to say that the map lies here; else it may be tried.
        words: on the evidence, for people.
    """

    local_from_own: Sim3
    covariance: FloatArray
    evidence: float
    sure: bool
    words: str


def found_from_above(unplaced: UnplacedMap, cloud: PointCloud) -> FoundPlace | None:
    """The best place of a map on all of a scan; None where nothing of both matches.

    Its evidence is minus the decimal logarithm of the number of as good ones that chance gives.
    """
    found = [_found(unplaced, cloud, source) for source in available_sources(cloud) if source != "shaded"]
    return max((one for one in found if one is not None), key=lambda one: one.evidence, default=None)


def _found(unplaced: UnplacedMap, cloud: PointCloud, source: RenderSource) -> FoundPlace | None:
    # A picture shows as much as is as fine as the scan's points are dense, in no more than so many pictures.
    plan = np.ptp(cloud.xyz[:, :2], axis=0)
    spacing = float(np.sqrt(np.prod(plan) / len(cloud)))
    wide_m = max(_SIDE_PX * spacing / FEATURES_SPACING_PX, 2.0 * float(plan.max()) / _VIEWS)
    if wide_m <= 0.0:  # a single point
        return None
    pools = [pool_features(view, source, upright=False) for view in _views(cloud, wide_m)]
    if not pools:
        return None
    pool = joined(pools)
    point, place = _matched(unplaced, pool.descriptors)
    if len(point) <= _SAMPLE:
        return None
    own, local = unplaced.points.xyz[point], pool.points[place]
    centers = np.array([image.cam_from_local.center for image in unplaced.images])
    upwards = np.median(centers, axis=0) - np.median(unplaced.points.xyz, axis=0)
    area_m2 = float(np.prod(np.ptp(pool.points[:, :2], axis=0)))
    judged = []
    for tolerance_m in (px * wide_m / _SIDE_PX for px in _TOLERANCES_PX):
        sim = _most_fitting(own, local, upwards, tolerance_m)
        judged.append(_judged(sim, own, local, upwards, point, tolerance_m, area_m2, source))
    return max((one for one in judged if one is not None), key=lambda one: one.evidence, default=None)


def _views(cloud: PointCloud, wide_m: float) -> Iterator[Rendering]:
    """The scan from above, north up, from as high as it is wide."""
    camera = Camera.from_focal(_SIDE_PX, _SIDE_PX, float(_SIDE_PX), model="PINHOLE")
    low, high = (np.asarray(of, dtype=np.float64) for of in (cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)))
    top = float(np.median(cloud.xyz[:, 2])) + wide_m
    for east in np.arange(low[0], high[0] + wide_m / 2, wide_m / 2):
        for north in np.arange(low[1], high[1] + wide_m / 2, wide_m / 2):
            pose = Rigid3.from_center(np.diag([1.0, -1.0, -1.0]), np.array([east, north, top]))
            view = render(cloud, camera, pose)
            if view.valid.mean() >= MIN_COVER:
                yield view


def _matched(
    unplaced: UnplacedMap, descriptors: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Points of the map and rows of `descriptors` (n, 128) that match: the next point looks less like it."""
    observations = unplaced.observations
    step = -(-len(observations.point_index) // _MOST_DESCRIPTORS)
    squared, row = nearest(descriptors, observations.descriptors[::step], _NEIGHBOURS)
    point = observations.point_index[::step][row]
    others = (point != point[:, :1]) & (row >= 0)
    other = squared[np.arange(len(row)), np.where(others.any(axis=1), others.argmax(axis=1), -1)]
    kept = np.flatnonzero((squared[:, 0] < _MAX_RATIO**2 * other) & (row[:, 0] >= 0))
    return point[kept, 0].astype(np.int64), kept


def _most_fitting(own: FloatArray, local: FloatArray, upwards: FloatArray, tolerance_m: float) -> Sim3 | None:
    """Of similarities of three matches that which takes most of own (n, 3) to local (n, 3).

    Cameras must lie above the map's points: `upwards` (3,) from these.
    """
    rng = np.random.default_rng(0)
    scored = rng.permutation(len(own))[:_SCORED]
    wide = float(np.median(np.linalg.norm(own - np.median(own, axis=0), axis=1)))  # a dot fits any spot
    best, most = None, 0
    for batch in range(1, _BATCHES + 1):
        rows = rng.integers(0, len(own), (_BATCH, _SAMPLE))
        scale, rotation, translation, usable = _similarities(own[rows], local[rows])
        usable &= (rotation[:, 2] @ upwards > 0.0) & (scale * wide > tolerance_m)
        if usable.any():
            scale, rotation, translation = scale[usable], rotation[usable], translation[usable]
            off = (scale[:, None, None] * rotation).reshape(-1, 3) @ own[scored].T
            off = (off + translation.reshape(-1, 1)).reshape(-1, 3, len(scored)) - local[scored].T
            fitting = (np.square(off).sum(axis=1) <= tolerance_m**2).sum(axis=1)
            k = int(fitting.argmax())
            if fitting[k] > most:
                most = int(fitting[k])
                best = Sim3(scale=float(scale[k]), rotation=rotation[k], translation=translation[k])
        right = (most / len(scored)) ** _SAMPLE
        if batch * _BATCH * np.log1p(-min(right, 1.0 - 1e-12)) < np.log(_MISSED):
            break
    return best


def _similarities(
    source: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Umeyama's solution for k sets of m pairs (k, m, 3) at once.

    Scale (k,), rotation (k, 3, 3), translation (k, 3), and which sets determine them (k,).
    """
    source_mean, target_mean = source.mean(axis=1), target.mean(axis=1)
    a, b = source - source_mean[:, None], target - target_mean[:, None]
    u, values, vt = np.linalg.svd(np.swapaxes(b, 1, 2) @ a)
    sign = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    values[:, 2] *= sign
    u[:, :, 2] *= sign[:, None]
    rotation = u @ vt
    variance = (a**2).sum(axis=(1, 2))
    scale = values.sum(axis=1) / np.where(variance > 0, variance, 1.0)
    # Collinear points leave the rotation about their line open.
    usable = (variance > 1e-12) & (values[:, 1] > 1e-3 * values[:, 0]) & (scale > 0)
    translation = target_mean - scale[:, None] * np.einsum("kij,kj->ki", rotation, source_mean)
    return scale, rotation, translation, usable


def _judged(
    sim: Sim3 | None,
    own: FloatArray,
    local: FloatArray,
    upwards: FloatArray,
    point: NDArray[np.int64],
    tolerance_m: float,
    area_m2: float,
    source: RenderSource,
) -> FoundPlace | None:
    """Fitted to the matches within the tolerance, with how sure that is; None where too few are.

    The fit may turn a place over flat ground upside down: None, too, where it leaves cameras underground.

    Args:
        own, local: (n, 3) points of the map and of the scan that match. upwards: as in `_most_fitting`.
        point: (n,) the map's points. area_m2: of the scan in plan.
    """
    for _ in range(_ROUNDS):
        if sim is None:
            return None
        fits = np.linalg.norm(sim.act(own) - local, axis=1) <= tolerance_m
        if fits.sum() <= _SAMPLE:
            return None
        sim = similarity_closed_form(own[fits], local[fits])
    if sim is None or sim.rotation[2] @ upwards <= 0.0:
        return None
    placed = sim.act(own[fits])
    variance = float(np.square(placed - local[fits]).sum()) / (3.0 * int(fits.sum()) - 7.0)
    jacobian = point_jacobian(placed).reshape(-1, 7)
    matches = len(np.unique(point))
    spots = np.unique(np.floor(local[fits, :2] / tolerance_m), axis=0)
    fitting = min(len(np.unique(point[fits])), len(spots))
    evidence = log_nfa(matches, fitting, tolerance_m, area_m2, 1.0, _SAMPLE)
    evidence -= float(np.log10(len(_TOLERANCES_PX)))
    return FoundPlace(
        local_from_own=sim,
        covariance=np.asarray(_CORRELATED * variance * np.linalg.inv(jacobian.T @ jacobian)),
        evidence=evidence,
        sure=evidence >= _MIN_LOG_NFA,
        words=f"{fitting} of {matches} matches with the scan's {source} fit one place to within "
        f"{tolerance_m:.1f} m",
    )
