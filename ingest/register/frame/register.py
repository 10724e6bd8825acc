"""One photo registered to a scan, from a coarse prior (paper, section 2.3: building block B)."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geo.words import way_words
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from featuredb.stage_clock import StageClock
from ingest.register.frame.candidates import (
    Judged,
    agreement_elsewhere,
    best_candidate,
    by_agreement,
    polished,
)
from ingest.register.frame.dense.fit import confirmed, dense_fitted
from ingest.register.frame.features.search import FrameHypothesis, pose_options, unmatched
from ingest.register.frame.prior_fit import CORRELATED_INLIERS, loosened, prior_information, prior_sigmas
from ingest.register.frame.verdict import (
    MAX_PLACES_ELSEWHERE,
    MAX_PRIOR_SIGMAS,
    MIN_INLIERS,
    FrameEvidence,
    asks_elsewhere,
    beyond_doubt,
    cells_with_inliers,
    highest_elsewhere,
    verdict,
)
from ingest.register.frame.views import DEFAULTS, MIN_COVER, MIN_SIDE_PX, FrameOptions, FrameViews, first_look
from ingest.register.frame_registration import FramePrior, FrameReason, FrameRegistration, RenderSource
from reloc.localise.pose import pose_uncertainty
from reloc.tracking.pose_fit import of_camera

_MIN_FOR_COVARIANCE = 6  # twice the least that determines a pose
# Standard deviation of what all inliers share, as a share of the scan's spacing; by photos of the simulated
# town.
_SHARED_POINT_SHARE = 0.1


def register_frame(
    gray: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    options: FrameOptions = DEFAULTS,
) -> FrameRegistration:
    """Find the pose of a photo in a scan, or say why not.

    Args:
        gray: (h, w) uint8, the pixels that `camera` describes.
        camera: calibrated intrinsics.
        prior: coarse pose in the frame of `cloud`, with honest standard deviations.
        cloud: the scan around it.

    Raises:
        ImageError: the image is not 8-bit, or not of the camera's size.
    """
    if gray.dtype != np.uint8 or gray.shape != (camera.height, camera.width):
        raise ImageError(
            f"register_frame: expected uint8 pixels of the camera's size {camera.width}x{camera.height}, "
            f"found {gray.dtype} {gray.shape}"
        )
    views = _views(gray, camera, prior, cloud, options)
    if isinstance(views, FrameRegistration):
        return views
    judged = best_candidate(views, prior)
    if judged is None:
        return _refused("NO_CONSISTENT_POSE", "no pose has matches behind it", views.clock)
    return _verdict(views, prior, judged)


def fit_near(
    gray: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    source: RenderSource,
    options: FrameOptions,
) -> FrameRegistration:
    """Fit the pose of a frame (h, w) from one that is right to some pixels; nothing is searched for.

    For the frames of a film that is followed. The pose found is shown to the pictures as any other is.

    Args:
        prior: the pose to start from, with how far it may be off.
        source: of the frames before, with which this one is compared first.
    """
    views = _views(gray, camera, prior, cloud, options)
    if isinstance(views, FrameRegistration):
        return views
    start, loose = unmatched(prior.cam_from_local, camera, source), loosened(prior)
    judged = polished(views, loose, start)
    if not judged.confirmation.confirmed:
        # Other light, other seasons: what agreed for the frames before need not for this one.
        other = by_agreement(views, start).found
        if other.source != source:
            judged = polished(views, loose, other)
    found, confirmation = judged.found, judged.confirmation
    if not confirmation.confirmed:
        return _refused("NOT_CONFIRMED", confirmation.message, views.clock)
    return _fitted(views, prior, found, {})


def fit_vouched_for(
    gray: NDArray[np.uint8],
    camera: Camera,
    prior: FramePrior,
    cloud: PointCloud,
    source: RenderSource,
    evidence: dict[str, Any],
) -> FrameRegistration:
    """Fit the pose of a photo (h, w) from one that other photos of its map vouch for; it is not asked again.

    Args:
        prior: the pose that all photos give together, with how far this one may be off it.
        evidence: of all photos.
    """
    views = _views(gray, camera, prior, cloud, DEFAULTS)
    if isinstance(views, FrameRegistration):
        return views
    with views.clock.stage("fit"):
        start = unmatched(prior.cam_from_local, camera, source)
        found = dense_fitted(views, loosened(prior), start) or start
    return _fitted(views, prior, found, evidence, MAX_PRIOR_SIGMAS)


def _views(
    gray: NDArray[np.uint8], camera: Camera, prior: FramePrior, cloud: PointCloud, options: FrameOptions
) -> FrameViews | FrameRegistration:
    """Photo and scan, or the refusal where the scan is not in view."""
    clock = StageClock()
    with clock.stage("look"):
        look = first_look(cloud, camera, prior.cam_from_local)
    if look is not None and look.cover >= MIN_COVER:
        return FrameViews(gray, camera, cloud, look, options, clock)
    cover = 0.0 if look is None else look.cover
    center = prior.cam_from_local.center[:2]
    way = np.clip(center, cloud.xyz[:, :2].min(axis=0), cloud.xyz[:, :2].max(axis=0)) - center
    beside = f" and lies {way_words(*way.tolist())} of the camera" if np.hypot(*way) >= 1.0 else ""
    words = f"the scan covers {100 * cover:.0f} % of what the prior sees{beside}; is it of this place?"
    return _refused("NO_SCAN", words, clock, {"cover": cover})


def _fitted(
    views: FrameViews,
    prior: FramePrior,
    found: FrameHypothesis,
    evidence: dict[str, Any],
    most_away: float = np.inf,
) -> FrameRegistration:
    """A fitted pose that needs no more than inliers, and to lie near its prior: `most_away` deviations."""
    if len(found.inliers) < MIN_INLIERS:
        words = f"{len(found.inliers)} independent inliers, {MIN_INLIERS} needed"
        return _refused("TOO_FEW_MATCHES", words, views.clock)
    away = prior_sigmas(prior, found.pose.cam_from_local)
    if away > most_away:
        words = f"the pose lies {away:.1f} deviations from where all photos together have it"
        return _refused("CONTRADICTS_PRIOR", words, views.clock)
    return _accepted(views, found, frame_covariance(views, prior, found), evidence)


def _verdict(views: FrameViews, prior: FramePrior, judged: Judged) -> FrameRegistration:
    found = judged.found
    with views.clock.stage("verdict"):
        covariance = frame_covariance(views, prior, found)
        evidence = _evidence(views, prior, judged, covariance)
    if asks_elsewhere(evidence):
        with views.clock.stage("search elsewhere"):
            bears = highest_elsewhere(evidence.confirmation.log_nfa)
            places, log_nfa = agreement_elsewhere(
                views, prior, found.pose.cam_from_local, found.source, MAX_PLACES_ELSEWHERE, bears
            )
            evidence = replace(evidence, places_elsewhere=places, elsewhere_log_nfa=log_nfa)
    with views.clock.stage("verdict"):
        refusal = verdict(evidence)
    figures = asdict(evidence) | {
        "matched_by": found.kind,
        "depth_m": views.look.depth_m,
        "spacing_m": views.look.spacing_m,
        "focal_px": found.pose.camera.focal_px,
        "pose_tried": found.pose.cam_from_local.matrix().tolist(),
    }
    if refusal is not None:
        return _refused(*refusal, views.clock, figures)
    return _accepted(views, found, covariance, figures)


def frame_covariance(views: FrameViews, prior: FramePrior, found: FrameHypothesis) -> FloatArray | None:
    """Covariance (6, 6) of the left perturbation of cam_from_local; None where too few matches tell it.

    `CORRELATED_INLIERS` correspondences count as one. What all share, a shift of the whole scan's appearance
    by a part of its point spacing, shows in no residual and is added to the position.
    """
    if len(found.inliers) < _MIN_FOR_COVARIANCE:
        return None
    pixels, points, look = found.inliers.pixels, found.inliers.points, views.look
    spread = (0.3 * look.spacing_m) ** 2 * np.eye(3)  # a point stands for a cell of its spacing
    spreads = np.broadcast_to(spread, (len(points), 3, 3))
    covariance = pose_uncertainty(pixels, points, spreads, found.pose, pose_options(views)).covariance
    shared = (_SHARED_POINT_SHARE * look.spacing_m) ** 2
    covariance = CORRELATED_INLIERS * covariance + np.diag([shared / look.depth_m**2] * 3 + [shared] * 3)
    pose = found.pose.cam_from_local
    information = np.linalg.inv(covariance) + prior_information(pose, loosened(prior))
    # `of_camera` of the inverse leads from local axes back to the left perturbation.
    left = of_camera(pose.inverse(), np.asarray(np.linalg.inv(information), dtype=np.float64))
    return np.asarray((left + left.T) / 2.0, dtype=np.float64)


def _evidence(
    views: FrameViews, prior: FramePrior, judged: Judged, covariance: FloatArray | None
) -> FrameEvidence:
    found = judged.found
    cells, agreement = 0, 0.0
    renderings = views.renders([found.pose.cam_from_local], MIN_SIDE_PX)
    if renderings:
        cells, agreement = cells_with_inliers(found.inliers.pixels, renderings[0].valid, views.camera)
    share = np.inf
    if covariance is not None:
        share = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])) / views.look.depth_m
    by_relief, relief = found.source == "shaded", None
    if not by_relief and not beyond_doubt(found.log_nfa, judged.confirmation):
        relief = confirmed(views, replace(found, source="shaded"))
    return FrameEvidence(
        inliers=len(found.inliers),
        candidates=found.candidates,
        log_nfa=found.log_nfa,
        confirmation=judged.confirmation,
        cells=cells,
        agreement=agreement,
        rival_share=found.rival_share,
        prior_sigmas=prior_sigmas(prior, found.pose.cam_from_local),
        position_sigma_share=share,
        relief=relief,
        relief_only=by_relief,
    )


def _accepted(
    views: FrameViews, found: FrameHypothesis, covariance: FloatArray | None, evidence: dict[str, Any]
) -> FrameRegistration:
    return FrameRegistration(
        cam_from_local=found.pose.cam_from_local,
        covariance=covariance,
        reason=None,
        message="",
        source=found.source,
        camera=found.pose.camera,
        points_local=found.inliers.points,
        pixels=found.inliers.pixels,
        evidence=evidence,
        seconds=views.clock.seconds,
    )


def _refused(
    reason: FrameReason, message: str, clock: StageClock, evidence: dict[str, Any] | None = None
) -> FrameRegistration:
    return FrameRegistration(reason=reason, message=message, evidence=evidence or {}, seconds=clock.seconds)
