"""A frame whose pose is known to some pixels, fitted to the scan from there: nothing is searched for.

For the frames of a film that is followed. The pose found is shown to the pictures as any other is.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from featuredb.stage_clock import StageClock
from ingest.register.frame.candidates import by_agreement, polished
from ingest.register.frame.features.matching import joined
from ingest.register.frame.features.search import FrameHypothesis, pose_options
from ingest.register.frame.options import FrameOptions
from ingest.register.frame.prior_fit import loosened
from ingest.register.frame.uncertainty import frame_covariance
from ingest.register.frame.views import FrameViews, first_look
from ingest.register.frame_registration import FramePrior, FrameReason, RenderSource
from reloc.localise.pose import PoseHypothesis

_MIN_INLIERS = 20  # as the verdict on a frame asks


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NearFit:
    """A pose that the pictures confirm.

    Attributes:
        pose: with the camera. source: what was rendered.
        covariance: (6, 6) of the left perturbation of cam_from_local.
    """

    pose: PoseHypothesis
    source: RenderSource
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class NoNearFit:
    """Why there is none; with the share of pieces that agree with the best fit, 0 without one."""

    reason: FrameReason
    message: str


def fit_near(
    gray: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    source: RenderSource,
    options: FrameOptions,
) -> NearFit | NoNearFit:
    """Fit the pose of a frame (h, w) from one that is right to some pixels.

    Args:
        prior: the pose to start from, with how far it may be off.
        source: of the frames before, with which this one is compared first.
    """
    look = first_look(cloud, camera, prior)
    if look is None or look.cover < options.verdict.min_cover:
        cover = 0.0 if look is None else look.cover
        return NoNearFit(reason="NO_SCAN", message=f"the scan covers {100 * cover:.0f} % of what is in view")
    views = FrameViews(gray, camera, cloud, look, options)
    start = FrameHypothesis(
        pose=PoseHypothesis(
            cam_from_local=prior.cam_from_local,
            camera=camera,
            camera_source="request",
            inliers=np.zeros(0, dtype=bool),
            prior_focal_px=camera.focal_px,
        ),
        source=source,
        kind="oriented",
        matches=joined([]),
        inliers=joined([]),
        candidates=0,
        log_nfa=0.0,
        rival_share=0.0,
    )
    loose = loosened(prior, options.prior_slack)
    judged = polished(views, loose, start, StageClock())
    if not judged.confirmation.confirmed:
        # Other light, other seasons: what agreed for the frames before need not for this one.
        other = by_agreement(views, replace(start, kind="dense"))
        judged = polished(views, loose, other.found, StageClock())
    found, confirmation = judged.found, judged.confirmation
    if not confirmation.confirmed:
        return NoNearFit(reason="NOT_CONFIRMED", message=confirmation.message)
    if len(found.inliers) < _MIN_INLIERS:
        return NoNearFit(
            reason="TOO_FEW_MATCHES",
            message=f"{len(found.inliers)} independent inliers, {_MIN_INLIERS} needed",
        )
    covariance = frame_covariance(
        found.inliers.pixels,
        found.inliers.points,
        found.pose,
        look.spacing_m,
        look.depth_m,
        pose_options(views),
        options.correlated_inliers,
        options.shared_point_share,
        loose,
    )
    return NearFit(pose=found.pose, source=found.source, covariance=covariance)
