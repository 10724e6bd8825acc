"""Changes to the table `maps` as pure functions from rows to rows. Applying them is `Database`'s business."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from featuredb.errors import ConflictError, MapNotFoundError, StoreError
from featuredb.maps.lineage import children_of, reached
from featuredb.store.encode import Row
from featuredb.store.tables import PLACE_COLUMNS

ACTIVE = "active"
QUARANTINED = "quarantined"
RETIRED = "retired"
UNPLACED = "unplaced"
# The reason of a map's status that came with a dataset.
IMPORTED = "imported, and nobody here has vouched for it"
VOUCHED = "imported, and vouched for later"
# Columns that say where a map lies; equal ones mean that it was not placed anew.
_PLACE = (*sorted({*PLACE_COLUMNS} - {"residual_rms_m"}), "generation", "parents", "cameras")


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """What a commit to `maps` or `lidar` will do.

    Attributes:
        rows: all rows after the change.
        added: the new rows, where no old one is changed or gone, so that appending them is enough; else None.
            (): nothing is to be committed.
        flagged: ids of maps put into quarantine, because a map that placed them gave way.
    """

    rows: list[Row]
    added: Sequence[Row] | None = None
    flagged: tuple[str, ...] = ()


def live_row(rows: Iterable[Row], wanted: str, column: str = "map_id") -> Row | None:
    """The row of a map, or of a scan by `scan_id`, that is visible and not retired, or None."""
    return next((row for row in rows if row[column] == wanted and row["status"] != RETIRED), None)


def check_unchanged(rows: Sequence[Row], based_on: Mapping[str, str]) -> None:
    """Refuse to replace what the caller has never seen.

    Args:
        based_on: write ids, by id, of the maps that were seen.

    Raises:
        ConflictError: one has been placed anew, retired or rolled back.
    """
    for map_id, write_id in based_on.items():
        row = live_row(rows, map_id)
        if row is None or row["write_id"] != write_id:
            found = "retired or gone" if row is None else "placed anew"
            raise ConflictError(
                f"map {map_id} was {found} by someone else while this was computed from an earlier state "
                f"of it (write {write_id}); run the command again"
            )


def check_active(rows: Sequence[Row], active: Collection[str] | None) -> None:
    """Refuse a decision that was made beside other maps than those that answer now.

    Args:
        active: write ids of the maps that were active then; None: does not matter.

    Raises:
        ConflictError: others are active now.
    """
    now = {row["write_id"] for row in rows if row["status"] == ACTIVE}
    if active is not None and now != set(active):
        raise ConflictError(
            f"the active maps have changed since this was decided ({len(now - set(active))} came, "
            f"{len(set(active) - now)} went); run the command again"
        )


def add_maps(
    rows: Sequence[Row], new_rows: Sequence[Row], replaces: Sequence[str], *, moves: bool = True
) -> Change:
    """Add maps in the place of those that `replaces` names.

    A retired row of the same map id gives way to the new one. A replaced map of another id stays in the table
    as retired, with the reason. Maps that hang on a replaced one, directly or through others, were placed by
    what no longer holds: they are quarantined, with the reason, unless they are among the new ones.

    Args:
        moves: False where the new maps are the old ones at the very same place, thinned for example; then
            nothing that hangs on them is touched.

    Raises:
        MapNotFoundError: a map to be replaced is not there.
        StoreError: with `moves` false, a new map is not the successor of one at the same place.
    """
    for new in () if moves else new_rows:
        old = live_row(rows, new["map_id"])
        differing = [name for name in _PLACE if old is None or old[name] != new[name]]
        if differing:
            raise StoreError(
                f"map {new['map_id']}: expected a state at the same place as the live one, found another "
                f"{', '.join(differing)}; commit it as one that moves"
            )
    new_ids = [row["map_id"] for row in new_rows]
    new_rows = [_still_imported(row, live_row(rows, row["map_id"])) for row in new_rows]
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
    stale = descendants(kept, [m for m in replaces if live_row(rows, m) is not None]) if moves else {}
    flagged = [row["map_id"] for row in kept if row["map_id"] in stale and row["status"] != QUARANTINED]
    for k, row in enumerate(kept):
        if row["map_id"] in flagged:
            reason = f"map {stale[row['map_id']]}, which placed it, was placed anew; place this one anew, too"
            kept[k] = {**row, "status": QUARANTINED, "status_reason": reason}
    unchanged = len(kept) == len(rows) and all(a is b for a, b in zip(kept, rows, strict=True))
    added = new_rows if unchanged else None
    return Change(rows=[*kept, *new_rows], added=added, flagged=tuple(flagged))


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
        return Change(rows=list(rows), added=()), []
    dependants = sorted(anchored(rows) - anchored(rows, without=map_id) - {map_id})
    retired = [map_id, *dependants]
    changed = with_status(rows, [map_id], RETIRED, reason)
    return Change(rows=with_status(changed, dependants, RETIRED, f"{reason} ({map_id})")), retired


def with_status(
    rows: Iterable[Row], ids: Sequence[str], status: str, reason: str, column: str = "map_id"
) -> list[Row]:
    """The rows, with another status of some maps, or of scans by `scan_id`."""
    return [{**r, "status": status, "status_reason": reason} if r[column] in ids else r for r in rows]


def change_status(
    rows: Sequence[Row], map_ids: Sequence[str], status: str, reason: str
) -> tuple[Change, list[str]]:
    """Make maps active or quarantined; returns the change and the ids whose status changes.

    Active maps that lose their last chain of active parents are quarantined, too.

    Raises:
        MapNotFoundError: no such map.
        StoreError: another status, no reason, a retired map, or parents that do not carry a promotion.
    """
    if status not in (ACTIVE, QUARANTINED):
        raise StoreError(f"expected the status {ACTIVE} or {QUARANTINED}, found {status!r}; use `retire`")
    if not reason.strip():
        raise StoreError(
            f"{status} for {', '.join(map_ids)}: expected a reason, for those who will ask later"
        )
    known = {row["map_id"]: row for row in rows}
    for map_id in map_ids:
        if map_id not in known:
            raise MapNotFoundError(f"no map {map_id}; `featuredb maps` lists what there is")
        if known[map_id]["status"] == UNPLACED:
            raise StoreError(f"map {map_id} has no place, so it cannot be {status}; place it first")
        if known[map_id]["status"] == RETIRED:
            raise StoreError(f"map {map_id} is retired ({known[map_id]['status_reason']}); promote it")
    wanted = [m for m in dict.fromkeys(map_ids) if known[m]["status"] != status]
    if not wanted:
        return Change(rows=list(rows), added=()), []
    changed = with_status(rows, wanted, status, reason)
    standing = anchored(changed, statuses=(ACTIVE,))
    if status == ACTIVE:
        _check_parents(known, [m for m in wanted if m not in standing])
        return Change(rows=changed), wanted
    fallen = sorted(anchored(rows, statuses=(ACTIVE,)) - standing - set(wanted))
    changed = with_status(changed, fallen, QUARANTINED, f"{reason} ({', '.join(wanted)})")
    return Change(rows=changed), [*wanted, *fallen]


def _check_parents(known: Mapping[str, Row], refused: Sequence[str]) -> None:
    if not refused:
        return
    parents = {
        f"{parent} is {known[parent]['status'] if parent in known else 'not there'}"
        for map_id in refused
        for parent in known[map_id]["parents"]
    }
    raise StoreError(
        f"map {', '.join(refused)} cannot be promoted: no chain of active parents leads to an anchor "
        f"({'; '.join(sorted(parents))}); promote the parents first or in the same command"
    )


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


def is_imported(status: str, reason: str) -> bool:
    """Whether a map came with a dataset, and nobody here has vouched for it by a promotion."""
    return status in (QUARANTINED, UNPLACED) and reason == IMPORTED


def vouch_for(
    rows: Sequence[Row], active: Collection[str], reasons: Mapping[str, str]
) -> tuple[Change, list[str]]:
    """Take imported maps for what their dataset says; returns the change and the ids that it is about.

    Args:
        active: ids of those that the dataset calls active. One that no chain of active parents carries stays
            in quarantine, with the parents in the way for a reason.
        reasons: why each other map is quarantined or without a place, by the ids of all maps of the dataset.
    """
    ids = [
        r["map_id"] for r in rows if r["map_id"] in reasons and is_imported(r["status"], r["status_reason"])
    ]
    if not ids:
        return Change(rows=list(rows), added=()), []
    up = {
        r["map_id"] for r in rows if r["map_id"] in active and r["map_id"] in ids and r["status"] != UNPLACED
    }
    standing = anchored(
        [{**r, "status": ACTIVE} if r["map_id"] in up else r for r in rows], statuses=(ACTIVE,)
    )

    def vouched(row: Row) -> Row:
        if row["map_id"] not in up:
            return {**row, "status_reason": reasons[row["map_id"]]}
        if row["map_id"] in standing:
            return {**row, "status": ACTIVE, "status_reason": VOUCHED}
        lacking = ", ".join(p for p in row["parents"] if p not in standing)
        return {**row, "status_reason": f"what placed it is not active: {lacking}"}

    return Change(rows=[vouched(r) if r["map_id"] in ids else r for r in rows]), ids


def _still_imported(row: Row, before: Row | None) -> Row:
    """The row of a map that was imported says so until it is promoted, whatever else is done to the map."""
    if before is None or not is_imported(before["status"], before["status_reason"]):
        return row
    keeps = not row["status_reason"] and is_imported(row["status"], before["status_reason"])
    return {**row, "status_reason": before["status_reason"]} if keeps else row


def anchored(
    rows: Iterable[Row], without: str | None = None, statuses: Collection[str] = (ACTIVE, QUARANTINED)
) -> set[str]:
    """Ids of maps of the given statuses that have a chain of such parents down to a map without parents.

    With `without`, as if that map were not there.
    """
    live = {row["map_id"]: row["parents"] for row in rows if row["status"] in statuses}
    live.pop(without or "", None)
    return reached([map_id for map_id, parents in live.items() if not parents], children_of(live))
