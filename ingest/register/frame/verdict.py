"""Whether a registered frame is believed."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.register.frame.dense.confirmation import MIN_PIECES, PictureConfirmation, log_nfa_of
from ingest.register.frame_registration import FrameReason

# Where the line is, by right and wrong registrations of the simulated town:
# docs/measurements/registration.md.
MIN_INLIERS = 20  # fewer independent inliers are never believed
# Smallest share of the parts of the photo where the scan should be seen that hold inliers.
_MIN_AGREEMENT = 0.2
_MIN_CELLS = 6  # and the smallest number of such parts, of a hundred: a pose needs width
# Features with that much evidence among their matches need no confirmation where the pictures have too few
# pieces to compare.
DECISIVE_LOG_NFA = 60.0
# Evidence of the pictures with which a pose needs no features. It is the best of very many that were tried,
# and towns resemble each other: of 20 photos of another town the strongest reached 14.3. Three of four right
# poses have it.
SURE_CONFIRMATION_LOG_NFA = 20.0
# Or evidence of features and pictures together; features spoke for none of the wrong poses that were
# measured.
_SURE_JOINT_LOG_NFA = 30.0
# With less, it must be so many times what the photo reaches at places of the scan where it cannot be, of
# which MAX_PLACES_ELSEWHERE are tried and _MIN_PLACES_ELSEWHERE must be there. Right poses had 10 times as
# much and more, photos of another town up to 3 times with all places tried, but up to 5 with three.
_MIN_CONFIRMATION_RATIO = 6.0
MAX_PLACES_ELSEWHERE = 5
_MIN_PLACES_ELSEWHERE = 1
# And so much evidence with the prior counted in (`weighed_log_nfa`): what the pictures must say anyway.
_MIN_WEIGHED_LOG_NFA = 5.0
_MIN_WITH_RELIEF = (
    4.0  # less is enough where shaded relief was asked, too: right windows of `autzen` have 4.8
)
_RIVAL_SHARE = 0.5  # a pose elsewhere with this share of the inliers makes the registration ambiguous
# Largest distance from the prior, in its own standard deviations over all six axes together. Generous: people
# and devices understate their errors.
MAX_PRIOR_SIGMAS = 6.0
# Largest standard deviation of the position, as a share of the distance to what is seen; above it the
# geometry does not determine the pose.
_MAX_POSITION_SIGMA_SHARE = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameEvidence:
    """Figures behind the verdict on one frame.

    Attributes:
        inliers: independent correspondences that agree with the pose.
        candidates, log_nfa: matches of the first round and the evidence among them.
        confirmation: what the pictures say. relief: what they say of shaded relief at the same pose; None
            where the pose needs no more, or was found by relief itself.
        cells: parts of the photo (of a hundred) that hold inliers. agreement: their share of those where the
            scan is seen.
        rival_share: support of the best pose elsewhere in the first round, as a share of this one's.
        prior_sigmas: distance from the prior.
        position_sigma_share: standard deviation of the position over the distance to what is seen.
        places_elsewhere, elsewhere_log_nfa: see `agreement_elsewhere`; none where it was not asked.
        relief_only: the pictures were compared by shaded relief, which shows nothing of the ground.
    """

    inliers: int
    candidates: int
    log_nfa: float
    confirmation: PictureConfirmation
    cells: int
    agreement: float
    rival_share: float
    prior_sigmas: float
    position_sigma_share: float
    places_elsewhere: int = 0
    elsewhere_log_nfa: float = 0.0
    relief: PictureConfirmation | None = None
    relief_only: bool = False


def asks_elsewhere(evidence: FrameEvidence) -> bool:
    """Whether all that keeps the pose from being believed is how the photo agrees with the scan elsewhere."""
    clean = replace(evidence, places_elsewhere=_MIN_PLACES_ELSEWHERE, elsewhere_log_nfa=0.0)
    return verdict(evidence) is not None and verdict(clean) is None


def weighed_log_nfa(evidence: FrameEvidence) -> float:
    """Evidence of the pictures and of relief, less what the distance from the prior speaks against the pose.

    Pieces of both pictures are counted together, where that says less: they show the same parts of the photo.
    -log10 of the prior's density, from that at the mean squared distance of six axes on: nearer ones gain
    nothing.
    """
    own, relief = evidence.confirmation, evidence.relief
    log_nfa = own.log_nfa
    if relief is not None and relief.pieces >= MIN_PIECES:
        log_nfa = min(log_nfa, log_nfa_of(own.agreeing + relief.agreeing, own.pieces + relief.pieces))
    return log_nfa - max(0.0, evidence.prior_sigmas**2 - 6.0) / (2.0 * math.log(10.0))


def highest_elsewhere(log_nfa: float) -> float:
    """The evidence elsewhere that a pose with `log_nfa` bears."""
    return log_nfa / _MIN_CONFIRMATION_RATIO


def verdict(evidence: FrameEvidence) -> tuple[FrameReason, str] | None:
    """None if the pose is believed, else the reason and a sentence with the figures."""
    e = evidence
    if e.inliers < MIN_INLIERS:
        return "TOO_FEW_MATCHES", f"{e.inliers} independent inliers, {MIN_INLIERS} needed"
    if not _borne_out(e.log_nfa, e.confirmation):
        return "NOT_CONFIRMED", f"the pictures do not agree at the pose found: {e.confirmation.message}"
    refusal = None if beyond_doubt(e.log_nfa, e.confirmation) else _against_elsewhere(e)
    if refusal is not None:
        return refusal
    if e.cells < _MIN_CELLS or e.agreement < _MIN_AGREEMENT:
        return "NO_CONSISTENT_POSE", (
            f"inliers lie in {e.cells} of a hundred parts of the photo, {100 * e.agreement:.0f} % of those "
            f"where the scan should be seen; {_MIN_CELLS} and {100 * _MIN_AGREEMENT:.0f} % needed"
        )
    if e.rival_share >= _RIVAL_SHARE:
        return "AMBIGUOUS", f"a pose elsewhere has {100 * e.rival_share:.0f} % of this one's inliers"
    if e.position_sigma_share > _MAX_POSITION_SIGMA_SHARE:
        return "NO_CONSISTENT_POSE", (
            f"the matches do not determine the pose: position known to {100 * e.position_sigma_share:.1f} % "
            f"of the distance, {100 * _MAX_POSITION_SIGMA_SHARE:.1f} % needed"
        )
    if e.prior_sigmas > MAX_PRIOR_SIGMAS:
        return "CONTRADICTS_PRIOR", (
            f"the pose lies {e.prior_sigmas:.1f} deviations from the prior, {MAX_PRIOR_SIGMAS:.0f} "
            "allowed; if the prior's deviations are too small, give larger ones"
        )
    return None


def beyond_doubt(log_nfa: float, confirmation: PictureConfirmation) -> bool:
    """Whether features and pictures need no comparison with other places."""
    return _borne_out(log_nfa, confirmation) and (
        log_nfa >= DECISIVE_LOG_NFA
        or confirmation.log_nfa >= SURE_CONFIRMATION_LOG_NFA
        or log_nfa + confirmation.log_nfa >= _SURE_JOINT_LOG_NFA
    )


def _borne_out(log_nfa: float, confirmation: PictureConfirmation) -> bool:
    """Pictures with too little of the scan to be asked contradict nothing: decisive features need no help."""
    return confirmation.confirmed or (confirmation.pieces < MIN_PIECES and log_nfa >= DECISIVE_LOG_NFA)


def _against_elsewhere(e: FrameEvidence) -> tuple[FrameReason, str] | None:
    if e.relief_only or e.places_elsewhere < _MIN_PLACES_ELSEWHERE:
        return "NOT_CONFIRMED", (
            f"the pictures agree too little at a pose that few features speak for: evidence of "
            f"10^-{e.confirmation.log_nfa:.1f}, 10^-{SURE_CONFIRMATION_LOG_NFA:g} needed"
        )
    weighed = weighed_log_nfa(e)
    needed, with_relief = _MIN_WEIGHED_LOG_NFA, ""
    if e.relief is not None and e.relief.pieces >= MIN_PIECES:
        needed, with_relief = _MIN_WITH_RELIEF, "with shaded relief, and "
    if weighed < needed:
        return "NOT_CONFIRMED", (
            f"the pictures agree with 10^-{e.confirmation.log_nfa:.1f}; {with_relief}{e.prior_sigmas:.1f} "
            f"deviations from the prior, 10^-{weighed:.1f} is left, 10^-{needed:g} needed"
        )
    if e.elsewhere_log_nfa > highest_elsewhere(e.confirmation.log_nfa):
        return "AMBIGUOUS", (
            f"evidence of 10^-{e.confirmation.log_nfa:.1f} at the pose found, and of "
            f"10^-{e.elsewhere_log_nfa:.1f} at a place of the scan where the photo cannot be"
        )
    return None


def cells_with_inliers(pixels: FloatArray, valid: NDArray[np.bool_], camera: Camera) -> tuple[int, float]:
    """How many parts of a 10x10 grid over the photo hold inliers, and their share of those with the scan.

    Args:
        pixels: (k, 2) full-size pixels. valid: (h, w) of a render from the pose.
    """
    rows, columns = np.nonzero(valid)
    shown = rows * 10 // len(valid) * 10 + columns * 10 // valid.shape[1]
    expected = np.bincount(shown, minlength=100) >= 0.5 * valid.size / 100.0
    held = np.zeros(100, dtype=bool)
    column, row = np.clip((pixels * 10 / (camera.width, camera.height)).astype(np.int64), 0, 9).T
    held[row * 10 + column] = True
    share = float((held & expected).sum() / expected.sum()) if expected.any() else 0.0
    return int(held.sum()), share
