"""Changes to the table `maps` as pure functions from rows to rows. Applying them is `Database`'s business."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from featuredb.errors import MapNotFoundError, StoreError
from featuredb.store.encode import Row

RETIRED = "retired"
QUARANTINED = "quarantined"


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What a commit to `maps` will do.

    Attributes:
        rows: all rows after the change.
        added: the rows among them that are new.
        only_adds: no old row is changed or gone, so that appending `added` is enough.
        flagged: ids of maps put into quarantine, because a map that placed them gave way.
    """

    rows: list[Row]
    added: list[Row]
    only_adds: bool
    flagged: tuple[str, ...] = ()


def live_row(rows: Iterable[Row], map_id: str) -> Row | None:
    """The row of a map that is visible and not retired, or None."""
    return next((row for row in rows if row["map_id"] == map_id and row["status"] != RETIRED), None)


def add_maps(rows: Sequence[Row], new_rows: Sequence[Row], replaces: Sequence[str]) -> Change:
    """Add maps in the place of those that `replaces` names.

    A retired row of the same map id gives way to the new one. A replaced map of another id stays in the table
    as retired, with the reason. Maps that hang on a replaced one, directly or through others, were placed by
    what no longer holds: they are quarantined, with the reason, unless they are among the new ones.

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
    stale = descendants(kept, [m for m in replaces if live_row(rows, m) is not None])
    flagged = [row["map_id"] for row in kept if row["map_id"] in stale and row["status"] != QUARANTINED]
    kept = [_quarantined(row, stale[row["map_id"]]) if row["map_id"] in flagged else row for row in kept]
    unchanged = len(kept) == len(rows) and all(a is b for a, b in zip(kept, rows, strict=True))
    return Change(rows=[*kept, *new_rows], added=list(new_rows), only_adds=unchanged, flagged=tuple(flagged))


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


def descendants(rows: Iterable[Row], ancestors: Iterable[str]) -> dict[str, str]:
    """Live maps with a chain of live parents up to one of `ancestors`, and the ancestor that each hangs on.

    The ancestors themselves are not among them, whether live or not.
    """
    live = {row["map_id"]: row["parents"] for row in rows if row["status"] != RETIRED}
    root = {map_id: map_id for map_id in ancestors}
    tops = set(root)
    while True:
        more = {
            map_id: root[parent]
            for map_id, parents in live.items()
            if map_id not in root
            for parent in parents[::-1]
            if parent in root
        }
        if not more:
            return {map_id: top for map_id, top in root.items() if map_id not in tops}
        root |= more


def _quarantined(row: Row, ancestor: str) -> Row:
    reason = f"map {ancestor}, which placed it, was placed anew; place this one anew, too"
    return {**row, "status": QUARANTINED, "status_reason": reason}


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
