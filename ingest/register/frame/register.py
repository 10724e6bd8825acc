"""One photo registered to a scan, from a coarse prior (paper, section 2.3: building block B)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from ingest.register.frame.confirmation import Confirmation
from ingest.register.frame.dense import confirmed, dense_fitted, dense_hypotheses, intensity_refined
from ingest.register.frame.options import FrameOptions
from ingest.register.frame.search import (
    FrameHypothesis,
    RenderGroup,
    fan_groups,
    guided,
    oriented_features_suffice,
    pose_options,
    search,
    star_groups,
)
from ingest.register.frame.uncertainty import focal_sigma_rel, frame_covariance
from ingest.register.frame.verdict import FrameEvidence, cells_with_inliers, prior_sigmas, verdict
from ingest.register.frame.views import FrameViews, first_look
from ingest.register.frame_registration import (
    FramePrior,
    FrameReason,
    FrameRegistration,
    RenderSource,
)

_GUIDED_ROUNDS = 2
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
        camera: calibrated intrinsics; with `options.estimate_focal` the focal length is a start only.
        prior: coarse pose in the frame of `cloud`, with honest standard deviations.
        cloud: the scan around it.

    Raises:
        ImageError: the image is not 8-bit, or not of the camera's size.
        MissingExtraError: numba is not installed.
    """
    options = options or FrameOptions()
    clock = _Clock()
    gray = _gray(image, camera)
    if options.estimate_focal and camera.model != "SIMPLE_RADIAL":
        camera = Camera.from_focal(camera.width, camera.height, camera.focal_px)
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
    judged = _best(views, prior, clock)
    if judged is None:
        return _refused("NO_CONSISTENT_POSE", "no pose has matches behind it", {}, clock)
    return _verdict(views, prior, judged, clock)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Judged:
    """A fitted pose with what the pictures say of it."""

    found: FrameHypothesis
    confirmation: Confirmation


def _best(views: FrameViews, prior: FramePrior, clock: "_Clock") -> _Judged | None:
    """The first pose that is beyond doubt, or of all found the one that the pictures confirm most."""
    options = views.options
    judged: list[_Judged] = []
    for start in _starts(views, prior, clock):
        judged.append(_polished(views, start, clock))
        confirmation = judged[-1].confirmation
        # Decisive features stand alone where the pictures have too little to compare.
        silent = confirmation.pieces < options.verdict.min_confirmation_pieces
        if start.log_nfa >= options.decisive_log_nfa and (confirmation.confirmed or silent):
            return judged[-1]
        if confirmation.confirmed and confirmation.log_nfa >= options.sure_confirmation_log_nfa:
            return judged[-1]
    return max(judged, key=lambda j: j.confirmation.log_nfa, default=None)


def _starts(views: FrameViews, prior: FramePrior, clock: "_Clock") -> Iterator[FrameHypothesis]:
    """Poses to begin with, made as they are asked for: by source, features first, then dense templates."""
    options = views.options
    with clock.stage("render star"):
        star = star_groups(views, prior)
    fan: list[RenderGroup] | None = None
    sources = options.sources or available_sources(views.cloud)
    for source in sources:
        for upright in _kinds(prior, options):
            if upright and fan is None:
                with clock.stage("render fan"):
                    fan = fan_groups(views, prior)
            groups = [*star, *(fan or [])] if upright else star
            with clock.stage(f"search {source} {'upright' if upright else 'oriented'}"):
                found = search(views, groups, source, upright)
            if found is not None and found.log_nfa >= options.min_log_nfa:
                yield found
        # Shaded relief has few edges of its own; where the scan has more to show, the search goes without.
        if source != "shaded" or len(sources) == 1:
            with clock.stage(f"search {source} dense"):
                dense = dense_hypotheses(views, prior, source)
            yield from dense


def _polished(views: FrameViews, found: FrameHypothesis, clock: "_Clock") -> _Judged:
    """Fitted by guided features where colours are rendered, else by pieces; and shown to the pictures."""
    by_features = found.source == "rgb" and found.kind != "dense"
    with clock.stage("fit"):
        fitted = _guided(views, found) if by_features else dense_fitted(views, found, views.options.dense_fit)
    found = fitted or found
    with clock.stage("confirm"):
        judged = _Judged(found=found, confirmation=confirmed(views, found))
    if not views.options.refine or not judged.confirmation.confirmed:
        return judged
    with clock.stage("refine"):
        return _refined(views, judged)


def _refined(views: FrameViews, judged: _Judged) -> _Judged:
    """By intensities, where the photo's pieces agree better with the refined pose than the fitted one."""
    refined = intensity_refined(views, judged.found)
    again = _Judged(found=refined, confirmation=confirmed(views, refined))
    return again if again.confirmation.score > judged.confirmation.score else judged


def _guided(views: FrameViews, found: FrameHypothesis) -> FrameHypothesis:
    side = max(views.camera.width, views.camera.height)
    for turn in range(_GUIDED_ROUNDS):
        better = guided(views, found, views.options.guided_radius_rel * side / 3.0**turn)
        if better is None:
            break
        found = better
    return found


def available_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """What can be rendered of a scan, most telling first."""
    sources: list[RenderSource] = []
    if cloud.rgb is not None:
        sources.append("rgb")
    if cloud.intensity is not None:
        sources.append("intensity")
    return (*sources, "shaded")


def _kinds(prior: FramePrior, options: FrameOptions) -> tuple[bool, ...]:
    """Upright features first where the heading is known; without, those with orientation cost less."""
    unknown = prior.sigma_heading_deg >= options.star.full_circle_sigma_deg
    if not unknown:
        return (True, False)
    return (False, True) if oriented_features_suffice(prior) else (True,)


def _verdict(views: FrameViews, prior: FramePrior, judged: _Judged, clock: "_Clock") -> FrameRegistration:
    options, found = views.options, judged.found
    with clock.stage("verdict"):
        covariance = _covariance(views, found)
        evidence = _evidence(views, prior, judged, covariance)
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


def _covariance(views: FrameViews, found: FrameHypothesis) -> FloatArray | None:
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
    )


def _evidence(
    views: FrameViews, prior: FramePrior, judged: _Judged, covariance: FloatArray | None
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
        focal_sigma_rel=focal_sigma_rel(
            found.inliers.pixels, found.inliers.points, found.pose, views.options.correlated_inliers
        ),
    )


def _refused(
    reason: FrameReason, message: str, evidence: dict[str, object], clock: "_Clock"
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


class _Clock:
    """Wall seconds by stage, in order."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
