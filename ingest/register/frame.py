"""One photo registered to a scan, from a coarse prior (paper, section 2.3: building block B)."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.camera import Camera
from featuredb.render.cloud import PointCloud
from ingest.register.frame_options import FrameOptions
from ingest.register.frame_registration import (
    FramePrior,
    FrameReason,
    FrameRegistration,
    RenderSource,
)
from ingest.register.frame_search import (
    FrameHypothesis,
    RenderGroup,
    fan_groups,
    guided,
    oriented_features_suffice,
    pose_options,
    search,
    star_groups,
)
from ingest.register.frame_uncertainty import frame_covariance
from ingest.register.frame_verdict import FrameEvidence, cells_with_inliers, prior_sigmas, verdict
from ingest.register.frame_views import FrameViews, first_look

_LOG = logging.getLogger(__name__)
_GUIDED_ROUNDS = 2


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
    found = _search(views, prior, clock)
    if found is None:
        return _refused("NO_CONSISTENT_POSE", "no pose has matches behind it", {}, clock)
    first = found
    side = max(camera.width, camera.height)
    for turn in range(_GUIDED_ROUNDS):
        with clock.stage(f"guided {turn + 1}"):
            better = guided(views, found, options.guided_radius_rel * side / 3.0**turn)
        if better is None:
            break
        found = better
    return _judged(views, prior, first, found, clock)


def available_sources(cloud: PointCloud) -> tuple[RenderSource, ...]:
    """What can be rendered of a scan, most telling first."""
    sources: list[RenderSource] = []
    if cloud.rgb is not None:
        sources.append("rgb")
    if cloud.intensity is not None:
        sources.append("intensity")
    return (*sources, "shaded")


def _search(views: FrameViews, prior: FramePrior, clock: "_Clock") -> FrameHypothesis | None:
    """The hypothesis with most evidence, over sources and kinds of features; the first decisive one ends it."""
    options = views.options
    with clock.stage("render star"):
        star = star_groups(views, prior)
    fan: list[RenderGroup] = []
    best: FrameHypothesis | None = None
    for source in options.sources or available_sources(views.cloud):
        for upright in _kinds(prior, options):
            if upright and not fan:
                with clock.stage("render fan"):
                    fan = fan_groups(views, prior)
            with clock.stage(f"search {source} {'upright' if upright else 'oriented'}"):
                found = search(views, [*star, *fan] if upright else star, source, upright)
            if found is not None:
                _LOG.debug("%s upright=%s: log NFA %.1f", source, upright, found.log_nfa)
            if found is not None and (best is None or found.log_nfa > best.log_nfa):
                best = found
            if best is not None and best.log_nfa >= options.decisive_log_nfa:
                return best
    return best


def _kinds(prior: FramePrior, options: FrameOptions) -> tuple[bool, ...]:
    """Upright features first where the heading is known; without, those with orientation cost less."""
    unknown = prior.sigma_heading_deg >= options.star.full_circle_sigma_deg
    if not unknown:
        return (True, False)
    return (False, True) if oriented_features_suffice(prior) else (True,)


def _judged(
    views: FrameViews, prior: FramePrior, first: FrameHypothesis, found: FrameHypothesis, clock: "_Clock"
) -> FrameRegistration:
    options, camera = views.options, found.pose.camera
    with clock.stage("verdict"):
        covariance = frame_covariance(
            found.inliers.pixels,
            found.inliers.points,
            found.pose,
            views.look.spacing_m,
            views.look.depth_m,
            pose_options(views),
            options.correlated_inliers,
            options.shared_point_share,
        )
        rendering = views.renders([found.pose.cam_from_local], options.min_side_px)
        cells, agreement = (0, 0.0)
        if rendering:
            cells, agreement = cells_with_inliers(found.inliers.pixels, rendering[0].valid, camera)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
        evidence = FrameEvidence(
            inliers=len(found.inliers),
            candidates=first.candidates,
            log_nfa=first.log_nfa,
            cells=cells,
            agreement=agreement,
            rival_inliers=first.rival_inliers,
            first_inliers=len(first.inliers),
            prior_sigmas=prior_sigmas(prior, found.pose.cam_from_local),
            position_sigma_share=sigma_m / views.look.depth_m,
        )
        refusal = verdict(evidence, options.verdict)
    figures = asdict(evidence) | {
        "upright": first.upright,
        "depth_m": views.look.depth_m,
        "spacing_m": views.look.spacing_m,
        "focal_px": camera.focal_px,
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
        points_local=found.inliers.points,
        pixels=found.inliers.pixels,
        evidence=figures,
        seconds=clock.seconds,
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
            f"register_frame: expected uint8 pixels of the camera's size {camera.width}x{camera.height}, found "
            f"{image.dtype} {image.shape}"
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
