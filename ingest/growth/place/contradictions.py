"""Step: do the photos' own localisations still fit the refined reconstruction, each by its own sigmas?

Asked after the refinement, not before: as it comes, a reconstruction of a few photos is bent by more than
localised poses are uncertain. Photos see the existing points within a pixel or two of where it has them and
yet stand dozens of sigmas from it. Adjusted to the existing points it is bent no more, and what still
differs contradicts.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import so3_log
from ingest.colmap.bridge import Model
from ingest.colmap.precision import linearise
from ingest.growth import gates
from ingest.growth.place.similarity_fit import FittedSimilarity
from ingest.growth.values import LocalisedPhoto

# What the focal length of a localisation may be off, one sigma. A photo at the rim of a map sees it in a
# corner, and turns a lens that is 0.5 % off into half a metre and half a degree, where its pixels say 0.1 m.
# `brighton`'s lens is off by 1.3 %.
_FOCAL_REL = 0.01


def contradicting_photos(
    model: Model,
    localised: Mapping[int, LocalisedPhoto],
    spread: FloatArray,
    fits: Sequence[FittedSimilarity],
) -> dict[int, str]:
    """Photos of the model whose own localisation is elsewhere, by their place in it, with the figures.

    The sigmas are those of the localisation, times the spread and the neighbours factor of the similarity,
    those of the refined pose, and what the lens that it was localised with makes where the refined one is
    another. Spread and factor are the larger ones of before and after the refinement: poses from the same
    existing points share their errors, which the refined model has taken over.

    Args:
        model: refined, in metres.
        localised: by place in the model; others than those that agreed with the placement are not asked.
        spread: (k, 6, 6) of `PhotoSpread`; unknown ones (NaN) add nothing.
        fits: of the model to the existing points, as it came and refined.
    """
    limit = gates.sigmas_limit(6)
    dilution = max(max(fit.spread, 1.0) ** 2 * fit.neighbours_factor for fit in fits)
    found: dict[int, str] = {}
    for k, photo in sorted(localised.items()):
        pose, own_pose = model.cam_from_sfm[k], photo.cam_from_local
        turn = so3_log(own_pose.rotation.T @ pose.rotation)
        offset = np.concatenate([turn, own_pose.center - pose.center])
        into_local = block_diag(pose.rotation.T, pose.rotation.T)
        longer = photo.camera.with_focal((1.0 + _FOCAL_REL) * photo.camera.focal_px)
        refined = model.cameras[int(model.camera_of[k])]
        lenses = sum(np.outer(by, by) for by in (pose_by_lens(photo, lens) for lens in (longer, refined)))
        own = into_local @ (np.nan_to_num(spread[k]) + lenses) @ into_local.T
        square = float(offset @ np.linalg.solve(photo.covariance * dilution + own, offset))
        if square > limit:
            found[k] = (
                f"the photo by itself is {float(np.linalg.norm(offset[3:])):.2f} m and "
                f"{float(np.degrees(np.linalg.norm(offset[:3]))):.2f} degrees from where the others put it, "
                f"chi-square {square:.0f}, {limit:.0f} is allowed"
            )
    return found


def pose_by_lens(photo: LocalisedPhoto, lens: Camera) -> FloatArray:
    """(6,) how far a localised pose is off (left perturbation), if the photo's lens is another one.

    The change of pose that moves the pixels of its points most alike.
    """
    seen = photo.cam_from_local.act(photo.points)
    moved_px = lens.project(seen) - photo.camera.project(seen)
    count = len(photo.pixels)
    if count < 4:
        return np.zeros(6)
    linear = linearise(
        [photo.camera],
        np.zeros(1, dtype=np.int64),
        [photo.cam_from_local],
        photo.points,
        np.arange(count),
        np.zeros(count, dtype=np.int64),
        photo.pixels,
    )
    good = np.isfinite(linear.by_pose).all(axis=(1, 2)) & np.isfinite(moved_px).all(axis=1)
    by_pose = linear.by_pose[good].reshape(-1, 6)
    return np.asarray(np.linalg.lstsq(by_pose, moved_px[good].reshape(-1), rcond=None)[0])
