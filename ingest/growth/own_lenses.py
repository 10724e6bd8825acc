"""Step: lenses that the existing points tell better than whoever lent them, or than one coefficient can.

A reconstruction of a few photos does not tell its lens from its shape, so it takes a map's (`refine`). That
lens may have been estimated from as few. Points that are held where they are leave nothing to trade a lens
against, and a few photos are enough: 45 m above the ground a focal length that is 0.6 % off is a quarter of a
metre, which every later photo of that camera repeats.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap_anchored import Anchored, AnchoredOptions, FixedPoints, adjust_anchored
from ingest.colmap_bridge import Model
from ingest.growth.refine import Lenses, with_cameras
from ingest.lens_ladder import MORE_OF_OPENCV, as_opencv, as_radial, center_shift_rel, information_gain

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnLensOptions:
    """When a camera gets a lens of its own.

    Attributes:
        evidence: how many times the penalty of the information criterion the gain must be
            (`ingest.lens_ladder.information_gain`), at each rung. The rim of a map is bent, and a few
            photos there bend their lens after it: they gained 21, 26 and 40 on `brighton` and `copr`, with
            focal lengths 1 to 3 % off. Lenses that truly are otherwise gained 157 and 820 in the simulated
            walk. Every gain is logged at level INFO.
        same_focal_rel, same_focal_evidence: OPENCV may also be taken for this much, where it leaves the focal
            length where it was but for this share: a focal length is what bends with the rim and what lifts
            cameras. A drone of the walk whose principal point is 1.6 px off the middle gained 15, 18, 15 and
            10 with four maps, the focal length within 0.07 %; without it azimuths turned by 0.1 mrad in 10 m,
            map by map, always to the same side. On `brighton` 1 and less, on `copr` 3 to 9, with 0.03 to
            0.2 %; where `copr` gained more, the focal length moved by 0.6 and 0.8 %.
        max_center_shift_rel: of OPENCV, as for the lens of a reconstruction.
        least_held: observations of existing points by the camera's photos; fewer do not tell eight parameters
            of a lens from the poses.
    """

    evidence: float = 75.0
    same_focal_rel: float = 0.001
    same_focal_evidence: float = 10.0
    max_center_shift_rel: float = 0.03
    least_held: int = 100


def own_lenses(
    adjusted: Anchored,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    lenses: Lenses,
    adjust: AnchoredOptions,
    options: OwnLensOptions,
) -> dict[int, Camera]:
    """Lenses by camera of the model, of those cameras that explain their photos far better with one.

    Cameras that hold a map's lens, or have one distortion coefficient, are adjusted along, with two of them
    (or all that the map's lens has). Those that have two then are tried with tangential coefficients, a
    second focal length and the principal point.

    Args:
        adjusted: with `lenses`, and with the existing points. keypoints: of its photos.
    """
    model = adjusted.model
    held = _fitting(fixed, adjusted.fixed_kept)
    support = np.bincount(model.camera_of[held.photo_of], minlength=len(model.cameras))
    asked = [
        c
        for c, camera in enumerate(model.cameras)
        if support[c] >= options.least_held
        and (c in lenses.constant or camera.model in ("SIMPLE_RADIAL", "RADIAL"))
    ]
    if not asked:
        return {}
    every = replace(adjust, rounds=1, max_error_px=np.inf)  # the same observations before and after
    constant = [c for c in lenses.constant if c not in asked]
    freer = with_cameras(model, {c: _fuller(model.cameras[c]) for c in asked})
    radial = adjust_anchored(freer, keypoints, held, constant, every, lenses.focal_px).model
    free_before = {c: 0 if c in lenses.constant else len(model.cameras[c].lens_parameters()) for c in asked}
    more = {c: len(radial.cameras[c].lens_parameters()) - free_before[c] for c in asked}
    gains = _gains(model, radial, keypoints, held, {c: count for c, count in more.items() if count})
    chosen = {c: radial.cameras[c] for c, gain in gains.items() if gain >= options.evidence}
    centered = [c for c in asked if radial.cameras[c].model == "RADIAL"]
    if centered:
        freer = with_cameras(radial, {c: as_opencv(radial.cameras[c]) for c in centered})
        # Principal points are free for all lenses or none; the others stay as they are.
        others = sorted(set(range(len(model.cameras))) - set(centered))
        opencv = adjust_anchored(
            freer, keypoints, held, others, every, lenses.focal_px, free_centers=True
        ).model
        gains = _gains(radial, opencv, keypoints, held, dict.fromkeys(centered, MORE_OF_OPENCV))
        chosen |= {
            c: opencv.cameras[c]
            for c in centered
            if gains[c] >= _asked(model.cameras[c], opencv.cameras[c], options)
            and center_shift_rel(opencv.cameras[c]) <= options.max_center_shift_rel
        }
    return chosen


def _asked(before: Camera, after: Camera, options: OwnLensOptions) -> float:
    """The gain to be asked for, by how far the focal length moved."""
    moved = abs(after.focal_px / before.focal_px - 1.0)
    return options.same_focal_evidence if moved <= options.same_focal_rel else options.evidence


def _fitting(fixed: FixedPoints, kept: NDArray[np.bool_]) -> FixedPoints:
    """The observations that fit."""
    return replace(
        fixed, point_of=fixed.point_of[kept], photo_of=fixed.photo_of[kept], pixels=fixed.pixels[kept]
    )


def _gains(
    before: Model,
    after: Model,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    more: Mapping[int, int],
) -> dict[int, float]:
    """`information_gain` of the photos of each camera.

    Args:
        more: parameters by camera that `after` has more.
    """
    was, of_camera = _residuals(before, keypoints, fixed)
    now, _ = _residuals(after, keypoints, fixed)
    gains = {
        c: information_gain(was[of_camera == c], now[of_camera == c], count) for c, count in more.items()
    }
    for c, gain in gains.items():
        _LOG.info(
            "%d photos: %s, %.1f px, gains %.1f times the penalty over %s, %.1f px",
            int((before.camera_of == c).sum()),
            after.cameras[c].model,
            after.cameras[c].focal_px,
            gain,
            before.cameras[c].model,
            before.cameras[c].focal_px,
        )
    return gains


def _fuller(camera: Camera) -> Camera:
    """The same lens with a second radial coefficient, if it has one."""
    return as_radial(camera) if camera.model == "SIMPLE_RADIAL" else camera


def _residuals(
    model: Model, keypoints: Sequence[FloatArray], fixed: FixedPoints
) -> tuple[FloatArray, NDArray[np.int64]]:
    """(m, 2) of the model's observations, then of those of fixed points, in pixels; the camera of each."""
    found, of_camera = [], []
    for photo_of, xyz, point_of, pixels in (
        (model.photo_of, model.xyz, model.point_of, None),
        (fixed.photo_of, fixed.xyz, fixed.point_of, fixed.pixels),
    ):
        residuals = np.zeros((len(photo_of), 2))
        for k, pose in enumerate(model.cam_from_sfm):
            mine = np.flatnonzero(photo_of == k)
            seen = keypoints[k][model.keypoint_of[mine]] if pixels is None else pixels[mine]
            camera = model.cameras[int(model.camera_of[k])]
            residuals[mine] = camera.project(pose.act(xyz[point_of[mine]])) - seen
        found.append(np.nan_to_num(residuals, nan=1e3, posinf=1e3, neginf=-1e3))
        of_camera.append(model.camera_of[photo_of])
    return np.concatenate(found), np.concatenate(of_camera).astype(np.int64)
