"""Whether a pose is believed: inliers, their spread, and how likely chance gives as many."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import GeoPrior
from reloc.localise.result import Evidence
from reloc.wire.query import Reason

# Fitted on right and wrong poses of a simulated town and of real photos.
_CONFIDENCE_BASE, _CONFIDENCE_PER_LOG, _CONFIDENCE_PER_RIVAL = -4.46, 1.36, -2.08


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptanceOptions:
    """Where the line is, by right and wrong poses of a simulated town and of real photos."""

    min_inliers: int = 15  # fewer are never believed
    min_log_nfa: float = 20.0  # smallest -log10 of the number of false alarms, see `log_nfa`
    min_coverage: float = 0.05  # smallest share of a 10x10 grid over the image that holds inliers
    # Smallest share of the parts of the image where the map should be seen that holds inliers; a picture of
    # the place inside another picture agrees in its own part only.
    min_agreement: float = 0.2
    # Smallest `spread` of a photo whose prior does not say where it was taken. A look-alike that fills a part
    # of a photo gives many inliers there and none beside it. Photos of a simulated walk beyond the maps'
    # reach, 116 and 601 m off, had 0.56 and 0.50 with 223 and 81 inliers; right ones there 0.77 and more, in
    # a town of look-alikes 0.62 and more. It costs right photos half of which is covered by something else;
    # they need a prior.
    min_spread: float = 0.6
    # Largest standard deviation of a prior that tells look-alikes apart; that the pose agrees with it is
    # asked of every prior.
    prior_tells_m: float = 50.0
    # A pose elsewhere with this share of the winner's inliers makes the answer ambiguous.
    rival_share: float = 0.6
    # With that much evidence for a pose, places with far fewer votes are not tried.
    settled_log_nfa: float = 48.0


def log_nfa(
    matches: int, inliers: int, tolerance_px: float, width: float, height: float, sample: int
) -> float:
    """-log10 of the number of false alarms (Moisan and Stival 2004; Moulon et al., AC-RANSAC, 2012).

    NFA = (n - s) C(n, k) C(k, s) p^(k - s): the number of poses with k inliers that one expects among all
    minimal samples of s of n random matches, a random match being an inlier with the probability p that
    a random pixel lies within the tolerance.
    """
    if inliers <= sample or matches < inliers:
        return 0.0
    chance = min(np.pi * tolerance_px**2 / (width * height), 1.0)
    value = (
        np.log(matches - sample)
        + _log_choose(matches, inliers)
        + _log_choose(inliers, sample)
        + (inliers - sample) * np.log(chance)
    )
    return float(-value / np.log(10.0))


def coverage(pixels: NDArray[np.floating], width: int, height: int) -> float:
    """Share of the cells of a 10x10 grid over the image that hold at least one of the pixels (k, 2)."""
    if len(pixels) == 0:
        return 0.0
    return len(np.unique(_cells(pixels, width, height))) / 100.0


def agreement(
    inliers: NDArray[np.floating], expected: NDArray[np.floating], width: int, height: int
) -> float:
    """Share of the parts of the image where the map should be seen that hold inliers; 0 where there are none.

    Of a 10x10 grid those cells count in which at least three map points should be visible. A patch of the
    place inside another picture, a poster or a screen agrees in its own part only.

    Args:
        inliers: (k, 2) pixels. expected: (v, 2) pixels of all map points that the pose makes visible.
    """
    cells = expected_cells(expected, width, height)
    if len(cells) == 0:
        return 0.0
    return float(np.isin(cells, _cells(inliers, width, height)).mean())


def spread(inliers: NDArray[np.floating], expected: NDArray[np.floating], width: int, height: int) -> float:
    """Parts of the image that inliers reach, over those that as many reach if they lie like the map's points.

    Few inliers cannot reach all parts where the map should be seen, however right the pose; many that crowd
    in some of them say that the others show something else. About 1 for right poses; 0 where no inlier lies
    where the map should be seen.

    Args:
        inliers: (k, 2) pixels. expected: (v, 2) pixels of all map points that the pose makes visible.
    """
    cells = expected_cells(expected, width, height)
    inside = np.isin(_cells(inliers, width, height), cells)
    if not inside.any():
        return 0.0
    numbers = _cells(expected, width, height)
    share = np.bincount(numbers, minlength=100)[cells] / np.isin(numbers, cells).sum()
    reached = len(np.unique(_cells(inliers, width, height)[inside]))
    return float(reached / (1.0 - (1.0 - share) ** inside.sum()).sum())


def expected_cells(expected: NDArray[np.floating], width: int, height: int) -> NDArray[np.int64]:
    """Numbers of the cells that `agreement` asks."""
    cells, counts = np.unique(_cells(expected, width, height), return_counts=True)
    return np.asarray(cells[counts >= 3], dtype=np.int64)


def _cells(pixels: NDArray[np.floating], width: int, height: int) -> NDArray[np.int64]:
    """Numbers (k,) of the 10x10 grid's cells of pixels (k, 2)."""
    column = np.clip((pixels[:, 0] * 10 / width).astype(np.int64), 0, 9)
    row = np.clip((pixels[:, 1] * 10 / height).astype(np.int64), 0, 9)
    return np.asarray(row * 10 + column, dtype=np.int64)


def independent_inliers(pixels: FloatArray, points: FloatArray, min_gap_px: float) -> NDArray[np.intp]:
    """Rows of inliers that are measurements of their own.

    Keypoints of one structure at several scales lie on top of each other and agree with any pose that one
    of them agrees with; of those within one cell of `min_gap_px` only the first counts.
    """
    cell = np.floor(pixels / min_gap_px).astype(np.int64)
    _, first = np.unique(cell, axis=0, return_index=True)
    _, by_point = np.unique(np.round(points[first], 3), axis=0, return_index=True)
    return np.sort(first[by_point])


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def prior_tells(prior: GeoPrior | None, options: AcceptanceOptions) -> bool:
    """Whether a prior is good enough to tell a place from its look-alikes."""
    return prior is not None and prior.sigma_horizontal_m <= options.prior_tells_m


def verdict(
    evidence: Evidence, rival_inliers: int, options: AcceptanceOptions, *, told_by_prior: bool = False
) -> tuple[Reason, str] | None:
    """None if the pose is believed, else the reason and a sentence with the figures.

    Args:
        told_by_prior: see `prior_tells`.
    """
    if evidence.inliers < options.min_inliers:
        return "TOO_FEW_INLIERS", f"{evidence.inliers} independent inliers, {options.min_inliers} needed"
    if evidence.log_nfa < options.min_log_nfa:
        return (
            "TOO_FEW_INLIERS",
            f"as many inliers arise by chance too easily: -log10(NFA) {evidence.log_nfa:.1f}, "
            f"{options.min_log_nfa:.0f} needed",
        )
    if evidence.coverage < options.min_coverage:
        return (
            "TOO_FEW_INLIERS",
            f"the inliers cover {100 * evidence.coverage:.0f} % of the photo, "
            f"{100 * options.min_coverage:.0f} % needed",
        )
    if evidence.agreement < options.min_agreement:
        return (
            "TOO_FEW_INLIERS",
            f"inliers lie in {100 * evidence.agreement:.0f} % of the parts of the photo where the map should "
            f"be seen, {100 * options.min_agreement:.0f} % needed: it may show a picture of the place",
        )
    if evidence.spread < options.min_spread and not told_by_prior:
        return (
            "AMBIGUOUS",
            f"{evidence.inliers} inliers crowd in some parts of the photo where the map should be seen: they "
            f"reach {100 * evidence.spread:.0f} % of those that as many should reach, "
            f"{100 * options.min_spread:.0f} % needed without a position; it may show a look-alike",
        )
    if rival_inliers >= options.rival_share * evidence.inliers:
        return (
            "AMBIGUOUS",
            f"a pose elsewhere has {rival_inliers} inliers, this one {evidence.inliers}",
        )
    return None


def confidence(evidence: Evidence, rival_inliers: int) -> float:
    """Probability in [0, 1] that an accepted pose is right.

    Logistic in the evidence, fitted on right and wrong poses of a simulated
    town and of real photos (docs/measurements/localisation.md), right and wrong ones weighing the same.
    """
    rivalry = rival_inliers / max(evidence.inliers, 1)
    score = _CONFIDENCE_BASE + _CONFIDENCE_PER_LOG * np.log1p(max(evidence.log_nfa, 0.0))
    return float(1.0 / (1.0 + np.exp(-(score + _CONFIDENCE_PER_RIVAL * rivalry))))
