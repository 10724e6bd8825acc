"""Whether a registered frame is believed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from ingest.register.frame_registration import FramePrior, FrameReason


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictOptions:
    """Where the line is. tools/frame_evaluation.py draws the distributions behind the numbers.

    Attributes:
        min_cover: smallest share of a render that shows the scan.
        min_inliers: fewer independent inliers are never believed.
        min_agreement: smallest share of the parts of the photo where the scan should be seen that hold
            inliers.
        min_cells: and the smallest number of such parts, of a hundred: a pose needs width.
        min_log_nfa_alone: features with that much evidence among their unguided matches need no confirmation
            where the pictures have fewer than `min_confirmation_pieces` pieces to compare.
        min_confirmation_log_nfa: evidence of the pictures that a pose without so many features needs. It is
            the best of very many that were tried, and towns resemble each other: of 20 photos of another town
            the strongest reached 14.3; of the right poses that need it the weakest had 10.0, the next 20.9.
        rival_share: a pose elsewhere with this share of the inliers makes the registration ambiguous.
        max_prior_sigmas: largest distance from the prior, in its own standard deviations over all six
            axes together. Generous: people and devices understate their errors.
        max_position_sigma_share: largest standard deviation of the position, as a share of the distance to
            what is seen; above it the geometry does not determine the pose.
        max_focal_sigma_rel: largest standard deviation of an estimated focal length.
    """

    min_cover: float = 0.03
    min_inliers: int = 20
    min_agreement: float = 0.2
    min_cells: int = 6
    min_log_nfa_alone: float = 60.0
    min_confirmation_pieces: int = 25
    min_confirmation_log_nfa: float = 20.0
    rival_share: float = 0.5
    max_prior_sigmas: float = 6.0
    max_position_sigma_share: float = 0.05
    max_focal_sigma_rel: float = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameEvidence:
    """Figures behind the verdict on one frame.

    Attributes:
        inliers: independent correspondences that agree with the pose.
        candidates, log_nfa: matches of the first round and the evidence among them, see VerdictOptions.
        confirmed, confirmation_pieces, confirmation_log_nfa, confirmation_message:
            see ingest.register.frame.confirmation.
        cells: parts of the photo (of a hundred) that hold inliers. agreement: their share of those where the
            scan is seen.
        rival_share: support of the best pose elsewhere in the first round, as a share of this one's.
        prior_sigmas: distance from the prior.
        position_sigma_share: see VerdictOptions. focal_sigma_rel: of an estimated focal length, else 0.
    """

    inliers: int
    candidates: int
    log_nfa: float
    confirmed: bool
    confirmation_pieces: int
    confirmation_log_nfa: float
    confirmation_message: str
    cells: int
    agreement: float
    rival_share: float
    prior_sigmas: float
    position_sigma_share: float
    focal_sigma_rel: float = 0.0


def verdict(evidence: FrameEvidence, options: VerdictOptions) -> tuple[FrameReason, str] | None:
    """None if the pose is believed, else the reason and a sentence with the figures."""
    e, o = evidence, options
    if e.inliers < o.min_inliers:
        return "TOO_FEW_MATCHES", f"{e.inliers} independent inliers, {o.min_inliers} needed"
    # Pictures that show too little of the scan to be asked contradict nothing;
    # decisive features need no help.
    silent = e.confirmation_pieces < o.min_confirmation_pieces and e.log_nfa >= o.min_log_nfa_alone
    if not e.confirmed and not silent:
        return "NOT_CONFIRMED", f"the pictures do not agree at the pose found: {e.confirmation_message}"
    if e.log_nfa < o.min_log_nfa_alone and e.confirmation_log_nfa < o.min_confirmation_log_nfa:
        return (
            "NOT_CONFIRMED",
            f"the pictures agree too little at a pose that few features speak for: evidence of "
            f"10^-{e.confirmation_log_nfa:.1f}, 10^-{o.min_confirmation_log_nfa:g} needed",
        )
    if e.cells < o.min_cells or e.agreement < o.min_agreement:
        return (
            "NO_CONSISTENT_POSE",
            f"inliers lie in {e.cells} of a hundred parts of the photo, {100 * e.agreement:.0f} % of those "
            f"where the scan should be seen; {o.min_cells} and {100 * o.min_agreement:.0f} % needed",
        )
    if e.rival_share >= o.rival_share:
        return "AMBIGUOUS", f"a pose elsewhere has {100 * e.rival_share:.0f} % of this one's inliers"
    if e.position_sigma_share > o.max_position_sigma_share or e.focal_sigma_rel > o.max_focal_sigma_rel:
        return (
            "NO_CONSISTENT_POSE",
            f"the matches do not determine the pose: position known to {100 * e.position_sigma_share:.1f} % "
            f"of the distance, focal length to {100 * e.focal_sigma_rel:.1f} %; over flat ground a focal "
            "length cannot be told from a distance: give a calibrated camera",
        )
    if e.prior_sigmas > o.max_prior_sigmas:
        return (
            "CONTRADICTS_PRIOR",
            f"the pose lies {e.prior_sigmas:.1f} deviations from the prior, {o.max_prior_sigmas:.0f} "
            "allowed; if the prior's deviations are too small, give larger ones",
        )
    return None


def prior_sigmas(prior: FramePrior, cam_from_local: Rigid3) -> float:
    """Distance of a pose from the prior in standard deviations over all axes together.

    A heading is a rotation about the vertical, tilt what is left; an unknown heading counts nothing.
    """
    offset = cam_from_local.center - prior.cam_from_local.center
    sigma_m = np.array([prior.sigma_horizontal_m, prior.sigma_horizontal_m, prior.sigma_vertical_m])
    turn = np.degrees(so3_log(cam_from_local.rotation.T @ prior.cam_from_local.rotation))
    sigma_deg = np.array([prior.sigma_tilt_deg, prior.sigma_tilt_deg, prior.sigma_heading_deg])
    if prior.sigma_heading_deg >= 180.0:
        turn = _tilt_deg(prior.cam_from_local, cam_from_local)
    return float(np.sqrt(np.sum((offset / sigma_m) ** 2) + np.sum((turn / sigma_deg) ** 2)))


def _tilt_deg(prior: Rigid3, pose: Rigid3) -> FloatArray:
    """Difference of the vertical in camera axes: rotations of pitch and roll, none about the vertical."""
    up_prior, up_pose = prior.rotation[:, 2], pose.rotation[:, 2]
    cross = np.cross(up_prior, up_pose)
    angle = np.degrees(np.arctan2(np.linalg.norm(cross), up_prior @ up_pose))
    return np.array([angle, 0.0, 0.0])


def cells_with_inliers(pixels: FloatArray, valid: NDArray[np.bool_], camera: Camera) -> tuple[int, float]:
    """How many parts of a 10x10 grid over the photo hold inliers, and their share of those with the scan.

    Args:
        pixels: (k, 2) full-size pixels. valid: (h, w) of a render from the pose.
    """
    height, width = valid.shape
    rows = np.arange(height) * 10 // height
    columns = np.arange(width) * 10 // width
    shown = np.zeros(100)
    np.add.at(shown, (rows[:, None] * 10 + columns[None]).ravel(), valid.ravel())
    expected = shown >= 0.5 * width * height / 100.0
    held = np.zeros(100, dtype=bool)
    column = np.clip((pixels[:, 0] * 10 / camera.width).astype(np.int64), 0, 9)
    row = np.clip((pixels[:, 1] * 10 / camera.height).astype(np.int64), 0, 9)
    held[row * 10 + column] = True
    share = float((held & expected).sum() / expected.sum()) if expected.any() else 0.0
    return int(held.sum()), share
