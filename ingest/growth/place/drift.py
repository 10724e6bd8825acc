"""How far the photos of a refined reconstruction may be off, given the existing points that hold it.

A similarity says how the whole may lie; that a reconstruction bends where nothing holds it any more, it does
not. The adjustment does (`featuredb.adjust.marginals`): poses and lenses with the free points eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.adjust.problem import Problem
from featuredb.adjust.shared_noise import design_effect
from featuredb.adjust.terms import Terms
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import point_jacobian, turns_about
from ingest.colmap.adjust import longest_side, residuals_of
from ingest.colmap.anchored import MAPPING, FixedPoints, Lenses, block_and_marks
from ingest.colmap.bridge import Model, with_observations
from ingest.colmap.precision import linearise
from ingest.growth.map_places import SIGMAS_95

_LEAST_FREEDOM = 0.1
# Of the standard deviation of an observation with what its neighbours share; it is measured on the residuals,
# which a handful of observations keeps too small.
_LEAST_PX = 0.1
_LEAST_TOLD = 1e-12  # least eigenvalue of a normal matrix of unit diagonal: numerically singular below
_MOST_POINTS = 20_000  # free points that take part; fewer know less, so the bound stays one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhotoSpread:
    """How far the photos of a model and what they show may be off, relative to the existing points.

    A photo from far above whose lens nobody knows may be metres higher, and shows its places where they are.
    NaN for photos that see nothing, and for all where no existing point is kept.

    Attributes:
        poses: (k, 6, 6) of the left perturbation of each cam_from_local.
        middles: (k, 3) of the points that each photo shows.
        shown: (k, 7, 7) of the similarity by which these points lie elsewhere: left perturbation (sigma,
            omega, nu) about the middle, local axes.
        lens_turns: (k, 3, 3) the part of its turns that the lenses bring and that other maps have as well.
    """

    poses: FloatArray
    middles: FloatArray
    shown: FloatArray
    lens_turns: FloatArray

    @classmethod
    def unknown(cls, photos: int) -> "PhotoSpread":
        """Of so many photos that nothing holds."""
        shapes = {"poses": (6, 6), "middles": (3,), "shown": (7, 7), "lens_turns": (3, 3)}
        return cls(**{name: np.full((photos, *shape), np.nan) for name, shape in shapes.items()})

    @property
    def known(self) -> NDArray[np.bool_]:
        """(k,)."""
        return np.isfinite(self.shown[:, 0, 0])

    def of(self, photos: Sequence[int]) -> "PhotoSpread":
        """Of some of the photos."""
        return PhotoSpread(**{f.name: getattr(self, f.name)[list(photos)] for f in fields(self)})

    def bounds_m(self) -> FloatArray:
        """(k,) how far the middle of what each photo shows may be off (95 %, worst axis); NaN: unknown."""
        bounds = np.full(len(self.known), np.nan)
        largest = np.linalg.eigvalsh(self.shown[self.known, 4:, 4:])[:, -1]
        bounds[self.known] = SIGMAS_95 * np.sqrt(np.maximum(largest, 0.0))
        return bounds

    def lacks_m2(self, covariance: FloatArray) -> FloatArray:
        """(k,) by how much that middle is less sure, along the worst axis, than a similarity's covariance
        (7, 7) has it; NaN: unknown."""
        jacobian = point_jacobian(self.middles[self.known])
        excess = self.shown[self.known, 4:, 4:] - jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        lacks = np.full(len(self.known), np.nan)
        lacks[self.known] = np.maximum(np.linalg.eigvalsh(excess)[:, -1], 0.0)
        return lacks


def photo_covariances(
    model: Model, keypoints: Sequence[FloatArray], fixed: FixedPoints, kept: NDArray[np.bool_], lenses: Lenses
) -> PhotoSpread:
    """Of all photos, relative to the existing points.

    Observations count as their neighbours share, and for lenses as photos disagree about them
    (`featuredb.adjust.lens_agreement`). By how much a lens differs from the one that a map has lent is this
    reconstruction's alone: it may have changed since.

    Args:
        model: refined, in metres. keypoints: of its photos.
        fixed: existing points, those observations of `kept` (m,).
        lenses: as the adjustment had them.
    """
    spread = PhotoSpread.unknown(len(model.rows))
    if not kept.any():
        return spread
    points = len(model.xyz)
    chosen = np.linspace(0, points - 1, min(points, _MOST_POINTS)).astype(np.int64)
    model = with_observations(model, np.isin(model.point_of, chosen))
    everything = np.ones(len(model.point_of), dtype=np.bool_)
    block, marks = block_and_marks(model, everything, keypoints, fixed, kept)
    # Of an observation, with what its neighbours share and what points and poses take up of it.
    taken, count = 3 * len(block.xyz) + 6 * len(block.names), 2 * (len(block.point_of) + len(marks.xyz))
    freedom = max(1.0 - taken / count, _LEAST_FREEDOM)
    own = residuals_of(block, marks)
    variance_px2 = float((own[0] ** 2).mean()) * design_effect(*own, longest_side(block.cameras)) / freedom
    sigma_px = max(float(np.sqrt(variance_px2)), _LEAST_PX)
    terms = Terms(
        keypoint_px=sigma_px,
        dilution=MAPPING.dilution,
        lenses=lenses.priors(model.cameras),
        marks=replace(marks, sigma_px=sigma_px),
    )
    problem = Problem(block, terms)
    found, weighted = problem.honest_marginals()
    common = found.by_lenses() - MAPPING.dilution**2 * problem.by_lens_priors(weighted, lenses.lent)
    rows, moved, information = problem.points_by_shared()
    marked = _information(model, fixed, kept, sigma_px)
    for k in np.flatnonzero(found.pose_start >= 0).tolist():
        at = found.pose_start[k] + np.arange(6)
        spread.poses[k] = found.shared[np.ix_(at, at)]
        free = np.searchsorted(rows, np.unique(block.point_of[block.photo_of == k]))
        held = np.unique(fixed.point_of[kept][fixed.photo_of[kept] == k])
        places = np.vstack([block.xyz[rows[free]], fixed.xyz[held]])
        spread.middles[k] = np.median(places, axis=0)
        told = np.concatenate([information[free], marked[held]])
        entries = (3 * free[:, None] + np.arange(3)).ravel()
        similarity = _similarity(places - spread.middles[k], told, moved[entries])
        spread.shown[k] = similarity @ found.shared @ similarity.T
        spread.lens_turns[k] = similarity[1:4] @ common @ similarity[1:4].T
    return spread


def _similarity(places: FloatArray, information: FloatArray, moved: Any) -> FloatArray:
    """(7, q) the similarity that fits best how places (n, 3) move with unknowns, each as its rays tell it.

    NaN where they do not tell it, such as two places or those on a line.

    Args:
        information: (n, 3, 3). moved: (3 m, q) CSR, of the first m places; the others stay.
    """
    jacobian = point_jacobian(places)
    by_place = np.swapaxes(jacobian, 1, 2) @ information
    normal = np.einsum("nij,njk->ik", by_place, jacobian)
    by_moved = by_place[: moved.shape[0] // 3].transpose(1, 0, 2).reshape(7, -1)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    if np.linalg.eigvalsh(normal * unit[:, None] * unit)[0] < _LEAST_TOLD:
        return np.full((7, moved.shape[1]), np.nan)
    return np.asarray(np.linalg.solve(normal, (moved.T @ by_moved.T).T))


def _information(model: Model, fixed: FixedPoints, kept: NDArray[np.bool_], sigma_px: float) -> FloatArray:
    """(n, 3, 3) of existing points, as if the photos' rays alone told where they are."""
    linear = linearise(
        model.cameras,
        model.camera_of,
        model.cam_from_sfm,
        fixed.xyz,
        fixed.point_of[kept],
        fixed.photo_of[kept],
        fixed.pixels[kept],
    )
    result = np.zeros((len(fixed.xyz), 3, 3))
    by_point = np.nan_to_num(linear.by_point) / sigma_px
    np.add.at(result, linear.point_of, np.swapaxes(by_point, 1, 2) @ by_point)
    return result


def turning_covariance(covariance: FloatArray, spread: PhotoSpread) -> FloatArray:
    """(7, 7) to be added to a similarity's covariance (7, 7) to hold how all parts of a model are turned.

    A reconstruction that bends by centimetres at its far end has turned there, and what is tied to that end
    goes on in the new direction. About the middle of what the photos show, where these agree: what is held
    by points does not move where these are.
    """
    if not spread.known.any():
        return np.zeros((7, 7))
    more = np.zeros((3, 3))
    for turn in spread.shown[spread.known, 1:4, 1:4]:
        values, vectors = np.linalg.eigh(turn - covariance[1:4, 1:4] - more)
        more += (vectors * np.maximum(values, 0.0)) @ vectors.T
    about = turns_about(spread.middles[spread.known].mean(axis=0))
    return np.asarray(about @ more @ about.T)


def shared_turn(spread: PhotoSpread) -> FloatArray:
    """(7, 3) by what a model's end turns, about each local axis, for one sigma of its lenses; zeros for none.

    Columns of a similarity's left perturbation, about the middle of what the photos show. Maps share lenses,
    so that they turn to the same side, map by map: along a chain such turns add up, where independent ones
    would not.
    """
    if not spread.known.any():
        return np.zeros((7, 3))
    turns = spread.lens_turns[spread.known]
    values, vectors = np.linalg.eigh(turns[np.argmax(np.trace(turns, axis1=1, axis2=2))])
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(turns_about(spread.middles[spread.known].mean(axis=0)) @ root)
