"""Quarantined maps are promoted once independent sources confirm them and no canary regresses."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from featuredb.errors import ConflictError, StoreError
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.subset import answering_with
from featuredb.store import Database, MapSummary, Snapshot
from featuredb.store.canaries import list_canaries
from featuredb.store.candidates.photos import mark_confirmed, read_owners
from featuredb.store.candidates.states import ANONYMOUS
from featuredb.store.changes import is_imported
from ingest.fingerprint import digest
from ingest.growth import gates
from ingest.growth.asked_before import recall, remember
from ingest.growth.place.map_images import NEAR_M
from ingest.growth.trust.canaries import CanaryRun, run_canaries
from ingest.growth.trust.confirmation import NewPhotos, Sources, confirm, corroborate
from ingest.growth.values import GrowthOptions
from reloc.localiser import Localiser

_LOG = logging.getLogger(__name__)
_AROUND_M = 2.0 * NEAR_M  # boxes of maps that come this close may show the same
PARENT_MOVED = "was placed anew"  # said of maps whose parent was, see featuredb.store.changes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExaminedMap:
    """A map that others confirm, as `summary` has it in the database.

    Attributes:
        feature_map: with descriptors only where they confirm it. gate: of the confirmation.
        earned: candidate ids of its photos that make a record for their owners.
    """

    summary: MapSummary
    feature_map: FeatureMap
    gate: gates.Gate
    earned: frozenset[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Promotion:
    """What became of one quarantined map, and why it stays one or was promoted; figures of gates by name."""

    map_id: str
    promoted: bool = False
    reason_code: str = ""
    reason: str
    gates: Mapping[str, Any] = field(default_factory=dict)


def promote_confirmed(
    database: Database, localiser: Localiser, options: GrowthOptions, work: Path, new: NewPhotos
) -> list[Promotion]:
    """Try every quarantined map that growth has made; those that have drifted beyond the budget stay.

    Args:
        localiser: of the active maps of the newest snapshot.
        work: work folder: without anything new nothing is asked again.
        new: photos that may corroborate a map, beside the images of other maps.
    """
    snapshot = database.snapshot()
    asked = _question(snapshot, database, options, new)
    open_maps: list[MapSummary] = []
    outcomes: list[Promotion] = []
    for summary in snapshot.maps():
        if summary.status != "quarantined" or summary.method != "map":
            continue
        known = recall(work, "maps", summary.map_id, asked)
        stays = _held_back(summary, snapshot, options.drift_budget_m)
        stays = stays or (Promotion(**known) if known else None)
        if stays is None:
            open_maps.append(summary)
        else:
            outcomes.append(stays)

    def examine(waiting: Sequence[MapSummary]) -> list[ExaminedMap | Promotion]:
        sources = Sources(owners=read_owners(database, database.snapshot()), trusted=options.trusted)
        return _examined(waiting, snapshot, sources, new, options.threads)

    examined = examine(open_maps) if open_maps else []
    stay = [one for one in examined if isinstance(one, Promotion)]
    _remember(work, stay, asked)
    ready = [one for one in examined if isinstance(one, ExaminedMap)]
    if not ready:
        return outcomes + stay
    decided = _promote(database, localiser, ready, examine)
    _remember(work, decided, _question(database.snapshot(), database, options, new))
    return outcomes + stay + decided


def _remember(work: Path, outcomes: Sequence[Promotion], asked: str) -> None:
    for one in outcomes:
        if not one.promoted and one.reason_code != "CONFLICT":
            remember(work, "maps", one.map_id, asdict(one), asked)


def _examined(
    waiting: Sequence[MapSummary], snapshot: Snapshot, sources: Sources, new: NewPhotos, threads: int
) -> list[ExaminedMap | Promotion]:
    """All of them, with the records that they make for each other: lost descriptors do not come back."""
    while True:
        found = [_examine(summary, snapshot, sources, new, threads) for summary in waiting]
        earned = [c for one in found if isinstance(one, ExaminedMap) for c in one.earned]
        more = sources.with_records(sources.owners.givers.get(c, ANONYMOUS) for c in earned)
        if more == sources:
            return found
        sources = more


def _question(snapshot: Snapshot, database: Database, options: GrowthOptions, new: NewPhotos) -> str:
    """Digest of all that an examination depends on: live maps, canaries, photos, whose word counts."""
    maps = sorted(f"{m.write_id} {m.status}" for m in snapshot.maps())
    canaries = [f"{c.name} {c.created_at.isoformat()}" for c in list_canaries(database)]
    whose = [new.given.photos[row].sha256 for row in new.rows]
    whose += [f"{owner} is on record" for owner in read_owners(database, database.snapshot()).on_record]
    whose += [f"{owner} is trusted" for owner in options.trusted]
    return digest(*maps, "|", *canaries, "|", *sorted(whose))


def promote_by_hand(database: Database, map_id: str, reason: str, *, force: bool) -> Promotion:
    """Promote one map without confirmation, a retired one, too; canaries may refuse it unless forced.

    Args:
        map_id: or its first letters, if no other map begins so.

    Raises:
        MapNotFoundError, StoreError, ConflictError: no reason, no active map holds it, or it has changed.
    """
    if not reason.strip():
        raise StoreError(f"promote {map_id}: expected a reason, for those who will ask later, found none")
    snapshot = database.snapshot()
    map_id = snapshot.find(map_id, include_retired=True).map_id
    summary = snapshot.get(map_id)
    if summary.status == "active":
        return Promotion(map_id=map_id, promoted=True, reason="it was active already")
    if summary.status == "retired":
        again = replace(snapshot.load_map(map_id), status="quarantined")
        database.commit_maps([again], reasons={map_id: f"retired before: {summary.status_reason}"})
        return promote_by_hand(database, map_id, reason, force=force)
    gate = _tried(database, Localiser.open(database), [snapshot.load_map(map_id)]).gate
    if not gate.passes and not force:
        return _stays(map_id, gate)
    text = f"{reason} (by hand; {gate.message})"
    mark_confirmed(database, read_owners(database, snapshot).made_of.get(map_id, ()), map_id)
    database.set_status([map_id], "active", text, based_on={map_id: summary.write_id})
    return Promotion(map_id=map_id, promoted=True, reason=text, gates=gates.figures([gate]))


def _examine(
    summary: MapSummary, snapshot: Snapshot, sources: Sources, new: NewPhotos, threads: int
) -> ExaminedMap | Promotion:
    """How far others confirm a map: photos of its own, and from outside; the map, where they do."""
    feature_map, others = snapshot.load_map(summary.map_id), _others(summary, snapshot)
    heard = corroborate(feature_map, others, new, sources, write_id=summary.write_id, threads=threads)
    confirmation = confirm(feature_map, sources, heard)
    if not confirmation.gate.passes:
        return _stays(feature_map.map_id, confirmation.gate)
    contributed = sources.owners.made_of.get(feature_map.map_id, frozenset())
    earned = {i.sha256[:32] for i in feature_map.images if i.image_id in confirmation.earned} & contributed
    answering = answering_with(feature_map, confirmation.points)
    return ExaminedMap(
        summary=summary, feature_map=answering, gate=confirmation.gate, earned=frozenset(earned)
    )


def _held_back(summary: MapSummary, snapshot: Snapshot, budget_m: float) -> Promotion | None:
    """What keeps a map in quarantine before anybody is asked."""
    active = {m.map_id for m in snapshot.maps() if m.status == "active"}
    gate = gates.drift(summary.drift_m or 0.0, budget_m)
    code, text = gate.reason, gate.message
    if is_imported(summary.status, summary.status_reason):
        code, text = "IMPORTED", summary.status_reason
    elif PARENT_MOVED in summary.status_reason:
        code, text = "PARENT_MOVED", summary.status_reason
    elif not active.intersection(summary.parents):
        code, text = "NO_PARENT", f"no active map holds it: {', '.join(summary.parents)} is not active"
    elif gate.passes:
        return None
    return Promotion(map_id=summary.map_id, reason_code=code, reason=text)


def _stays(map_id: str, gate: gates.Gate) -> Promotion:
    told = gates.figures([gate])
    return Promotion(map_id=map_id, reason_code=gate.reason, reason=gate.message, gates=told)


def _others(me: MapSummary, snapshot: Snapshot) -> list[FeatureMap]:
    """Maps around one, active or quarantined."""
    if me.box is None:
        return []
    west, south = me.box.min_easting - _AROUND_M, me.box.min_northing - _AROUND_M
    east, north = me.box.max_easting + _AROUND_M, me.box.max_northing + _AROUND_M
    near = snapshot.maps_in(me.epsg, west, south, east, north)
    heard = [m for m in near if m.map_id != me.map_id and not is_imported(m.status, m.status_reason)]
    same = [m for m in heard if m.extractor_fingerprint == me.extractor_fingerprint]
    return [snapshot.load_map(m.map_id) for m in same if m.height_datum == me.height_datum]


def _promote(
    database: Database,
    before: Localiser,
    ready: Sequence[ExaminedMap],
    examine: Callable[[Sequence[MapSummary]], list[ExaminedMap | Promotion]],
) -> list[Promotion]:
    """Ask the canaries: of all of them together, and one by one where that shows a regression.

    Then a map is examined anew, by the records that promoted maps have made: one that is refused makes none.
    """
    together = _tried(database, before, [found.feature_map for found in ready])
    if not together.regressions or len(ready) == 1:
        return _decide(database, before, ready, together)
    outcomes: dict[str, Promotion] = {}
    waiting, asked = [found.summary for found in ready], 0
    while asked < len(waiting):  # a promoted map has made records for those that were asked before it
        (found,) = examine([waiting[asked]])
        if isinstance(found, Promotion):
            outcomes[found.map_id] = found
            asked += 1
            continue
        run = _tried(database, before, [found.feature_map])
        (decided,) = _decide(database, before, [found], run)
        outcomes[decided.map_id] = decided
        del waiting[asked]
        if decided.promoted:
            before, asked = Localiser.open(database, previous=before), 0
    return list(outcomes.values())


def _committed(database: Database, found: ExaminedMap) -> str:
    """The map with the descriptors that it will answer with, still in quarantine; its write id."""
    was, answering = found.summary, found.feature_map
    if int(answering.observations.has_descriptor.sum()) == was.descriptors:
        return was.write_id
    return database.commit_map(answering, replaces=was.map_id, based_on=was.write_id, moves=False).write_id


def _tried(database: Database, before: Localiser, maps: Sequence[FeatureMap]) -> CanaryRun:
    instead = {m.map_id: m for m in maps}
    after = Localiser.open(database, previous=before, also=instead.keys(), instead=instead)
    return run_canaries(database, before, after, maps)


def _decide(
    database: Database, before: Localiser, ready: Sequence[ExaminedMap], run: CanaryRun
) -> list[Promotion]:
    asked = {found.feature_map.map_id: (found.gate, run.gate) for found in ready}

    def outcomes(code: str, reason: str, *, promoted: bool = False) -> list[Promotion]:
        told: dict[str, Any] = {"promoted": promoted, "reason_code": code, "reason": reason}
        return [Promotion(map_id=map_id, gates=gates.figures(of), **told) for map_id, of in asked.items()]

    if not run.gate.passes:
        return outcomes(run.gate.reason, run.gate.message)
    confirmed = "; ".join(dict.fromkeys(found.gate.message for found in ready))
    reason = f"{confirmed}; {run.gate.message}"
    active = [m.write_id for m in database.snapshot(before.snapshot).maps() if m.status == "active"]
    for found in ready:
        mark_confirmed(database, found.earned, found.feature_map.map_id)
    try:
        now = [m.write_id for m in database.snapshot().maps() if m.status == "active"]
        if sorted(now) != sorted(active):  # before a map loses what nobody confirms
            raise ConflictError(
                "other maps are active since the known photos were asked; they are asked again"
            )
        based_on = {found.feature_map.map_id: _committed(database, found) for found in ready}
        database.set_status(list(asked), "active", reason, based_on=based_on, active=active)
    except ConflictError as error:
        _LOG.info("promotion of %s waits: %s", list(asked), error)
        return outcomes("CONFLICT", str(error))
    _LOG.info("promoted %s: %s", list(asked), reason)
    return outcomes("", reason, promoted=True)
