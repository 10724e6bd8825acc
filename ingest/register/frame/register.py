"""One photo registered to a scan, from a coarse prior (paper, section 2.3: building block B)."""

from dataclasses import asdict, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from featuredb.stage_clock import StageClock
from ingest.register.frame.candidates import Judged, best_candidate
from ingest.register.frame.elsewhere import agreement_elsewhere
from ingest.register.frame.features.search import FrameHypothesis, pose_options
from ingest.register.frame.options import FrameOptions
from ingest.register.frame.prior_fit import loosened, prior_sigmas
from ingest.register.frame.uncertainty import frame_covariance
from ingest.register.frame.verdict import (
    FrameEvidence,
    asks_elsewhere,
    cells_with_inliers,
    highest_elsewhere,
    verdict,
)
from ingest.register.frame.views import FrameViews, first_look
from ingest.register.frame_registration import (
    FramePrior,
    FrameReason,
    FrameRegistration,
)

_MIN_FOR_COVARIANCE = 6  # twice the least that determines a pose


def register_frame(
    image: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    options: FrameOptions | None = None,
) -> FrameRegistration:
    """Find the pose of a photo in a scan, or say why not.

    Args:
        image: (h, w) or (h, w, 3) BGR uint8, the pixels that `camera` describes.
        camera: calibrated intrinsics.
        prior: coarse pose in the frame of `cloud`, with honest standard deviations.
        cloud: the scan around it.

    Raises:
        ImageError: the image is not 8-bit, or not of the camera's size.
        MissingExtraError: numba is not installed.
    """
    options = options or FrameOptions()
    clock = StageClock()
    gray = _gray(image, camera)
    with clock.stage("look"):
        look = first_look(cloud, camera, prior)
    if look is None or look.cover < options.verdict.min_cover:
        cover = 0.0 if look is None else look.cover
        return _refused(
            "NO_SCAN",
            f"the scan covers {100 * cover:.0f} % of what the prior sees; is it of this place?",
            {"cover": cover},
            clock,
        )
    views = FrameViews(gray, camera, cloud, look, options)
    judged = best_candidate(views, prior, clock)
    if judged is None:
        return _refused("NO_CONSISTENT_POSE", "no pose has matches behind it", {}, clock)
    return _verdict(views, prior, judged, clock)


def _verdict(views: FrameViews, prior: FramePrior, judged: Judged, clock: StageClock) -> FrameRegistration:
    options, found = views.options, judged.found
    with clock.stage("verdict"):
        covariance = _covariance(views, prior, found)
        evidence = _evidence(views, prior, judged, covariance)
    if asks_elsewhere(evidence, options.verdict):
        with clock.stage("search elsewhere"):
            evidence = _compared(views, prior, judged, evidence)
    with clock.stage("verdict"):
        refusal = verdict(evidence, options.verdict)
    figures = asdict(evidence) | {
        "matched_by": found.kind,
        "confirmation": asdict(judged.confirmation),
        "depth_m": views.look.depth_m,
        "spacing_m": views.look.spacing_m,
        "focal_px": found.pose.camera.focal_px,
        "pose_tried": found.pose.cam_from_local.matrix().tolist(),
    }
    if refusal is not None:
        return _refused(*refusal, figures, clock)
    return FrameRegistration(
        cam_from_local=found.pose.cam_from_local,
        covariance=covariance,
        reason=None,
        message="",
        source=found.source,
        camera=found.pose.camera,
        points_local=found.inliers.points,
        pixels=found.inliers.pixels,
        evidence=figures,
        seconds=clock.seconds,
    )


def _covariance(views: FrameViews, prior: FramePrior, found: FrameHypothesis) -> FloatArray | None:
    """None where too few matches stand behind the pose to say."""
    options = views.options
    if len(found.inliers) < _MIN_FOR_COVARIANCE:
        return None
    return frame_covariance(
        found.inliers.pixels,
        found.inliers.points,
        found.pose,
        views.look.spacing_m,
        views.look.depth_m,
        pose_options(views),
        options.correlated_inliers,
        options.shared_point_share,
        loosened(prior, options.prior_slack),
    )


def _evidence(
    views: FrameViews, prior: FramePrior, judged: Judged, covariance: FloatArray | None
) -> FrameEvidence:
    found, confirmation = judged.found, judged.confirmation
    cells, agreement = 0, 0.0
    renderings = views.renders([found.pose.cam_from_local], views.options.min_side_px)
    if renderings:
        cells, agreement = cells_with_inliers(found.inliers.pixels, renderings[0].valid, views.camera)
    share = np.inf
    if covariance is not None:
        share = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])) / views.look.depth_m
    return FrameEvidence(
        inliers=len(found.inliers),
        candidates=found.candidates,
        log_nfa=found.log_nfa,
        confirmed=confirmation.confirmed,
        confirmation_pieces=confirmation.pieces,
        confirmation_log_nfa=confirmation.log_nfa,
        confirmation_message=confirmation.message,
        cells=cells,
        agreement=agreement,
        rival_share=found.rival_share,
        prior_sigmas=prior_sigmas(prior, found.pose.cam_from_local),
        position_sigma_share=share,
        relief_only=found.source == "shaded",
    )


def _compared(views: FrameViews, prior: FramePrior, judged: Judged, evidence: FrameEvidence) -> FrameEvidence:
    """With how well the photo agrees with the scan at places where it cannot be."""
    options, found = views.options.verdict, judged.found
    elsewhere = agreement_elsewhere(
        views,
        prior,
        found.pose.cam_from_local,
        found.source,
        options.max_places_elsewhere,
        highest_elsewhere(evidence.confirmation_log_nfa, options),
    )
    return replace(evidence, places_elsewhere=elsewhere.places, elsewhere_log_nfa=elsewhere.log_nfa)


def _refused(
    reason: FrameReason, message: str, evidence: dict[str, object], clock: StageClock
) -> FrameRegistration:
    return FrameRegistration(
        cam_from_local=None,
        covariance=None,
        reason=reason,
        message=message,
        source=None,
        points_local=np.empty((0, 3)),
        pixels=np.empty((0, 2)),
        evidence=evidence,
        seconds=clock.seconds,
    )


def _gray(image: NDArray[np.uint8], camera: Camera) -> NDArray[np.uint8]:
    if image.dtype != np.uint8 or image.shape[:2] != (camera.height, camera.width):
        raise ImageError(
            f"register_frame: expected uint8 pixels of the camera's size {camera.width}x{camera.height}, "
            f"found {image.dtype} {image.shape}"
        )
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
