"""What a map stands on: the chain of maps that placed it, down to anchors that measured their own place.

Pure: works on whatever describes maps (`MapSummary` does). An anchor is a map without parents: GPS, LiDAR or
control points placed it. How far a grown map may have drifted from its anchors is in its placement's
evidence, under "growth", as the growth that made it has computed it.
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from featuredb.maps.statuses import MapStatus

GROWTH = "growth"  # key of Placement.evidence that growth writes and this module reads


class Described(Protocol):
    """What is known of a map without its points."""

    @property
    def map_id(self) -> str: ...
    @property
    def status(self) -> MapStatus: ...
    @property
    def parents(self) -> tuple[str, ...]: ...
    @property
    def drift_m(self) -> float | None: ...
    @property
    def budget_m(self) -> float | None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MapLineage:
    """What one map stands on.

    Attributes:
        chain: ids from the map to its nearest anchor, both included; just the map where there is no way.
        anchors: all anchors that it can be traced to, the nearest first; an anchor's own is itself.
        drift_m: radius that holds 95 % of its position errors against its anchors, metres; None: unknown.
        budget_m: how much drift the growth that made it allowed, metres; None: unknown.
    """

    map_id: str
    chain: tuple[str, ...]
    anchors: tuple[str, ...]
    drift_m: float | None
    budget_m: float | None

    @property
    def steps(self) -> int | None:
        """Placements between the map and its nearest anchor, 0 for an anchor; None without any."""
        return len(self.chain) - 1 if self.anchors else None


def trace(map_id: str, maps: Mapping[str, Described]) -> MapLineage:
    """The lineage of a map among the maps of a snapshot, by id.

    Chains lead over maps that live. Where none does (the map is retired with all that placed it), over
    retired ones too, so that one can see how it came about.
    """
    me = maps[map_id]
    chain, anchors = _to_anchors(me, {m: other for m, other in maps.items() if other.status != "retired"})
    if not anchors:
        chain, anchors = _to_anchors(me, maps)
    return MapLineage(map_id=map_id, chain=chain, anchors=anchors, drift_m=me.drift_m, budget_m=me.budget_m)


def describe_lineage(lineage: MapLineage) -> str:
    """In words: "3 steps from anchor A12, 0.31 of 0.50 m"."""
    return lineage_text(lineage.steps, lineage.anchors, lineage.drift_m, lineage.budget_m)


def lineage_text(
    steps: int | None, anchors: Sequence[str], drift_m: float | None, budget_m: float | None
) -> str:
    """As `describe_lineage`, from the figures of an answer."""
    if steps is None or not anchors:
        text = "no chain to an anchor"
    elif steps == 0:
        text = "anchor"
    else:
        text = f"{steps} step{'s' if steps > 1 else ''} from anchor {anchors[0]}"
    if drift_m is None:
        return text
    of = "" if budget_m is None else f" of {budget_m:.2f}"
    return f"{text}, {drift_m:.2f}{of} m"


def drift_and_budget(evidence: Mapping[str, Any]) -> tuple[float | None, float | None]:
    """Drift and budget (metres) out of a placement's evidence; None where it does not say."""
    growth = evidence.get(GROWTH)
    if not isinstance(growth, Mapping):
        return None, None
    return _metres(growth.get("drift_m")), _metres(growth.get("budget_m"))


def children_of(parents: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """For each map that placed others: those, in the order given; of the parents of each map."""
    found: dict[str, list[str]] = {}
    for map_id, above in parents.items():
        for parent in dict.fromkeys(above):
            found.setdefault(parent, []).append(map_id)
    return found


def family_of(map_id: str, maps: Mapping[str, Described]) -> set[str]:
    """The map, all that it stands on and all that stands on it, as far as they are among `maps`."""
    up = {m: described.parents for m, described in maps.items()}
    return (reached([map_id], up) | reached([map_id], children_of(up))) & maps.keys()


def reached(starts: Iterable[str], following: Mapping[str, Sequence[str]]) -> set[str]:
    """What can be reached from there, the starts included, by what follows each."""
    found = set(starts)
    queue = list(found)
    while queue:
        more = set(following.get(queue.pop(), ())) - found
        found |= more
        queue += more
    return found


def _to_anchors(me: Described, usable: Mapping[str, Described]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The shortest chain to an anchor (or just the map), and all anchors, nearest first. Breadth first."""
    came_from: dict[str, str] = {}
    seen, queue = {me.map_id}, deque([me])
    anchors: list[str] = []
    while queue:
        described = queue.popleft()
        if not described.parents:
            anchors.append(described.map_id)
        for parent in described.parents:
            if parent in usable and parent not in seen:
                seen.add(parent)
                came_from[parent] = described.map_id
                queue.append(usable[parent])
    if not anchors:
        return (me.map_id,), ()
    chain = [anchors[0]]
    while chain[-1] != me.map_id:
        chain.append(came_from[chain[-1]])
    return tuple(reversed(chain)), tuple(anchors)


def _metres(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) and value >= 0 else None
