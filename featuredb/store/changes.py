"""Changes to the table `maps` as pure functions from rows to rows. Applying them is `Database`'s business."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from featuredb.errors import MapNotFoundError, StoreError
from featuredb.store.encode import Row

RETIRED = "retired"


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What a commit to `maps` will do.

    Attributes:
        rows: all rows after the change.
        added: the rows among them that are new.
        only_adds: no old row is changed or gone, so that appending `added` is enough.
    """

    rows: list[Row]
    added: list[Row]
    only_adds: bool


def live_row(rows: Iterable[Row], map_id: str) -> Row | None:
    """The row of a map that is visible and not retired, or None."""
    return next((row for row in rows if row["map_id"] == map_id and row["status"] != RETIRED), None)


def add_maps(rows: Sequence[Row], new_rows: Sequence[Row], replaces: Sequence[str]) -> Change:
    """Add maps in the place of those that `replaces` names.

    A retired row of the same map id gives way to the new one. A replaced map of another id stays in the table
    as retired, with the reason.

    Raises:
        MapNotFoundError: a map to be replaced is not there.
    """
    new_ids = [row["map_id"] for row in new_rows]
    for map_id in replaces:
        if not any(row["map_id"] == map_id for row in rows):
            raise MapNotFoundError(f"no map {map_id} to be replaced; `featuredb maps` lists what there is")
    kept: list[Row] = []
    for row in rows:
        if row["map_id"] in new_ids:
            continue
        if row["map_id"] in replaces and row["status"] != RETIRED:
            row = {**row, "status": RETIRED, "status_reason": f"replaced by {', '.join(new_ids)}"}
        kept.append(row)
    unchanged = len(kept) == len(rows) and all(a is b for a, b in zip(kept, rows, strict=True))
    return Change(rows=[*kept, *new_rows], added=list(new_rows), only_adds=unchanged)


def retire_map(rows: Sequence[Row], map_id: str, reason: str) -> tuple[Change, list[str]]:
    """Retire a map with all that hangs on it alone; returns the change and the ids retired, the map first.

    Raises:
        MapNotFoundError: no such map.
        StoreError: no reason given.
    """
    if not reason.strip():
        raise StoreError(f"retire {map_id}: expected a reason, for those who will ask later")
    if not any(row["map_id"] == map_id for row in rows):
        raise MapNotFoundError(f"no map {map_id}; `featuredb maps` lists what there is")
    if live_row(rows, map_id) is None:
        return Change(rows=list(rows), added=[], only_adds=True), []
    dependants = sorted(anchored(rows) - anchored(rows, without=map_id) - {map_id})
    retired = [map_id, *dependants]
    changed = [
        {
            **row,
            "status": RETIRED,
            "status_reason": reason if row["map_id"] == map_id else f"{reason} ({map_id})",
        }
        if row["map_id"] in retired and row["status"] != RETIRED
        else row
        for row in rows
    ]
    return Change(rows=changed, added=[], only_adds=False), retired


def anchored(rows: Iterable[Row], without: str | None = None) -> set[str]:
    """Ids of live maps that have a chain of live parents down to a map without parents.

    With `without`, as if that map were not there.
    """
    live = {row["map_id"]: row["parents"] for row in rows if row["status"] != RETIRED}
    live.pop(without or "", None)
    reached = {map_id for map_id, parents in live.items() if not parents}
    while True:
        more = {m for m, parents in live.items() if m not in reached and reached.intersection(parents)}
        if not more:
            return reached
        reached |= more
