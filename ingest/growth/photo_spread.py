"""How far the photos of a model may be off, and what that adds to the covariance of its similarity."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import point_jacobian
from ingest.colmap_bridge import Model


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhotoSpread:
    """How far the photos of a model may be off, relative to the existing points.

    Attributes:
        poses: (k, 6, 6) of the left perturbation of each cam_from_local; NaN for photos that see nothing, and
            for all where there are more than `DriftOptions.max_photos`.
        turns: (k, 3, 3) radians squared, about the local axes: how the piece of the model around each photo
            may be turned: the mean rotation of the photo and those that share most points with it. What comes
            next is tied to such a piece. NaN as before.
        lens_turns: (k, 3, 3) the part of `turns` that the lenses bring and that other maps have as well: all
            but what a lens may differ by from the one that a map has lent.
    """

    poses: FloatArray
    turns: FloatArray
    lens_turns: FloatArray

    def of(self, rows: Sequence[int]) -> "PhotoSpread":
        """Of some of the photos."""
        chosen = list(rows)
        return PhotoSpread(
            poses=self.poses[chosen], turns=self.turns[chosen], lens_turns=self.lens_turns[chosen]
        )


def turning_covariance(model: Model, covariance: FloatArray, spread: PhotoSpread) -> FloatArray:
    """(7, 7) to be added to a similarity's covariance to hold the directions of all pieces of a model.

    A reconstruction that bends by centimetres at its far end has turned there, and what is tied to that end
    goes on in the new direction: over many maps the turns are what counts. About the photos' middle.

    Args:
        covariance: (7, 7) of the similarity's left perturbation, in the local frame.
    """
    seen = np.isfinite(spread.turns[:, 0, 0])
    if not seen.any():
        return np.zeros((7, 7))
    more = np.zeros((3, 3))
    for turn in spread.turns[seen]:
        values, vectors = np.linalg.eigh(turn - covariance[1:4, 1:4] - more)
        more += (vectors * np.maximum(values, 0.0)) @ vectors.T
    about = _about(model.centers()[seen].mean(axis=0))
    return np.asarray(about @ more @ about.T)


def shared_turn(model: Model, spread: PhotoSpread) -> FloatArray:
    """(7, 3) by what a model's end turns, about each local axis, for one sigma of its lenses; zeros for none.

    Columns of a similarity's left perturbation, about the photos' middle. Maps share lenses, so that they
    turn to the same side, map by map: along a chain such turns add up, where independent ones would not.
    """
    seen = np.isfinite(spread.lens_turns[:, 0, 0])
    if not seen.any():
        return np.zeros((7, 3))
    turns = spread.lens_turns[seen]
    values, vectors = np.linalg.eigh(turns[np.argmax(np.trace(turns, axis1=1, axis2=2))])
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(_about(model.centers()[seen].mean(axis=0)) @ root)


def _about(middle: FloatArray) -> FloatArray:
    """(7, 3) left perturbations of rotations about a place."""
    return np.vstack([np.zeros((1, 3)), np.eye(3), skew(middle)])


def bending_variance_m2(model: Model, covariance: FloatArray, spread: FloatArray) -> float:
    """What must be added to a similarity's covariance to hold the positions of all photos, square metres.

    Added, and not multiplied: near what holds the model the similarity says millimetres, where a photo's own
    position is good to centimetres; a factor that covers this would make metres of it at the far end.

    Args:
        model: refined, in metres.
        covariance: (7, 7) of the similarity's left perturbation, in the local frame.
        spread: (k, 6, 6) of `PhotoSpread`; NaN for photos that see nothing any more and say nothing.
    """
    seen = np.isfinite(spread[:, 0, 0])
    if not seen.any():
        return 0.0
    jacobian = point_jacobian(model.centers()[seen])
    claimed = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    excess = center_covariances(model, spread)[seen] - claimed
    return float(max(0.0, np.linalg.eigvalsh(excess)[:, -1].max()))


def center_covariances(model: Model, spread: FloatArray) -> FloatArray:
    """(k, 3, 3) square metres, of the photos' centres in the local frame, from those of their poses."""
    turns = np.array([pose.rotation for pose in model.cam_from_sfm])
    centers = np.swapaxes(turns, 1, 2) @ spread[:, 3:, 3:] @ turns
    return np.asarray((centers + np.swapaxes(centers, 1, 2)) / 2)
