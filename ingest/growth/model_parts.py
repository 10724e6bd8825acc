"""A reconstruction cut down to some of its photos, and joined with the existing points that hold it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ingest.colmap_anchored import Anchored, FixedPoints, with_observations
from ingest.colmap_bridge import Model
from ingest.growth.anchors import Anchors


def without_photos(model: Model, photos: Sequence[int]) -> Model:
    """The model without these photos' observations; points keep at least two. The photos stay, with poses."""
    seen = ~np.isin(model.photo_of, photos)
    seen &= np.bincount(model.point_of[seen], minlength=len(model.xyz))[model.point_of] >= 2
    return with_observations(model, seen)


def only_photos(model: Model, photos: Sequence[int]) -> Model:
    """The model of the chosen photos; the others must have no observations."""
    number = np.full(len(model.rows), -1, dtype=np.int64)
    number[list(photos)] = np.arange(len(photos))
    cameras, camera_of = np.unique(model.camera_of[list(photos)], return_inverse=True)
    return replace(
        model,
        cameras=tuple(model.cameras[int(c)] for c in cameras),
        rows=model.rows[list(photos)],
        camera_of=camera_of.reshape(-1),
        cam_from_sfm=tuple(model.cam_from_sfm[k] for k in photos),
        photo_of=number[model.photo_of],
    )


def with_existing(adjusted: Anchored, fixed: FixedPoints, anchors: Anchors, parents: Sequence[str]) -> Model:
    """The adjusted model with the existing points that at least two of its photos see as points of its own.

    A map holds its points itself: a copy of an existing point is where the new photos were held.

    Args:
        anchors: (m,) of the observations of `fixed`.
        parents: where a feature is held by points of two maps, the one that comes first here counts.
    """
    rank = np.array([parents.index(m) if m in parents else len(parents) for m in anchors.map_ids])
    rows = np.flatnonzero(adjusted.fixed_kept)
    order = rows[np.argsort(rank[anchors.map_of[rows]], kind="stable")]
    feature = np.stack([fixed.photo_of[order], anchors.feature[order]], axis=1)
    _, first = np.unique(feature, axis=0, return_index=True)
    rows = np.sort(order[first])
    pair = np.unique(np.stack([fixed.point_of[rows], fixed.photo_of[rows]], axis=1), axis=0)
    views = np.bincount(pair[:, 0], minlength=len(fixed.xyz))
    rows = rows[views[fixed.point_of[rows]] >= 2]
    points, point_of = np.unique(fixed.point_of[rows], return_inverse=True)
    model = adjusted.model
    joined = (
        np.concatenate([model.point_of, point_of.reshape(-1) + len(model.xyz)]),
        np.concatenate([model.photo_of, fixed.photo_of[rows]]),
        np.concatenate([model.keypoint_of, anchors.feature[rows]]),
    )
    by_point = np.lexsort((joined[1], joined[0]))
    return replace(
        model,
        xyz=np.concatenate([model.xyz, fixed.xyz[points]]),
        point_of=joined[0][by_point],
        photo_of=joined[1][by_point],
        keypoint_of=joined[2][by_point],
    )
