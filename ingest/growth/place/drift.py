"""How far the photos of a refined reconstruction may be off, given the existing points that hold it.

A similarity says how the whole may lie; that a reconstruction bends where nothing holds it any more, it does
not. The adjustment does (`featuredb.adjust.marginals`): poses and lenses with the free points eliminated.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from featuredb.adjust.marginals import Marginals
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, Terms
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import point_jacobian, turns_about
from ingest.colmap.adjust import longest_side, residuals_of
from ingest.colmap.anchored import MAPPING, FixedPoints, Lenses, block_and_marks
from ingest.colmap.bridge import Model, with_observations
from ingest.colmap.precision import design_effect
from ingest.growth.map_places import SIGMAS_95, at_most_places

_LEAST_FREEDOM = 0.1
_PIECE = 5  # photos; a photo alone says more of its own noise than of where its neighbourhood looks
# Of the standard deviation of an observation with what its neighbours share; it is measured on the residuals,
# which a handful of observations keeps too small.
_LEAST_PX = 0.1
_LENS_STEP = 1e-6  # of a lens' parameter, for its derivative
_MOST_POINTS = 20_000  # free points that take part; fewer know less, so the bound stays one


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhotoSpread:
    """How far the photos of a model may be off, relative to the existing points.

    NaN for photos that see nothing, and for all where no existing point is kept.

    Attributes:
        poses: (k, 6, 6) of the left perturbation of each cam_from_local.
        places: (k, 3) of what each photo shows, the place that poses and lenses move most across its line of
            sight, one hundredth of them left out; shown: (k, 3, 3) square metres, by how much. A photo from
            far above whose lens nobody knows may be metres higher, and shows its places where they are.
        turns: (k, 3, 3) radians squared, about the local axes: of the mean rotation of each photo and those
            that share most points with it. What comes next is tied to such a piece of the model.
        lens_turns: (k, 3, 3) the part of `turns` that the lenses bring and that other maps have as well.
    """

    poses: FloatArray
    places: FloatArray
    shown: FloatArray
    turns: FloatArray
    lens_turns: FloatArray

    @classmethod
    def unknown(cls, photos: int) -> "PhotoSpread":
        """Of so many photos that nothing holds."""
        shapes = {"poses": (6, 6), "places": (3,), "shown": (3, 3), "turns": (3, 3), "lens_turns": (3, 3)}
        return cls(**{name: np.full((photos, *shape), np.nan) for name, shape in shapes.items()})

    def of(self, photos: Sequence[int]) -> "PhotoSpread":
        """Of some of the photos."""
        return PhotoSpread(**{f.name: getattr(self, f.name)[list(photos)] for f in fields(self)})

    def bounds_m(self) -> FloatArray:
        """(k,) how far what each photo shows may be off (95 %, along the worst axis); NaN where unknown."""
        known = np.isfinite(self.shown[:, 0, 0])
        bounds = np.full(len(known), np.nan)
        largest = np.linalg.eigvalsh(self.shown[known])[:, -1]
        bounds[known] = SIGMAS_95 * np.sqrt(np.maximum(largest, 0.0))
        return bounds

    def lacks_m2(self, covariance: FloatArray) -> FloatArray:
        """(k,) by how much what each photo shows is less sure, along the worst axis, than a similarity's
        covariance (7, 7) has it; NaN where unknown."""
        known = np.isfinite(self.shown[:, 0, 0])
        jacobian = point_jacobian(self.places[known])
        excess = self.shown[known] - jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
        lacks = np.full(len(known), np.nan)
        lacks[known] = np.maximum(np.linalg.eigvalsh(excess)[:, -1], 0.0)
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
    residuals, pixels, photo_of = residuals_of(block, marks)
    shared = design_effect(residuals, pixels, photo_of, longest_side(block.cameras))
    variance_px2 = float((residuals**2).mean()) * shared / freedom
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
    seen = np.flatnonzero(found.pose_start >= 0)
    for k in seen.tolist():
        at = found.pose_start[k] + np.arange(6)
        spread.poses[k] = found.shared[np.ix_(at, at)]
        places = np.vstack([block.xyz[block.point_of[block.photo_of == k]], marks.xyz[marks.photo_of == k]])
        moved = _moved(block, found, k, places)
        most = np.asarray(np.linalg.eigvalsh(moved)[:, -1], dtype=np.float64)
        row = int(np.flatnonzero(most == at_most_places(most))[0])
        spread.places[k], spread.shown[k] = places[row], moved[row]
    turn_of = _view_turns(block, found)
    for k, piece in _pieces(model, fixed, kept, seen).items():
        turn = turn_of[piece].mean(axis=0)
        spread.turns[k] = turn @ found.shared @ turn.T
        spread.lens_turns[k] = turn @ common @ turn.T
    return spread


def _view_turns(block: Block, found: Marginals) -> FloatArray:
    """(k, 3, q) how what each photo sees turns about the block's axes with poses and lenses.

    A principal point that is off turns the photo, and its points stay where they are.
    """
    result = np.zeros((len(block.names), 3, len(found.shared)))
    for k, pose in enumerate(block.cam_from_block):
        if found.pose_start[k] < 0:
            continue
        by_pose = slice(int(found.pose_start[k]), int(found.pose_start[k]) + 3)
        result[k, :, by_pose] = pose.rotation.T
        camera, first = block.camera(k), int(found.lens_start[block.camera_of[k]])
        if first >= 0:
            lens = camera.to_pycolmap()
            focal, (cx, cy) = lens.focal_length_idxs(), lens.principal_point_idxs()
            fx, fy = camera.params[focal[0]], camera.params[focal[-1]]
            result[k, :, first + cx] = pose.rotation.T @ [0.0, 1.0 / fx, 0.0]
            result[k, :, first + cy] = pose.rotation.T @ [-1.0 / fy, 0.0, 0.0]
    return result


def _pieces(
    model: Model, fixed: FixedPoints, kept: NDArray[np.bool_], seen: NDArray[np.int64]
) -> dict[int, NDArray[np.int64]]:
    """For each photo that sees something, itself and those that share most points with it."""
    photo = np.concatenate([model.photo_of, fixed.photo_of[kept]])
    point = np.concatenate([model.point_of, len(model.xyz) + fixed.point_of[kept]])
    shape = (len(model.rows), len(model.xyz) + len(fixed.xyz))
    sees = sparse.csr_array((np.ones(len(photo)), (photo, point)), shape=shape)
    shared = (sees @ sees.T).toarray()
    np.fill_diagonal(shared, np.inf)
    order = {k: np.argsort(-shared[k], kind="stable")[:_PIECE] for k in seen.tolist()}
    return {k: rows[shared[k, rows] > 0.0] for k, rows in order.items()}


def turning_covariance(model: Model, covariance: FloatArray, spread: PhotoSpread) -> FloatArray:
    """(7, 7) to be added to a similarity's covariance (7, 7) to hold the directions of all pieces of a model.

    A reconstruction that bends by centimetres at its far end has turned there, and what is tied to that end
    goes on in the new direction. About the middle of what the photos show, where these agree: what is held
    by points does not move where these are.
    """
    seen = np.isfinite(spread.turns[:, 0, 0])
    if not seen.any():
        return np.zeros((7, 7))
    more = np.zeros((3, 3))
    for turn in spread.turns[seen]:
        values, vectors = np.linalg.eigh(turn - covariance[1:4, 1:4] - more)
        more += (vectors * np.maximum(values, 0.0)) @ vectors.T
    about = turns_about(spread.places[seen].mean(axis=0))
    return np.asarray(about @ more @ about.T)


def shared_turn(model: Model, spread: PhotoSpread) -> FloatArray:
    """(7, 3) by what a model's end turns, about each local axis, for one sigma of its lenses; zeros for none.

    Columns of a similarity's left perturbation, about the middle of what the photos show. Maps share lenses, so that they
    turn to the same side, map by map: along a chain such turns add up, where independent ones would not.
    """
    seen = np.isfinite(spread.lens_turns[:, 0, 0])
    if not seen.any():
        return np.zeros((7, 3))
    turns = spread.lens_turns[seen]
    values, vectors = np.linalg.eigh(turns[np.argmax(np.trace(turns, axis1=1, axis2=2))])
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(turns_about(spread.places[seen].mean(axis=0)) @ root)


def _moved(block: Block, found: Marginals, photo: int, places: FloatArray) -> FloatArray:
    """(n, 3, 3) square metres by which places (n, 3) move across a photo's line of sight, with its pose and
    lens: the pixels stay, and so do the distances."""
    pose, camera = block.cam_from_block[photo], block.camera(photo)
    seen = pose.act(places)
    by_point = camera.projection_jacobian(seen)
    by_unknown = [-by_point @ skew(seen), by_point]
    columns = [found.pose_start[photo] + np.arange(6)]
    if (first := int(found.lens_start[block.camera_of[photo]])) >= 0:
        by_unknown.append(_by_lens(camera, seen))
        columns.append(first + np.arange(len(camera.params)))
    at = np.concatenate(columns)
    across = np.linalg.pinv(np.nan_to_num(by_point)) @ np.nan_to_num(np.concatenate(by_unknown, axis=2))
    across = pose.rotation.T @ across
    return np.asarray(across @ found.shared[np.ix_(at, at)] @ np.swapaxes(across, 1, 2))


def _by_lens(camera: Camera, seen: FloatArray) -> FloatArray:
    """(n, 2, p) derivatives of the pixels of points (n, 3) by the parameters of a camera."""
    lens = np.array(camera.params)
    columns = []
    for k, step in enumerate(_LENS_STEP * np.maximum(np.abs(lens), 1.0)):
        ends = [replace(camera, params=tuple(lens + sign * step * np.eye(len(lens))[k])) for sign in (1, -1)]
        columns.append((ends[0].project(seen) - ends[1].project(seen)) / (2.0 * step))
    return np.stack(columns, axis=2)
