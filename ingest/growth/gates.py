"""Gates of growth: each compares one figure with its limit and says so. Pure functions.

docs/measurements/growth.md shows the distributions behind the limits, and the commands that print them.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtrc, chdtrc, chdtri

from featuredb.geo.words import way_words
from featuredb.geometry.arrays import FloatArray
from reloc.localise.acceptance import AcceptanceOptions

SIGMAS = 3.0  # what errors are larger than this once in 370 times contradicts, wherever growth compares two
LEAST_AGREEING = 2  # photos; one alone proves nothing
# Of the localised photos, and of the verified matches of two. Every accepted pose is right with a probability
# above 0.95; a third wrong means that the reconstruction is, or that the place repeats itself.
AGREEING_SHARE = 0.66
# Share of positions that are wrong by accident, with a margin over the tenth that communities have; as many
# wrong ones as come about less often than that are no accident.
_WRONG_TAGS, _ACCIDENT = 0.15, 0.01
# Least share of the parts of a photo where points should be seen that shows some, as for a query. In
# a simulated community a re-upload 10.8 m off showed 0.13 of its parts, right photos 0.22 and more.
LEAST_VISIBLE = AcceptanceOptions().min_agreement


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """One question and its answer; `reason` is the code of a refusal by it, `message` is for people."""

    name: str
    reason: str
    figure: float
    limit: float
    passes: bool
    message: str

    @classmethod
    def at_most(cls, name: str, reason: str, figure: float, limit: float, message: str) -> "Gate":
        """A gate that figures up to the limit pass."""
        passes = bool(figure <= limit)
        return cls(name=name, reason=reason, figure=figure, limit=limit, passes=passes, message=message)

    def as_json(self) -> dict[str, Any]:
        figure = None if not np.isfinite(self.figure) else round(float(self.figure), 6)
        return {"figure": figure, "limit": self.limit, "passes": self.passes}


def figures(gates: Iterable[Gate]) -> dict[str, Any]:
    """Gates by name, as JSON has them."""
    return {gate.name: gate.as_json() for gate in gates}


def sigmas_limit(degrees: int) -> float:
    """Chi-square that is exceeded as seldom as a single normal figure exceeds `SIGMAS`."""
    return float(chdtri(degrees, chdtrc(1, SIGMAS**2)))


def agreement(agreeing: int, disagreeing: int) -> Gate:
    """Photos whose own localisation agrees with the placement: most must."""
    total = agreeing + disagreeing
    found = agreeing / max(total, 1)
    return Gate(
        name="agreement",
        reason="TOO_FEW_AGREE" if agreeing < LEAST_AGREEING else "PHOTOS_DISAGREE",
        figure=found,
        limit=AGREEING_SHARE,
        passes=agreeing >= LEAST_AGREEING and found >= AGREEING_SHARE,
        message=f"{agreeing} of {total} photos localised by themselves agree with the placement, "
        f"{LEAST_AGREEING} and {AGREEING_SHARE:.0%} are needed",
    )


def geotags(offsets_m: FloatArray, covariances: FloatArray, by: str = "") -> Gate:
    """How often so many of the photos' positions contradict their place by accident.

    Args:
        offsets_m: (n, 2) placed centre minus position, east and north.
        covariances: (n, 2, 2) of both together.
        by: the maps that place the photos.
    """
    solved = np.linalg.solve(covariances, offsets_m[:, :, None])[:, :, 0]
    contradict = np.einsum("ni,ni->n", offsets_m, solved) > sigmas_limit(2)
    against, where = int(contradict.sum()), ""
    if against:
        way = way_words(*np.median(offsets_m[contradict], axis=0))
        where = f" by {by}" * bool(by) + f", which is {way} of them"
    chance = float(bdtrc(against - 1, len(offsets_m), _WRONG_TAGS))  # 1 for none
    return Gate(
        name="geotags",
        reason="CONTRADICTS_GPS",
        figure=chance,
        limit=_ACCIDENT,
        passes=chance >= _ACCIDENT,
        message=f"{against} of {len(offsets_m)} positions contradict the placement{where} (by more than "
        f"{SIGMAS:g} sigma): if {_WRONG_TAGS:.0%} of all positions are wrong, that happens {chance:.2%} of "
        f"the time, and what happens less than {_ACCIDENT:.0%} is not taken",
    )


def visibility(shown: FloatArray) -> Gate:
    """Share of the photos that show less of existing maps than they should, by what each does show (n,)."""
    blind, most = int((shown < LEAST_VISIBLE).sum()), round(1.0 - AGREEING_SHARE, 2)
    message = (
        f"{blind} of {len(shown)} photos show less than {LEAST_VISIBLE:.0%} of what they should see of "
        f"existing maps, a share of {most:.0%} is allowed"
    )
    return Gate.at_most("visibility", "NOT_VISIBLE", blind / max(len(shown), 1), most, message)


def drift(drift_m: float, budget_m: float) -> Gate:
    """Whether a map is near enough to its anchors: a bound of 95 % on its errors against them."""
    message = f"it may have drifted {drift_m:.2f} m from its anchors, {budget_m:.2f} m are allowed"
    return Gate.at_most("drift", "DRIFT_BUDGET", drift_m, budget_m, f"{message}; it waits for an anchor")
