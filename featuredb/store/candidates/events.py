"""The rows of the table `candidates`: read in order, grouped by photo, appended."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta

from featuredb.errors import CandidateNotFoundError
from featuredb.store.candidates.states import CONTRIBUTED, event_order
from featuredb.store.commits import new_write_id
from featuredb.store.database import Database
from featuredb.store.delta import Condition
from featuredb.store.encode import Row, rows_table
from featuredb.store.tables import CANDIDATES, SPECS


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
