"""Step: the reconstruction adjusted, around lenses of existing maps, with their points where they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area
from ingest.colmap.anchored import (
    Anchored,
    AnchoredOptions,
    FixedPoints,
    Lenses,
    adjust_anchored,
)
from ingest.colmap.bridge import Model, with_observations
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.values import LocalisedPhoto
from ingest.photos.photo import Photo


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineOptions:
    """How existing points and lenses hold a new reconstruction.

    Attributes:
        max_point_sigma_px: existing points whose own uncertainty, seen from the new photo, is larger do
            not hold it (at images of 1600 pixels): twice the inlier tolerance of a pose.
        adjust: the adjustment itself.
    """

    max_point_sigma_px: float = 8.0
    adjust: AnchoredOptions = field(default_factory=AnchoredOptions)


def adopt_lenses(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    photos: Sequence[Photo],
    areas: Sequence[Area],
    keypoints: Sequence[FloatArray],
    options: RefineOptions,
) -> tuple[Model, Lenses]:
    """The model adjusted, in its own frame, around the lenses that existing maps have for its cameras.

    Args:
        photos: all, rows as in the model.
        areas: where it may lie; they lend lenses to cameras none of whose photos is localised, too.
        keypoints: pixels of all features of the model's photos, in the order of its rows.
    """
    lent: dict[int, Camera] = {}
    for c, camera in enumerate(model.cameras):
        rows = model.rows[model.camera_of == c].tolist()
        lens = _lens_of_maps([localised[r] for r in rows if r in localised])
        lens = lens or _lens_for_key({photos[r].camera_key for r in rows}, areas)
        if lens is not None and (lens.width, lens.height) == (camera.width, camera.height):
            lent[c] = lens
    lenses = Lenses(lent=lent, focal_px=exif_focals(model, photos))
    if not lent:
        return model, lenses
    given = replace(model, cameras=tuple(lent.get(c, own) for c, own in enumerate(model.cameras)))
    return adjust_anchored(given, keypoints, FixedPoints.none(), lenses, options.adjust).model, lenses


def _lens_of_maps(photos: Sequence[LocalisedPhoto]) -> Camera | None:
    """The lens that a map lent to most of these photos; None where none did."""
    lent: dict[Camera, int] = {}
    for photo in photos:
        if photo.result.pose is not None and photo.result.pose.camera_source == "map":
            lent[photo.camera] = lent.get(photo.camera, 0) + 1
    return max(lent, key=lambda camera: lent[camera]) if lent else None


def _lens_for_key(keys: set[str], areas: Sequence[Area]) -> Camera | None:
    """The lens that the areas have for a camera's EXIF key, the first area's first."""
    if len(keys) != 1:
        return None
    key = keys.pop()
    found = (area.camera_for_key(key) for area in areas) if key else iter(())
    return next((camera for camera in found if camera is not None), None)


def refine_with_maps(
    model: Model,
    local_from_sfm: Sim3,
    correspondences: Correspondences,
    lenses: Lenses,
    keypoints: Sequence[FloatArray],
    options: RefineOptions,
) -> tuple[Anchored, FixedPoints, NDArray[np.int64]]:
    """The model in the local frame, metres, adjusted with the existing points that it sees held fixed.

    Args:
        correspondences: those that agree with the placement.

    Returns:
        The adjusted model, the fixed points with their observations, and for each of these (m,) its row of
        the correspondences.
    """
    placed = in_metres(model, local_from_sfm)
    sharp = np.flatnonzero(_sigma_px(placed, correspondences) <= options.max_point_sigma_px)
    held = correspondences.take(sharp)
    first, number = held.existing()
    fixed = FixedPoints(xyz=held.points[first], point_of=number, photo_of=held.photo_of, pixels=held.pixels)
    free = without_anchored(placed, held)
    return adjust_anchored(free, keypoints, fixed, lenses, options.adjust), fixed, sharp


def exif_focals(model: Model, photos: Sequence[Photo]) -> dict[int, float]:
    """Focal lengths of EXIF, pixels, by camera of the model; none where a camera's photos tell several.

    Args:
        photos: all, rows as in the model.
    """
    told: dict[int, set[float | None]] = {}
    for row, camera in zip(model.rows.tolist(), model.camera_of.tolist(), strict=True):
        told.setdefault(camera, set()).add(photos[row].focal_px)
    found: dict[int, float] = {}
    for camera, focals in told.items():
        only = next(iter(focals))
        if len(focals) == 1 and only is not None:
            found[camera] = only
    return found


def in_metres(model: Model, local_from_sfm: Sim3) -> Model:
    """The model in the local frame."""
    return replace(
        model,
        cam_from_sfm=tuple(local_from_sfm.act_on_pose(pose) for pose in model.cam_from_sfm),
        xyz=local_from_sfm.act(model.xyz),
    )


def without_anchored(model: Model, correspondences: Correspondences) -> Model:
    """The model without observations by features that existing points hold: those are their points now."""
    size = int(max(model.keypoint_of.max(initial=0), correspondences.feature.max(initial=0))) + 1
    held = np.unique(correspondences.photo_of * size + correspondences.feature)
    free = ~np.isin(model.photo_of * size + model.keypoint_of, held)
    counts = np.bincount(model.point_of[free], minlength=len(model.xyz))
    free &= counts[model.point_of] >= 2
    return with_observations(model, free)


def _sigma_px(model: Model, correspondences: Correspondences) -> FloatArray:
    """(m,) largest standard deviation of each existing point across the line of sight, in pixels at 1600."""
    sigma = np.zeros(len(correspondences))
    for k, pose in enumerate(model.cam_from_sfm):
        rows = np.flatnonzero(correspondences.photo_of == k)
        if not len(rows):
            continue
        camera = model.cameras[int(model.camera_of[k])]
        toward = correspondences.points[rows] - pose.center
        depth = np.linalg.norm(toward, axis=1)
        ray = toward / np.maximum(depth, 1e-9)[:, None]
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        spread = np.linalg.eigvalsh(across @ correspondences.covariance[rows] @ across)[:, -1]
        scale = camera.focal_px / max(1.0, max(camera.width, camera.height) / 1600.0)
        sigma[rows] = scale * np.sqrt(np.maximum(spread, 0.0)) / np.maximum(depth, 1e-9)
    return sigma


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


def with_existing(
    adjusted: Anchored, fixed: FixedPoints, correspondences: Correspondences, parents: Sequence[str]
) -> Model:
    """The adjusted model with the existing points that at least two of its photos see as points of its own.

    A map holds its points itself: a copy of an existing point is where the new photos were held.

    Args:
        correspondences: (m,) of the observations of `fixed`.
        parents: where a feature is held by points of two maps, the one that comes first here counts.
    """
    rank = np.array([parents.index(m) if m in parents else len(parents) for m in correspondences.map_ids])
    rows = np.flatnonzero(adjusted.fixed_kept)
    order = rows[np.argsort(rank[correspondences.map_of[rows]], kind="stable")]
    feature = np.stack([fixed.photo_of[order], correspondences.feature[order]], axis=1)
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
        np.concatenate([model.keypoint_of, correspondences.feature[rows]]),
    )
    by_point = np.lexsort((joined[1], joined[0]))
    return replace(
        model,
        xyz=np.concatenate([model.xyz, fixed.xyz[points]]),
        point_of=joined[0][by_point],
        photo_of=joined[1][by_point],
        keypoint_of=joined[2][by_point],
    )
