"""How well a photo agrees with the scan where it was not taken.

Chance is not the only way to agreement: streets cross at right angles in every town, parking lots repeat
themselves. How far that goes depends on the photo and the scan, so the two are asked: the same search is
made around priors beside the place that is to be judged, and what agreement it finds there is what a wrong
place can have.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from featuredb.geometry.rigid3 import Rigid3
from ingest.register.frame.dense.confirmation import confirm_pose
from ingest.register.frame.dense.search import REACH_SIGMA, register_dense
from ingest.register.frame.views import FrameViews, first_look, turned_about_vertical
from ingest.register.frame_registration import FramePrior, RenderSource

_FINALISTS = 3  # as in the search at the photo's own place
_APART = 1.2  # of the search's reach: the other search is not to find the place that is judged
_SAME_VIEW = 0.25  # two poses that put the picture's middle nearer than this share of its width are one
_MIN_COVER = 0.5  # of what the photo's own prior sees; over less there is less to agree with
_KNOWN_HEADING_DEG = 30.0  # with a heading so sure a photo is not upside down


def agreement_elsewhere(
    views: FrameViews, prior: FramePrior, pose: Rigid3, source: RenderSource, max_places: int, enough: float
) -> tuple[int, float]:
    """The strongest agreement at wrong places: how many were searched, and the largest evidence (0 for none).

    Searches the photo beside `pose`, at no more than `max_places` places, until `enough` is reached.
    """
    most, count = 0.0, 0
    for other in _priors_beside(views, prior, pose):
        if count == max_places or most >= enough:
            break
        count += 1
        found = register_dense(views.gray, views.camera, other, views.cloud, source)
        for candidate in found[:_FINALISTS]:
            there = candidate.cam_from_local
            if other.cam_from_local.angle_to_deg(pose) < 90.0 and _same_view(views, there, pose):
                continue
            agreement = confirm_pose(
                views.gray, views.camera, there, views.cloud, source, views.options.confirm
            )
            most = max(most, agreement.log_nfa)
    return count, most


def _priors_beside(views: FrameViews, prior: FramePrior, pose: Rigid3) -> Iterator[FramePrior]:
    """The prior moved out of reach of the pose, to four sides, and turned round, where the scan is seen."""
    reach = REACH_SIGMA * (prior.sigma_horizontal_m + views.look.depth_m * np.radians(prior.sigma_tilt_deg))
    right = np.array([*prior.cam_from_local.rotation[0, :2], 0.0])
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 0.1 else right / np.linalg.norm(right)
    ahead = np.array([-right[1], right[0], 0.0])
    rotation = prior.cam_from_local.rotation
    for side in (right, ahead, -right, -ahead):
        center = pose.center + _APART * reach * side
        moved = replace(prior, cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center))
        look = first_look(views.cloud, views.camera, moved.cam_from_local)
        if look is not None and look.cover >= _MIN_COVER * views.look.cover:
            yield moved
    if prior.sigma_heading_deg <= _KNOWN_HEADING_DEG:
        yield replace(prior, cam_from_local=turned_about_vertical(prior.cam_from_local, 180.0))


def _same_view(views: FrameViews, pose: Rigid3, other: Rigid3) -> bool:
    """Whether two poses show about the same piece of ground."""
    camera, depth_m = views.camera, views.look.depth_m
    ray = camera.unproject(np.array([[camera.width / 2.0, camera.height / 2.0]]))[0]
    middle = depth_m * np.array([*ray, 1.0])
    apart_m = np.linalg.norm(pose.inverse().act(middle) - other.inverse().act(middle))
    return bool(apart_m < _SAME_VIEW * depth_m * camera.width / camera.focal_px)
