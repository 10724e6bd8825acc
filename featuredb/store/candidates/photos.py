"""Contributed photos: the tables `candidates` (events, only appended to) and `candidate_images` (bytes).

Bytes are written first, the event that names them last; bytes without an event are invisible, and vacuum
takes them. The tables are made by the first contribution; a database without them has none. Rollback of the
maps leaves the events alone, but changes what they mean: a photo used by a map which is gone waits again.

Whose photos the maps are made of, and whose word counts, is known by identity, from the events.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from featuredb.errors import CandidateNotFoundError, StoreError
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.store.candidates.states import (
    ANONYMOUS,
    CONFIRMED,
    CONTRIBUTED,
    OPERATOR,
    REFUSED,
    USED,
    WITHDRAWN,
    Candidate,
    CandidateState,
    Contribution,
    candidate_id_of,
    candidate_of,
    contributions_of,
    event_order,
    owner_of,
    request_column,
    standing_of,
)
from featuredb.store.commits import new_write_id
from featuredb.store.database import Database
from featuredb.store.decode import read_image
from featuredb.store.delta import Condition
from featuredb.store.encode import Row, rows_table
from featuredb.store.snapshot import Snapshot
from featuredb.store.tables import CANDIDATE_IMAGES, CANDIDATES, SPECS

_AS_CONTRIBUTED = ("licence", "client_id", "width", "height", "snapshot")


@dataclass(frozen=True, slots=True, kw_only=True)
class InboxCounts:
    """How much there is.

    Attributes:
        stored_bytes: of all images that are kept: those that are not withdrawn.
    """

    by_state: dict[str, int]
    waiting_by_owner: dict[str, int]
    stored_bytes: int

    @property
    def waiting(self) -> int:
        return self.by_state.get("waiting", 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class WithdrawReport:
    """What a withdrawal did.

    Attributes:
        used_by: living maps that were built with one of them; they keep its features, not its pixels.
    """

    candidates: tuple[str, ...]
    files: tuple[str, ...]
    used_by: tuple[str, ...]


def read_events(
    database: Database, *, answers: bool = False, candidate_ids: Iterable[str] | None = None
) -> list[Row]:
    """Events in order, all or those of some candidates; none where the table does not exist.

    Args:
        answers: also what the server answered, the longest column by far.
    """
    where: list[Condition] = []
    if candidate_ids is not None:
        where = [("candidate_id", "in", sorted(candidate_ids))]
    columns = [name for name in SPECS[CANDIDATES].schema.names if answers or name != "answer"]
    return sorted(database.rows(CANDIDATES, columns, where), key=event_order)


def by_candidate(events: Iterable[Row]) -> dict[str, list[Row]]:
    """The events of each photo, in order; photos without a contribution are left out."""
    found: dict[str, list[Row]] = {}
    for event in events:
        found.setdefault(event["candidate_id"], []).append(event)
    return {c: rows for c, rows in found.items() if any(r["event"] == CONTRIBUTED for r in rows)}


def live_maps(database: Database) -> frozenset[str]:
    """Ids of the maps that are not retired, in the newest snapshot."""
    return frozenset(m.map_id for m in database.snapshot().maps())


def note_events(database: Database, events: Mapping[str, Row]) -> None:
    """Append one event for each candidate.

    Raises:
        CandidateNotFoundError: one is not there; nothing is written.
    """
    if not events:
        return
    known = read_events(database)
    if missing := sorted(set(events) - {row["candidate_id"] for row in known}):
        raise not_found(missing)
    now = after(known, events, datetime.now(UTC))
    rows = [
        {**event, "candidate_id": candidate_id, "happened_at": now} for candidate_id, event in events.items()
    ]
    append_events(database, rows, new_write_id(now))


def after(known: Iterable[Row], candidate_ids: Collection[str], time: datetime) -> datetime:
    """`time`, or so much later that it follows all known events of these candidates, whatever the clocks."""
    earlier: list[datetime] = [row["happened_at"] for row in known if row["candidate_id"] in candidate_ids]
    return max([time, *(at + timedelta(microseconds=1) for at in earlier)])


def append_events(database: Database, rows: Sequence[Row], write_id: str) -> None:
    """Write events in the order given, under one write id."""
    if not rows:
        return
    full = [{**row, "write_id": write_id, "event_index": i} for i, row in enumerate(rows)]
    database.table(CANDIDATES).append(rows_table(CANDIDATES, full))


def not_found(candidate_ids: Sequence[str]) -> CandidateNotFoundError:
    """The error for ids that are not there."""
    return CandidateNotFoundError(
        f"no candidate {', '.join(candidate_ids)}; `featuredb candidates` lists what there is"
    )


def contribute(database: Database, contributions: Sequence[Contribution]) -> list[str]:
    """Take photos in, in one append; returns their ids in the order given.

    What is there already (the same bytes by the same owner) is left alone; the same bytes by another owner
    are noted as given by that one, too.

    Raises:
        StoreError: the store failed; none of them is visible.
    """
    database.make(CANDIDATES)
    ids = [candidate_id_of(c.image) for c in contributions]
    known = read_events(database, candidate_ids=set(ids))
    owners = _owners(known)
    write_id = new_write_id(datetime.now(UTC))
    images: dict[str, bytes] = {}
    rows: list[Row] = []
    for candidate_id, contribution in zip(ids, contributions, strict=True):
        mine = owners.setdefault(candidate_id, set())
        if contribution.owner in mine:
            continue
        if not mine:
            images[candidate_id] = contribution.image
        mine.add(contribution.owner)
        at = after(known, {candidate_id}, contribution.received_at.astimezone(UTC))
        row = {"candidate_id": candidate_id, "event": CONTRIBUTED, "happened_at": at}
        rows.append({**_contribution_row(contribution), **row})
    if images:
        stored = [{"candidate_id": c, "write_id": write_id, "image": image} for c, image in images.items()]
        database.table(CANDIDATE_IMAGES).append(rows_table(CANDIDATE_IMAGES, stored))
    append_events(database, rows, write_id)
    return ids


def mark_used(database: Database, candidate_ids: Iterable[str], map_id: str) -> None:
    """Note that a map is built with these photos. Call it before the map is committed: it counts only while
    the map lives, so that a crash in between neither loses photos nor uses them twice.

    Raises:
        CandidateNotFoundError, StoreError
    """
    note_events(database, {c: {"event": USED, "map_id": map_id} for c in candidate_ids})


def mark_confirmed(database: Database, candidate_ids: Iterable[str], map_id: str) -> None:
    """Note that more than their owners' word confirms photos of a map: this makes their owners' record
    (`featuredb.store.candidates.photos`). It counts only while the map is active, so call it before that.

    Raises:
        CandidateNotFoundError, StoreError
    """
    note_events(database, {c: {"event": CONFIRMED, "map_id": map_id} for c in candidate_ids})


def refuse(database: Database, reasons: Mapping[str, tuple[str, str]]) -> None:
    """Refuse photos for good, each (by id) with a reason code and a sentence.

    Raises:
        CandidateNotFoundError, StoreError: also where a reason is missing.
    """
    for candidate_id, (code, reason) in reasons.items():
        if not code.strip() or not reason.strip():
            raise StoreError(f"refuse candidate {candidate_id}: expected a reason code and a reason")
    note_events(
        database,
        {c: {"event": REFUSED, "reason_code": code, "reason": why} for c, (code, why) in reasons.items()},
    )


def withdraw(database: Database, candidate_ids: Iterable[str], reason: str) -> WithdrawReport:
    """Delete the bytes of photos, as their owner asks: from the table and from the disk or bucket, at once.

    Hash, owner, licence and events stay, so that it is known what was withdrawn. Running it again finishes
    what a crash has interrupted.

    Raises:
        CandidateNotFoundError, StoreError: also where no reason is given.
    """
    if not reason.strip():
        raise StoreError("withdraw: expected a reason, for those who will ask later")
    wanted = list(dict.fromkeys(candidate_ids))
    found = {c.candidate_id: c for c in list_candidates(database)}
    event: Row = {"event": WITHDRAWN, "reason_code": "OWNER", "reason": reason}
    pending = [c for c in wanted if c not in found or found[c].state != "withdrawn"]
    note_events(database, dict.fromkeys(pending, event))
    files = delete_images(database, wanted) if wanted else []
    used_by = {m for c in wanted for m in found[c].used_by}
    return WithdrawReport(candidates=tuple(wanted), files=tuple(files), used_by=tuple(sorted(used_by)))


def delete_images(database: Database, candidate_ids: Iterable[str]) -> list[str]:
    """Remove bytes from the table and the files that held them; returns the files' paths."""
    table = database.table(CANDIDATE_IMAGES)
    table.delete_rows("candidate_id", candidate_ids)
    # Only files that the log has dropped: a writer at work has files of which the log does not know yet.
    removed = database.table(CANDIDATE_IMAGES).vacuum(timedelta(0), dry_run=False, untracked=False)
    return [f"{CANDIDATE_IMAGES}/{path}" for path in removed]


def list_candidates(database: Database, *, state: CandidateState | None = None) -> list[Candidate]:
    """The contributed photos, or only those in one state, oldest first."""
    live = live_maps(database)
    found = [candidate_of(own, live) for own in by_candidate(read_events(database, answers=True)).values()]
    wanted = [c for c in found if state is None or c.state == state]
    return sorted(wanted, key=lambda c: (c.received_at, c.candidate_id))


def count_candidates(database: Database) -> InboxCounts:
    """How many there are in each state, how many wait of each owner, and how many bytes they take."""
    live = live_maps(database)
    states: Counter[str] = Counter()
    owners: Counter[str] = Counter()
    stored = 0
    for events in by_candidate(read_events(database)).values():  # often, and of all: no more than is counted
        state = standing_of(events, live).state
        states[state] += 1
        if state == "waiting":
            owners[owner_of(contributions_of(events)[0])] += 1
        if state != "withdrawn":
            stored += next(e for e in events if e["event"] == CONTRIBUTED)["size_bytes"]
    return InboxCounts(by_state=dict(states), waiting_by_owner=dict(owners), stored_bytes=stored)


def load_images(database: Database, candidate_ids: Iterable[str]) -> Iterator[tuple[str, bytes]]:
    """Id and bytes of photos, one in memory at a time.

    Raises:
        CandidateNotFoundError: no such photo, or it was withdrawn.
        StoreError: they cannot be read, or are not those that were contributed.
    """
    table = database.table(CANDIDATE_IMAGES) if database.has(CANDIDATES) else None
    for candidate_id in candidate_ids:
        if table is None:
            raise not_found([candidate_id])
        image = read_image(table, "candidate_id", candidate_id, f"candidate {candidate_id}")
        if image is None:
            raise CandidateNotFoundError(
                f"candidate {candidate_id} has no image; it was never there, or was withdrawn"
            )
        if hashlib.sha256(image).hexdigest()[:32] != candidate_id:
            raise StoreError(f"candidate {candidate_id}: its image is not the one that was contributed")
        yield candidate_id, image


def _owners(events: Iterable[Row]) -> dict[str, set[str]]:
    """For each candidate that is there and not withdrawn: its owners."""
    owners: dict[str, set[str]] = {}
    for event in events:
        if event["event"] == CONTRIBUTED:
            owners.setdefault(event["candidate_id"], set()).add(owner_of(event))
        elif event["event"] == WITHDRAWN:
            owners.pop(event["candidate_id"], None)
    return owners


def _contribution_row(contribution: Contribution) -> Row:
    return {
        **{name: getattr(contribution, name) for name in _AS_CONTRIBUTED},
        "owner": contribution.credit,
        "sha256": hashlib.sha256(contribution.image).hexdigest(),
        "size_bytes": len(contribution.image),
        "answer_status": str(contribution.answer.get("status", "")),
        "request": request_column(contribution),
        "answer": json.dumps(dict(contribution.answer), sort_keys=True, allow_nan=False),
    }


@dataclass(frozen=True, slots=True, kw_only=True)
class Owners:
    """Owners of the images of maps, and what they are known by.

    Attributes:
        givers: who gave each contributed photo first since it was last withdrawn, by candidate id.
        made_of: candidate ids of the photos that each map was made of, by map id.
        anchors: ids of the active maps that measured their own place.
        on_record: owners of whom something was confirmed by more than the word of strangers: a photo in an
            anchor, or a photo noted as confirmed (`mark_confirmed`) of a map that is active now. ANONYMOUS
            never is: anybody is.
    """

    givers: Mapping[str, str] = field(default_factory=dict)
    made_of: Mapping[str, Set[str]] = field(default_factory=dict)
    anchors: Set[str] = frozenset()
    on_record: Set[str] = frozenset()

    def of_image(self, feature_map: FeatureMap, image: MapImage) -> str:
        """Who gave the photo; OPERATOR for one that did not come to the map from the inbox."""
        candidate_id = image.sha256[:32]
        if candidate_id not in self.made_of.get(feature_map.map_id, frozenset()):
            return OPERATOR
        return self.givers.get(candidate_id, ANONYMOUS)

    def of_map(self, feature_map: FeatureMap) -> list[str]:
        """`of_image` of all images of a map."""
        return [self.of_image(feature_map, image) for image in feature_map.images]


def read_owners(database: Database, snapshot: Snapshot) -> Owners:
    """The owners as of now; `snapshot` says which maps are active.

    Raises:
        StoreError: the events cannot be read.
    """
    active = {m.map_id: m for m in snapshot.maps() if m.status == "active"}
    anchors = frozenset(map_id for map_id, summary in active.items() if not summary.parents)
    givers: dict[str, str] = {}
    made_of: dict[str, set[str]] = {}
    on_record: set[str] = set()
    for candidate_id, events in by_candidate(read_events(database)).items():
        givers[candidate_id] = _giver(events)
        for k, event in enumerate(events):
            kind, map_id = event["event"], event["map_id"]
            if kind == USED:
                made_of.setdefault(map_id, set()).add(candidate_id)
            # The record is of whose photo it was then: who gives a withdrawn one again has not earned it.
            if (kind == USED and map_id in anchors) or (kind == CONFIRMED and map_id in active):
                on_record.add(_giver(events[:k]))
    return Owners(
        givers=givers, made_of=made_of, anchors=anchors, on_record=frozenset(on_record - {ANONYMOUS})
    )


def _giver(events: Sequence[Row]) -> str:
    given = contributions_of(events)
    return owner_of(given[0]) if given else ANONYMOUS
