"""Correspondences: pixels of a new reconstruction's photos in which points of existing maps are seen."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from ingest.colmap.bridge import Model
from ingest.growth.values import LocalisedPhoto


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correspondences:
    """Existing points seen by photos of a model, all in one local frame.

    Attributes:
        map_ids: the existing maps, by name; `map_of` indexes into them.
        photo_of: (m,) index into the model's photos.
        feature: (m,) row of that photo's features.
        pixels: (m, 2) float64.
        points: (m, 3) metres. covariance: (m, 3, 3) relative to their map's gauge.
        map_of: (m,), point_of: (m,) row of that map's points.
        model_point: (m,) the model's own point that the same feature observes, -1 where it has none.
        carried: (m,) the photo's own localisation did not find the match; it came along a track of the
            model, from a photo whose localisation did.
    """

    map_ids: tuple[str, ...]
    photo_of: NDArray[np.int64]
    feature: NDArray[np.int64]
    pixels: FloatArray
    points: FloatArray
    covariance: FloatArray
    map_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    model_point: NDArray[np.int64]
    carried: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.photo_of)

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Correspondences":
        """The correspondences of the given rows."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def existing(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """One of each existing point (first row), and the number (m,) of each one's point."""
        both = np.stack([self.map_of, self.point_of], axis=1)
        _, first, number = np.unique(both, axis=0, return_index=True, return_inverse=True)
        return first, number.reshape(-1)


_COLUMNS = Correspondences.__slots__[1:]


def find_correspondences(
    model: Model, localised: Mapping[int, LocalisedPhoto], keypoints: Mapping[int, FloatArray]
) -> Correspondences:
    """Correspondences of a model's photos, own and carried along its tracks; photos are in one frame.

    Args:
        keypoints: pixels (n, 2) of all features of the model's photos, by row.
    """
    mine = {k: localised[r] for k, r in enumerate(model.rows.tolist()) if r in localised}
    map_ids = tuple(sorted({m for photo in mine.values() for m in photo.map_ids}))
    none = np.zeros(0, dtype=np.int64)
    nothing = Correspondences(
        map_ids=map_ids,
        photo_of=none,
        feature=none,
        pixels=np.zeros((0, 2)),
        points=np.zeros((0, 3)),
        covariance=np.zeros((0, 3, 3)),
        map_of=none,
        point_of=none,
        model_point=none,
        carried=np.zeros(0, dtype=np.bool_),
    )
    own = _joined(nothing, *(_own(model, k, photo, map_ids) for k, photo in mine.items()))
    return _joined(own, _carried(model, own, keypoints))


def _joined(*parts: Correspondences) -> Correspondences:
    columns: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS}
    return replace(parts[0], **columns)


def _own(model: Model, k: int, photo: LocalisedPhoto, map_ids: tuple[str, ...]) -> Correspondences:
    number = np.array([map_ids.index(m) for m in photo.map_ids], dtype=np.int64)
    seen = model.photo_of == k
    points = dict(zip(model.keypoint_of[seen].tolist(), model.point_of[seen].tolist(), strict=True))
    return Correspondences(
        map_ids=map_ids,
        photo_of=np.full(len(photo.feature_rows), k, dtype=np.int64),
        feature=photo.feature_rows,
        pixels=photo.pixels,
        points=photo.points,
        covariance=photo.point_covariance,
        map_of=number[photo.map_of],
        point_of=photo.point_of,
        model_point=np.array([points.get(f, -1) for f in photo.feature_rows.tolist()], dtype=np.int64),
        carried=np.zeros(len(photo.feature_rows), dtype=np.bool_),
    )


def _carried(model: Model, own: Correspondences, keypoints: Mapping[int, FloatArray]) -> Correspondences:
    """Where more than half of a track's matches with one map name one point, its other photos see it too."""
    linked = np.flatnonzero(own.model_point >= 0)
    triple = np.stack([own.model_point[linked], own.map_of[linked], own.point_of[linked]], axis=1)
    links, first, votes = np.unique(triple, axis=0, return_index=True, return_counts=True)
    pair, number = np.unique(links[:, :2], axis=0, return_inverse=True)
    total = np.bincount(number.reshape(-1), weights=votes, minlength=len(pair))
    sure = votes > 0.5 * total[number.reshape(-1)]
    links, example = links[sure], linked[first[sure]]
    start = np.searchsorted(model.point_of, np.arange(len(model.xyz) + 1))
    have = set(zip(own.photo_of.tolist(), own.feature.tolist(), own.map_of.tolist(), strict=True))
    found = [
        (o, row)
        for (point, map_row, _), row in zip(links.tolist(), example.tolist(), strict=True)
        for o in range(int(start[point]), int(start[point + 1]))
        if (int(model.photo_of[o]), int(model.keypoint_of[o]), map_row) not in have
    ]
    seen, source = np.array(found, dtype=np.int64).reshape(-1, 2).T
    photo_of, feature = model.photo_of[seen], model.keypoint_of[seen]
    pixels = np.zeros((len(seen), 2))
    for k in np.unique(photo_of):
        mine = photo_of == k
        pixels[mine] = keypoints[int(model.rows[k])][feature[mine]]
    return replace(
        own.take(source),
        photo_of=photo_of,
        feature=feature,
        pixels=pixels,
        model_point=model.point_of[seen],
        carried=np.ones(len(seen), dtype=np.bool_),
    )
