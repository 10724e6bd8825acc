"""Quarantined maps are promoted once independent sources confirm them and no canary regresses."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from featuredb.errors import ConflictError, StoreError
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database, MapSummary, Snapshot
from featuredb.store.candidates.owners import read_owners
from featuredb.store.candidates.photos import mark_confirmed
from featuredb.store.changes import is_imported
from ingest.growth.gates import Gate
from ingest.growth.trust.canaries import CanaryOptions, CanaryRun, run_canaries
from ingest.growth.trust.confirmation import Confirmation, ConfirmationOptions, Sources, confirm
from ingest.growth.trust.corroboration import CorroborationOptions, NewPhotos, corroborate
from ingest.growth.trust.examined import question, recall, remember
from ingest.growth.trust.trusted_points import answering_with, confirmed_points
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
_AROUND_M = 100.0  # boxes of maps that come this close may show the same


@dataclass(frozen=True, slots=True, kw_only=True)
class PromotionOptions:
    """What a promotion needs.

    Attributes:
        answer_with: "confirmed": only points that independent sources have seen keep their descriptors and
            answer queries; "all": a photo that is altered in one part brings that part in.
    """

    answer_with: Literal["confirmed", "all"] = "confirmed"
    confirmation: ConfirmationOptions = field(default_factory=ConfirmationOptions)
    corroboration: CorroborationOptions = field(default_factory=CorroborationOptions)
    canaries: CanaryOptions = field(default_factory=CanaryOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExaminedMap:
    """A map that others confirm; `feature_map` has descriptors where they do."""

    feature_map: FeatureMap
    confirmation: Confirmation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ready:
    """A map that only the canaries may still refuse, and the write id of its state in the database.

    `earned`: candidate ids of its photos that make a record for their owners.
    """

    map_id: str
    write_id: str
    found: ExaminedMap
    earned: frozenset[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Promotion:
    """What became of one quarantined map.

    Attributes:
        promoted: whether it is active now.
        reason_code, reason: why it stays in quarantine; the reason of the promotion otherwise.
        gates: of confirmation and canaries.
    """

    map_id: str
    promoted: bool
    reason_code: str
    reason: str
    gates: tuple[Gate, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return {
            "map_id": self.map_id,
            "promoted": self.promoted,
            "reason_code": self.reason_code,
            "reason": self.reason,
            "gates": {gate.name: gate.as_json() for gate in self.gates},
        }


def promote_confirmed(
    database: Database,
    localiser: Localiser,
    options: PromotionOptions | None = None,
    new: NewPhotos | None = None,
    *,
    budget_m: float,
    work: Path | None = None,
) -> list[Promotion]:
    """Try every quarantined map that growth has made.

    Args:
        localiser: of the active maps of the newest snapshot.
        new: photos that may corroborate a map, beside the images of other maps.
        budget_m: maps that have drifted further stay.
        work: work folder, where it is kept what was found out: without anything new nothing is asked again.

    Raises:
        StoreError
    """
    options = options or PromotionOptions()
    snapshot = database.snapshot()
    sources = Sources(owners=read_owners(database, snapshot), trusted=options.confirmation.trusted)
    asked = _question(database, snapshot, sources, new, options)
    waiting = [m for m in snapshot.maps() if m.status == "quarantined" and m.method == "map"]
    ready: list[_Ready] = []
    outcomes: list[Promotion] = []
    open_maps: list[MapSummary] = []
    for summary in waiting:
        held_back = _held_back(summary, snapshot, budget_m)
        if held_back is not None:
            outcomes.append(held_back)
            continue
        known = recall(work, summary.map_id, asked)
        if known is not None:
            outcomes.append(_stays(summary.map_id, *known))
            continue
        open_maps.append(summary)
    for summary, found in zip(open_maps, _examined(open_maps, snapshot, sources, options, new), strict=True):
        if isinstance(found, Confirmation):
            gate = found.gate
            outcomes.append(_stays(summary.map_id, gate.reason, gate.message, (gate,)))
            remember(work, summary.map_id, asked, gate.reason, gate.message, (gate,))
        else:
            ready.append(_committed(database, summary, found, sources))
    if ready:
        decided = _promote(database, localiser, ready, options)
        now = database.snapshot()
        sources = replace(sources, owners=read_owners(database, now))
        after = _question(database, now, sources, new, options)
        for outcome in decided:
            if not outcome.promoted and outcome.reason_code != "CONFLICT":
                remember(work, outcome.map_id, after, outcome.reason_code, outcome.reason, outcome.gates)
        outcomes += decided
    return outcomes


def _examined(
    waiting: Sequence[MapSummary],
    snapshot: Snapshot,
    sources: Sources,
    options: PromotionOptions,
    new: NewPhotos | None,
) -> list[ExaminedMap | Confirmation]:
    """All of them, with the records that they make for each other: else what two newcomers show beside what
    an anchor shows would lose its descriptors, which do not come back.
    """
    while True:
        found = [examine(snapshot.load_map(m.map_id), snapshot, sources, options, new) for m in waiting]
        more = sources.with_records(
            sources.owners.of_image(one.feature_map, image)
            for one in found
            if isinstance(one, ExaminedMap)
            for image in one.feature_map.images
            if image.image_id in one.confirmation.earned
        )
        if more == sources:
            return found
        sources = more


def _question(
    database: Database, snapshot: Snapshot, sources: Sources, new: NewPhotos | None, options: PromotionOptions
) -> str:
    photos = [] if new is None else [new.photos[row].sha256 for row in new.rows]
    records = [f"{owner} is on record" for owner in sources.owners.on_record]
    return question(database, snapshot, [*photos, *records], options)


def promote_by_hand(database: Database, map_id: str, reason: str, *, force: bool) -> Promotion:
    """Promote one map without confirmation; canaries are asked, and refuse it unless forced.

    Raises:
        MapNotFoundError, StoreError: it is retired, or no active map holds it.
        ConflictError: it was changed by someone else meanwhile.
    """
    snapshot = database.snapshot()
    summary = snapshot.get(map_id)
    if summary.status == "active":
        return Promotion(map_id=map_id, promoted=True, reason_code="", reason="it was active already")
    if summary.status == "retired":
        raise StoreError(f"map {map_id} is retired ({summary.status_reason}); commit it again")
    before = Localiser.open(database)
    gate = canary_gate(_tried(database, before, [snapshot.load_map(map_id)], PromotionOptions()))
    if not gate.passes and not force:
        return _stays(map_id, gate.reason, gate.message, (gate,))
    text = f"{reason} (by hand; {gate.message})"
    mark_confirmed(database, read_owners(database, snapshot).made_of.get(map_id, ()), map_id)
    database.set_status([map_id], "active", text, based_on={map_id: summary.write_id})
    return Promotion(map_id=map_id, promoted=True, reason_code="", reason=text, gates=(gate,))


def examine(
    feature_map: FeatureMap,
    snapshot: Snapshot,
    sources: Sources,
    options: PromotionOptions,
    new: NewPhotos | None,
) -> ExaminedMap | Confirmation:
    """How far others confirm a map: photos of its own, and from outside; the map, where they do."""
    heard = corroborate(
        feature_map,
        _others(feature_map.map_id, snapshot),
        new,
        sources,
        options.corroboration,
        write_id=snapshot.get(feature_map.map_id).write_id,
    )
    confirmation = confirm(
        feature_map, sources, options.confirmation, heard.corroborating, heard.contradictions
    )
    if not confirmation.gate.passes:
        return confirmation
    part = feature_map
    if options.answer_with == "confirmed":
        points = confirmed_points(feature_map, sources, options.confirmation, heard.corroborating)
        part = answering_with(feature_map, points)
    return ExaminedMap(feature_map=part, confirmation=confirmation)


def canary_gate(run: CanaryRun) -> Gate:
    """Whether no known answer got worse."""
    return Gate(
        name="canaries",
        reason="CANARY",
        figure=len(run.regressions),
        limit=0,
        passes=not run.regressions,
        message=run.message,
    )


def _held_back(summary: MapSummary, snapshot: Snapshot, budget_m: float) -> Promotion | None:
    """What keeps a map in quarantine before anybody is asked."""
    if is_imported(summary.status, summary.status_reason):
        return _stays(summary.map_id, "IMPORTED", summary.status_reason, ())
    if "was placed anew" in summary.status_reason:
        return _stays(summary.map_id, "PARENT_MOVED", summary.status_reason, ())
    inactive = [p for p in summary.parents if not _active(snapshot, p)]
    if len(inactive) == len(summary.parents):
        return _stays(
            summary.map_id, "NO_PARENT", f"no active map holds it: {', '.join(inactive)} is not active", ()
        )
    if summary.drift_m is not None and summary.drift_m > budget_m:
        return _stays(
            summary.map_id,
            "DRIFT_BUDGET",
            f"it may have drifted {summary.drift_m:.2f} m from its anchors, {budget_m:.2f} m are allowed",
            (),
        )
    return None


def _active(snapshot: Snapshot, map_id: str) -> bool:
    return any(m.map_id == map_id and m.status == "active" for m in snapshot.maps())


def _stays(map_id: str, code: str, reason: str, gates: tuple[Gate, ...]) -> Promotion:
    return Promotion(map_id=map_id, promoted=False, reason_code=code, reason=reason, gates=gates)


def _others(map_id: str, snapshot: Snapshot) -> list[FeatureMap]:
    """Maps around one, active or quarantined."""
    me = snapshot.get(map_id)
    if me.box is None:
        return []
    box = me.box
    near = snapshot.maps_in(
        me.epsg,
        box.min_easting - _AROUND_M,
        box.min_northing - _AROUND_M,
        box.max_easting + _AROUND_M,
        box.max_northing + _AROUND_M,
    )
    heard = [m for m in near if m.map_id != map_id and not is_imported(m.status, m.status_reason)]
    same = [m for m in heard if m.extractor_fingerprint == me.extractor_fingerprint]
    return [snapshot.load_map(m.map_id) for m in same if m.height_datum == me.height_datum]


def _committed(database: Database, summary: MapSummary, found: ExaminedMap, sources: Sources) -> _Ready:
    """The map with the descriptors that it will answer with, still in quarantine; the same place."""
    feature_map, write_id = found.feature_map, summary.write_id
    if int(feature_map.observations.has_descriptor.sum()) != summary.descriptors:
        result = database.commit_map(feature_map, replaces=summary.map_id, based_on=write_id, moves=False)
        write_id = result.write_id
    known, earned = sources.owners.made_of.get(summary.map_id, frozenset()), found.confirmation.earned
    theirs = frozenset(i.sha256[:32] for i in feature_map.images if i.image_id in earned)
    return _Ready(map_id=summary.map_id, write_id=write_id, found=found, earned=theirs & known)


def _promote(
    database: Database,
    before: Localiser,
    ready: Sequence[_Ready],
    options: PromotionOptions,
) -> list[Promotion]:
    """Ask the canaries: of all of them together, and one by one where that shows a regression."""
    together = _tried(database, before, [r.found.feature_map for r in ready], options)
    if not together.regressions or len(ready) == 1:
        return _decide(database, before, ready, together)
    outcomes: list[Promotion] = []
    localiser = before
    for item in ready:
        run = _tried(database, localiser, [item.found.feature_map], options)
        decided = _decide(database, localiser, [item], run)
        outcomes += decided
        if decided[0].promoted:
            localiser = Localiser.open(database, previous=localiser)
    return outcomes


def _tried(
    database: Database, before: Localiser, maps: Sequence[FeatureMap], options: PromotionOptions
) -> CanaryRun:
    after = Localiser.open(database, previous=before, also=[m.map_id for m in maps])
    return run_canaries(database, before, after, maps, options.canaries)


def _decide(
    database: Database, before: Localiser, ready: Sequence[_Ready], run: CanaryRun
) -> list[Promotion]:
    gate = canary_gate(run)
    ids = [r.map_id for r in ready]
    gates = {r.map_id: (r.found.confirmation.gate, gate) for r in ready}
    if not gate.passes:
        return [_stays(m, gate.reason, gate.message, gates[m]) for m in ids]
    confirmed = "; ".join(dict.fromkeys(r.found.confirmation.message for r in ready))
    reason = f"{confirmed}; {run.message}"
    asked = database.snapshot(before.snapshot)
    active = [m.write_id for m in asked.maps() if m.status == "active"]
    for item in ready:
        mark_confirmed(database, item.earned, item.map_id)
    try:
        database.set_status(
            ids, "active", reason, based_on={r.map_id: r.write_id for r in ready}, active=active
        )
    except ConflictError as error:
        _LOG.info("promotion of %s waits: %s", ids, error)
        return [_stays(m, "CONFLICT", str(error), gates[m]) for m in ids]
    _LOG.info("promoted %s: %s", ids, reason)
    return [Promotion(map_id=m, promoted=True, reason_code="", reason=reason, gates=gates[m]) for m in ids]
