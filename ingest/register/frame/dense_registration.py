"""A photo registered by dense templates alone: searched, refined by intensities, confirmed by pieces."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from ingest.register.frame.confirmation import Confirmation, ConfirmOptions, confirm_pose
from ingest.register.frame.dense_search import DenseOptions, DensePose, register_dense
from ingest.register.frame.intensity import refine_by_intensity
from ingest.register.frame_registration import FramePrior, RenderSource

_FINALISTS = (
    3  # the summed scores of the first few are often nearly equal; pieces on their own tell them apart
)

# Where nothing but the pictures' own agreement is asked, over views of a few hundred pixels. Larger pieces
# agree more often where the pose is right and no more often where it is wrong. Of airborne intensity under
# windows of an ortho image up to 0.19 agree under poses that are wrong, 0.23 and more under nearly all right
# ones (tools/autzen_windows.py); of the evidence, wrong ones have up to 0.6, right ones from 2.7.
PICTURES_ALONE = ConfirmOptions(
    min_piece_px=24, max_piece_px=56, min_agreeing=0.21, min_low_agreeing=0.25, min_log_nfa=2.5
)


def register_by_pictures(
    photo_gray: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    source: RenderSource,
    search: DenseOptions | None = None,
    confirm: ConfirmOptions | None = None,
) -> tuple[DensePose | None, Confirmation | None]:
    """The pose in which most pieces of the photo lie where it puts them, and whether that is enough.

    Returns:
        The pose is the best found also where it is not confirmed; (None, None) where there was nothing to
        search for.
    """
    found = register_dense(photo_gray, camera, prior, cloud, source, search or DenseOptions())
    confirm = confirm or PICTURES_ALONE
    if not found:
        return None, None

    def judge(pose: DensePose) -> tuple[DensePose, Confirmation]:
        return pose, confirm_pose(photo_gray, camera, pose.cam_from_local, cloud, source, confirm)

    best = max((judge(pose) for pose in found[:_FINALISTS]), key=_standing)
    refined = refine_by_intensity(photo_gray, camera, best[0].cam_from_local, cloud, source)
    # Where what stands up leans as no camera sees it, the whole picture's measure may lead away: the pieces
    # decide between the two.
    if refined.moved:
        best = max(best, judge(replace(best[0], cam_from_local=refined.cam_from_local)), key=_standing)
    return best


def _standing(judged: tuple[DensePose, Confirmation]) -> tuple[bool, int, float]:
    pose, confirmation = judged
    return confirmation.confirmed, confirmation.agreeing, pose.score
