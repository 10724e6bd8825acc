"""A reconstruction cut down to some of its photos."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from ingest.colmap.bridge import Model

_LEAST_SHARED = 15  # points that hold two photos together; as many as an accepted pose needs


def keep_photos(model: Model, rows: Collection[int], least: int = 2) -> Model | None:
    """The largest part of the model that hangs together among the given rows; None if it is under `least`."""
    wanted = np.isin(model.rows, np.array(sorted(rows), dtype=np.int64))
    if wanted.all():
        return model if len(model.rows) >= least else None
    seen = wanted[model.photo_of]
    count = len(model.rows)
    sees = sparse.csr_array(
        (np.ones(int(seen.sum())), (model.photo_of[seen], model.point_of[seen])),
        shape=(count, max(len(model.xyz), 1)),
    )
    shared = (sees @ sees.T).toarray() >= _LEAST_SHARED
    _, label = connected_components(sparse.csr_array(shared.astype(np.int8)), directed=False)
    sizes = np.bincount(label[wanted], minlength=int(label.max()) + 1)
    kept = wanted & (label == int(sizes.argmax()))
    if int(kept.sum()) < least:
        return None
    return _cut(model, kept)


def select_photos(model: Model, rows: Collection[int]) -> Model:
    """The model with these photos, whether they hang together or not."""
    wanted = np.isin(model.rows, np.array(sorted(rows), dtype=np.int64))
    return model if wanted.all() else _cut(model, wanted)


def _cut(model: Model, kept: "np.ndarray") -> Model:
    """The model with the photos of the mask (k,) and the points that two of them still see."""
    here = kept[model.photo_of]
    views = np.bincount(model.point_of[here], minlength=len(model.xyz))
    here &= views[model.point_of] >= 2
    points = np.unique(model.point_of[here])
    photo_row = np.cumsum(kept) - 1
    point_row = np.full(len(model.xyz), -1, dtype=np.int64)
    point_row[points] = np.arange(len(points))
    cameras, camera_of = np.unique(model.camera_of[kept], return_inverse=True)
    return replace(
        model,
        cameras=tuple(model.cameras[int(c)] for c in cameras),
        rows=model.rows[kept],
        camera_of=camera_of.reshape(-1).astype(np.int64),
        cam_from_sfm=tuple(p for p, yes in zip(model.cam_from_sfm, kept.tolist(), strict=True) if yes),
        xyz=model.xyz[points],
        point_of=point_row[model.point_of[here]],
        photo_of=photo_row[model.photo_of[here]].astype(np.int64),
        keypoint_of=model.keypoint_of[here],
    )
