"""Gates of growth: each compares one figure with its limit and says so. Pure functions.

docs/growth.md shows the distributions behind the limits, and the commands that print them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

from featuredb.geo.words import way_words
from featuredb.geometry.arrays import FloatArray

# Chi-square with two degrees of freedom is above this once in 10,000 honest positions
# (as in reloc.localise.prior).
GPS_LIMIT = 18.42
# Share of positions that are wrong by accident, with a margin over the tenth that communities have; as many
# wrong ones as come about less often than that are no accident.
_WRONG_TAGS, _ACCIDENT = 0.15, 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """One question and its answer.

    Attributes:
        name: for programs, e.g. "agreement".
        reason: the code that a refusal by this gate carries.
        figure: what was measured.
        limit: where the line is.
        passes: whether the figure is on the right side of it.
        message: for people, with both.
    """

    name: str
    reason: str
    figure: float
    limit: float
    passes: bool
    message: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        figure = None if not np.isfinite(self.figure) else round(float(self.figure), 6)
        return {"figure": figure, "limit": self.limit, "passes": self.passes}


def sigmas_limit(sigmas: float, degrees: int) -> float:
    """Chi-square that is exceeded as seldom as a single normal figure exceeds so many sigmas."""
    return float(chi2.isf(chi2.sf(sigmas**2, 1), degrees))


def agreement(agreeing: int, disagreeing: int, least: int, share: float) -> Gate:
    """Photos whose own localisation agrees with the placement: one alone proves nothing, and most must."""
    total = agreeing + disagreeing
    found = agreeing / total if total else 0.0
    return Gate(
        name="agreement",
        reason="TOO_FEW_AGREE" if agreeing < least else "PHOTOS_DISAGREE",
        figure=found,
        limit=share,
        passes=agreeing >= least and found >= share,
        message=f"{agreeing} of {total} photos localised by themselves agree with the placement, {least} and "
        f"{share:.0%} are needed",
    )


def residuals(offset_m: float, distance_m: float, limit: float) -> Gate:
    """Typical distance of localised camera centres from the placed ones, over the viewing distance.

    What is larger than poses are uncertain is the bending of one of the two reconstructions.
    """
    share = offset_m / distance_m if distance_m > 0 else np.inf
    return Gate(
        name="residuals",
        reason="RESIDUALS",
        figure=share,
        limit=limit,
        passes=share <= limit,
        message=f"localised cameras lie {offset_m:.2f} m from the placed ones, {share:.2%} of the viewing "
        f"distance; {limit:.1%} is allowed",
    )


def geotags(offsets_m: FloatArray, covariances: FloatArray, by: str = "") -> Gate:
    """How often so many of the photos' positions contradict their place by accident.

    A tenth of a community's positions are wrong by kilometres, so some may contradict; more than accident
    explains may not.

    Args:
        offsets_m: (n, 2) placed centre minus position, east and north.
        covariances: (n, 2, 2) of both together.
        by: the maps that place the photos.
    """
    against, where = 0, ""
    if len(offsets_m):
        solved = np.linalg.solve(covariances, offsets_m[:, :, None])[:, :, 0]
        contradict = np.einsum("ni,ni->n", offsets_m, solved) > GPS_LIMIT
        against = int(contradict.sum())
        if against:
            where = (
                f" by {by}" * bool(by)
                + f", which is {way_words(*np.median(offsets_m[contradict], axis=0))} of them"
            )
    chance = float(binom.sf(against - 1, len(offsets_m), _WRONG_TAGS)) if against else 1.0
    return Gate(
        name="geotags",
        reason="CONTRADICTS_GPS",
        figure=chance,
        limit=_ACCIDENT,
        passes=chance >= _ACCIDENT,
        message=f"{against} of {len(offsets_m)} positions contradict the placement{where} (chi-square above "
        f"{GPS_LIMIT}): if {_WRONG_TAGS:.0%} of all positions are wrong, that happens {chance:.2%} of the "
        f"time, and what happens less than {_ACCIDENT:.0%} is not taken",
    )


def visibility(agreements: FloatArray, least: float, limit: float) -> Gate:
    """Share of the photos that do not show what the existing maps say they should.

    Args:
        agreements: (n,) for each photo that should see parts of existing maps: share of these parts in which
            it does.
        least: what a photo must reach. limit: share of photos that may stay below.
    """
    blind = int((agreements < least).sum())
    share = blind / len(agreements) if len(agreements) else 0.0
    return Gate(
        name="visibility",
        reason="NOT_VISIBLE",
        figure=share,
        limit=limit,
        passes=share <= limit,
        message=f"{blind} of {len(agreements)} photos show less than {least:.0%} of what they should see of "
        f"existing maps, a share of {limit:.0%} is allowed",
    )


def first_refusal(gates: tuple[Gate, ...]) -> Gate | None:
    """The first gate that does not pass."""
    return next((gate for gate in gates if not gate.passes), None)
