"""The report of a run of growth: photos by outcome and reason, maps; JSON and text."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import datetime
from typing import Any, Literal

from featuredb.maps.feature_map import FeatureMap
from ingest.growth.gates import figures
from ingest.growth.graph.replacing import Replacement
from ingest.growth.map_places import growth_of
from ingest.growth.trust.promotion import Promotion
from ingest.growth.values import Refused

PhotoOutcome = Literal["promoted", "quarantined", "waiting", "refused"]
_WORDS: dict[PhotoOutcome, str] = {
    "promoted": "in active maps",
    "quarantined": "in quarantined maps",
    "waiting": "waiting",
    "refused": "refused",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFate:
    """What became of a photo (a contributed one by its id), and why it waits or is refused."""

    name: str
    owner: str
    outcome: PhotoOutcome
    map_id: str = ""
    reason_code: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class GrownEntry:
    """A map that this run has made, or a map without a place that it has tried to place.

    Attributes:
        status: active or quarantined; "refused" where it was never committed, "unplaced" where it has no
            place still.
        reason_code, reason: why it is not active, or who confirmed it.
        drift_m, budget_m: 95 % bound on its drift against its anchors, and what is allowed.
    """

    map_id: str = ""
    status: str
    reason_code: str = ""
    reason: str = ""
    photos: tuple[str, ...] = ()
    points: int = 0
    parents: tuple[str, ...] = ()
    generation: int = 0
    drift_m: float | None = None
    budget_m: float | None = None
    gates: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class GrowthReport:
    """One run.

    Attributes:
        rounds: of localising, growing and promoting.
        promotions: of every quarantined map that was examined, in the last round that did.
        replacements: what new anchors did.
    """

    database: str
    started: datetime
    seconds: float
    rounds: int
    version: int
    photos: tuple[PhotoFate, ...]
    maps: tuple[GrownEntry, ...]
    promotions: tuple[Promotion, ...]
    replacements: tuple[Replacement, ...] = ()
    notes: tuple[str, ...] = ()

    def count(self, outcome: PhotoOutcome) -> int:
        return sum(photo.outcome == outcome for photo in self.photos)

    @property
    def promoted(self) -> tuple[str, ...]:
        """Maps that are active since this run."""
        return tuple(p.map_id for p in self.promotions if p.promoted)

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "started": self.started.isoformat(), "seconds": round(self.seconds, 3)}

    def as_text(self) -> str:
        """For the terminal."""
        counts = ", ".join(f"{self.count(outcome)} {word}" for outcome, word in _WORDS.items())
        lines = [f"{len(self.photos)} photos: {counts}; {self.rounds} rounds, {self.seconds:.1f} s"]
        reasons = Counter(p.reason_code for p in self.photos if p.reason_code)
        lines += [f"  {code}: {count} photos" for code, count in reasons.most_common()]
        lines += _replacement_lines(self.replacements)
        lines += [_entry_line(entry) for entry in self.maps]
        mine = {entry.map_id for entry in self.maps}
        for p in self.promotions:
            if p.map_id not in mine:
                became = "promoted" if p.promoted else f"stays in quarantine: {p.reason_code}"
                lines.append(f"map {p.map_id}: {became}: {p.reason}")
        lines += [f"note: {note}" for note in self.notes]
        return "\n".join(lines) + "\n"


def _entry_line(entry: GrownEntry) -> str:
    if entry.status == "unplaced":
        return f"map {entry.map_id}: has no place still: {entry.reason_code}: {entry.reason}"
    line = f"map {entry.map_id or '-'}: {entry.status}, {len(entry.photos)} photos, {entry.points} points"
    if entry.generation:
        line += f", {entry.generation} step{'s' if entry.generation != 1 else ''} from an anchor"
    if entry.drift_m is not None and entry.budget_m is not None:
        line += f", {entry.drift_m:.2f} of {entry.budget_m:.2f} m"
    return f"{line}: {entry.reason_code}: {entry.reason}" if entry.reason_code else f"{line}: {entry.reason}"


def _replacement_lines(replacements: Sequence[Replacement]) -> list[str]:
    lines = []
    for found in replacements:
        lines.append(f"new anchors: {found.reason + ': ' if found.reason else ''}{found.message}")
        for moved in found.moved:
            line = f"  map {moved.map_id} moved by {moved.move_m:.2f} m, drift {moved.drift_m:.2f} m"
            before = "" if moved.drift_before_m is None else f" (before {moved.drift_before_m:.2f} m)"
            lines.append(line + before)
        lines += [f"  left out: overlap {edge}" for edge in found.left_out]
        if found.flagged:
            lines.append(f"  quarantined, because nothing holds them any more: {', '.join(found.flagged)}")
    return lines


def grown_entry(feature_map: FeatureMap) -> GrownEntry:
    """Of a map that was committed, in quarantine."""
    growth = growth_of(feature_map.placement.evidence)
    return GrownEntry(
        map_id=feature_map.map_id,
        status=feature_map.status,
        photos=tuple(image.name for image in feature_map.images),
        points=len(feature_map.points),
        parents=feature_map.parents,
        generation=feature_map.generation,
        drift_m=growth.get("drift_m"),
        budget_m=growth.get("budget_m"),
        gates=growth.get("gates", {}),
    )


def refused_entry(refused: Refused, status: str, **of: Any) -> GrownEntry:
    """Of what a gate refuses, with other fields of an entry."""
    told = figures(refused.gates)
    return GrownEntry(status=status, reason_code=refused.reason, reason=refused.message, gates=told, **of)
