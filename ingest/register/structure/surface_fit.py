"""How a placed map lies on the scan's surface: point-to-plane distances, and GICP under a guard."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import MissingExtraError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.render.cloud import PointCloud


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceFitOptions:
    """The scan's surface as the comparison sees it, and what GICP may do.

    Attributes:
        max_surface_points: coarser levels of detail are taken until the scan under the map has no more;
            bounds the time.
        margin_m: of the scan around the map's points.
        neighbours: of which a plane is made.
        reach_spacings: a map point further from the scan than this many spacings has no scan there.
        min_reach_m: but never less: a map that is off by so much is still compared.
        gicp: whether GICP is tried at all.
        gicp_rounds: of nearest neighbours.
        max_gicp_points: of the map, evenly chosen; six parameters need no more.
        min_gain: share by which GICP must lower the median distance; less is chance: on maps of the
            simulated town that GICP moved for a gain of a few percent, points were 0.056 m off instead of
            0.052.
        max_move_sigmas: how far it may move the evidence, in standard deviations of the placement there.
        min_move_m: a move below the scan's own noise is always allowed.
        threads: of small_gicp. Its threads are OpenMP's, after which a process should not fork.
    """

    max_surface_points: int = 60_000
    margin_m: float = 5.0
    neighbours: int = 8
    reach_spacings: float = 4.0
    min_reach_m: float = 2.0
    gicp: bool = True
    gicp_rounds: int = 20
    max_gicp_points: int = 4000
    min_gain: float = 0.1
    max_move_sigmas: float = 3.0
    min_move_m: float = 0.02
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """A thinned scan with planes.

    Attributes:
        middle: (3,) of the points, local frame of the cloud, metres; about it angles and shifts part.
        points: (k, 3) float64, less `middle`.
        normals: (k, 3) unit.
        spacing_m: typical distance of neighbours.
        cloud, tree: small_gicp's point cloud of `points` with normals and covariances, and its tree.
    """

    middle: FloatArray
    points: FloatArray
    normals: FloatArray
    spacing_m: float
    cloud: Any
    tree: Any


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GicpOutcome:
    """What GICP proposed.

    Attributes:
        accepted: whether `move` may be applied.
        move: rigid motion in the cloud's local frame.
        message: why it was refused, "" when accepted.
        figures: JSON-able.
    """

    accepted: bool
    move: Rigid3
    message: str
    figures: dict[str, Any]


def surface_near(cloud: PointCloud, points: FloatArray, options: SurfaceFitOptions) -> Surface | None:
    """The scan around points (n, 3), thinned by its levels of detail; None where there is none."""
    low, high = points.min(axis=0) - options.margin_m, points.max(axis=0) + options.margin_m
    rows = _rows_inside(cloud, low, high, options.max_surface_points)
    if len(rows) < options.neighbours:
        return None
    gicp = _small_gicp()
    xyz = cloud.xyz[rows].astype(np.float64)
    middle = xyz.mean(axis=0)
    xyz -= middle
    prepared = gicp.PointCloud(xyz)
    tree = gicp.KdTree(prepared, num_threads=options.threads)
    gicp.estimate_normals_covariances(
        prepared, tree, num_neighbors=options.neighbours, num_threads=options.threads
    )
    _, squared = tree.batch_knn_search(xyz[:: max(1, len(xyz) // 500)], 2)
    return Surface(
        middle=middle,
        points=xyz,
        normals=np.asarray(prepared.normals())[:, :3],
        spacing_m=float(np.median(np.sqrt(np.asarray(squared)[:, 1]))),
        cloud=prepared,
        tree=tree,
    )


def _rows_inside(cloud: PointCloud, low: FloatArray, high: FloatArray, limit: int) -> NDArray[np.int64]:
    """Rows of the cloud's points inside a horizontal box, by as many levels as fit under the limit."""
    nodes = cloud.nodes
    touching = (nodes.box_max[:, :2] >= low[:2]).all(axis=1) & (nodes.box_min[:, :2] <= high[:2]).all(axis=1)
    taken: list[NDArray[np.int64]] = []
    total = 0
    for level in np.unique(nodes.level[touching]):
        runs = np.flatnonzero(touching & (nodes.level == level))
        rows = np.concatenate(
            [np.arange(nodes.start[r], nodes.start[r] + nodes.count[r], dtype=np.int64) for r in runs]
        )
        xy = cloud.xyz[rows, :2]
        rows = rows[((xy >= low[:2]) & (xy <= high[:2])).all(axis=1)]
        if total + len(rows) > limit:
            # A random part of the next level: better than to leave the surface half as dense as it may be.
            part = max(limit - total, 0)
            taken.append(np.random.default_rng(0).choice(rows, part, replace=False))
            break
        taken.append(rows)
        total += len(rows)
    return np.concatenate(taken) if taken else np.zeros(0, np.int64)


def plane_distances(surface: Surface, points: FloatArray, reach_m: float) -> FloatArray:
    """Signed distance (n,) of points (n, 3) to the plane of the nearest scan point; NaN beyond the reach."""
    centred = np.ascontiguousarray(points - surface.middle)
    found, squared = surface.tree.batch_nearest_neighbor_search(centred)
    index = np.asarray(found).astype(np.int64)
    offset = centred - surface.points[index]
    distance = np.einsum("ij,ij->i", surface.normals[index], offset)
    return np.where(np.asarray(squared) <= reach_m**2, distance, np.nan)


def reach_of(surface: Surface, options: SurfaceFitOptions) -> float:
    """How far from the scan a point may be to be compared with it, metres."""
    return max(options.min_reach_m, options.reach_spacings * surface.spacing_m)


def guarded_gicp(
    surface: Surface,
    placed: FloatArray,
    distances: FloatArray,
    evidence: FloatArray,
    covariance: FloatArray,
    options: SurfaceFitOptions,
) -> GicpOutcome:
    """GICP of the placed points (n, 3) against the surface, if it keeps to the evidence.

    GICP sees surfaces only: over flat ground it slides, and on a bent map it tilts. Its move counts if the
    points come closer to the planes and if, at the evidence, it stays within what the placement's
    covariance (7, 7) allows. GICP is rigid: the scale stays.

    Args:
        distances: (n,) of the placed points, of `plane_distances`; those beyond reach, NaN, take no part.
        evidence: (m, 3) placed map points that have a pair.
    """
    near = np.flatnonzero(np.isfinite(distances))
    if len(near) < 50:  # fewer surface patches turn with the noise
        return _refused("too few of the map's points lie near the scan", {"points": len(near)})
    near = near[:: -(-len(near) // options.max_gicp_points)]
    before = float(np.median(np.abs(distances[near])))
    move = _align(surface, placed[near], max(3.0 * before, 2.0 * surface.spacing_m), options)
    after_distances = plane_distances(surface, move.act(placed[near]), np.inf)
    after = float(np.median(np.abs(after_distances)))
    shift = move.act(evidence) - evidence
    jacobian = point_jacobian(evidence)
    allowed = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2) + np.eye(3) * options.min_move_m**2
    sigmas = np.sqrt(np.einsum("ni,nij,nj->n", shift, np.linalg.inv(allowed), shift))
    figures = {
        "points": len(near),
        "median_distance_before_m": before,
        "median_distance_after_m": after,
        "move_of_evidence_m": float(np.sqrt((shift**2).sum(axis=1).mean())),
        "move_of_evidence_sigmas": float(np.median(sigmas)),
    }
    if after > (1.0 - options.min_gain) * before:
        return _refused("GICP does not bring the map closer to the scan", figures, move)
    if figures["move_of_evidence_sigmas"] > options.max_move_sigmas:
        return _refused(
            f"GICP moves the evidence by {figures['move_of_evidence_m']:.2f} m, "
            f"{figures['move_of_evidence_sigmas']:.1f} of its sigmas",
            figures,
            move,
        )
    return GicpOutcome(accepted=True, move=move, message="", figures=figures)


def _align(surface: Surface, points: FloatArray, reach_m: float, options: SurfaceFitOptions) -> Rigid3:
    """The motion that small_gicp's GICP finds."""
    gicp = _small_gicp()
    source = gicp.PointCloud(points - surface.middle)
    tree = gicp.KdTree(source, num_threads=options.threads)
    gicp.estimate_covariances(source, tree, num_neighbors=options.neighbours, num_threads=options.threads)
    result = gicp.align(
        surface.cloud,
        source,
        surface.tree,
        registration_type="GICP",
        max_correspondence_distance=reach_m,
        num_threads=options.threads,
        max_iterations=options.gicp_rounds,
    )
    about = Rigid3.from_matrix(np.asarray(result.T_target_source))
    shift = about.translation + surface.middle - about.rotation @ surface.middle
    return Rigid3(rotation=about.rotation, translation=shift)


def _refused(message: str, figures: dict[str, Any], move: Rigid3 | None = None) -> GicpOutcome:
    return GicpOutcome(accepted=False, move=move or Rigid3.identity(), message=message, figures=figures)


def moved(sim: Sim3, move: Rigid3) -> Sim3:
    """The similarity followed by a rigid motion."""
    return Sim3.from_rigid3(move) @ sim


def _small_gicp() -> Any:
    try:
        import small_gicp
    except ImportError as error:
        raise MissingExtraError(
            "aligning maps with a scan needs small_gicp: pip install 'featuredb[lidar]'"
        ) from error
    return small_gicp
