"""A photo registered by dense templates alone: searched, refined by intensities, confirmed by pieces."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from ingest.register.confirmation import Confirmation, ConfirmOptions, confirm_pose
from ingest.register.dense_search import DenseOptions, DensePose, register_dense
from ingest.register.frame_registration import FramePrior, RenderSource
from ingest.register.intensity import refine_by_intensity

_FINALISTS = (
    3  # the summed scores of the first few are often nearly equal; pieces on their own tell them apart
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
    confirm = confirm or ConfirmOptions()
    judged = []
    for pose in found[:_FINALISTS]:
        refined = refine_by_intensity(photo_gray, camera, pose.cam_from_local, cloud, source)
        # Where what stands up leans otherwise than a camera would see it, the whole picture's measure may lead
        # away: the pieces decide between the two.
        candidates = [pose, replace(pose, cam_from_local=refined.cam_from_local)][: 1 + refined.moved]
        judged += [
            (c, confirm_pose(photo_gray, camera, c.cam_from_local, cloud, source, confirm))
            for c in candidates
        ]
    if not judged:
        return None, None
    return max(judged, key=lambda item: (item[1].agreeing, item[0].score))
