"""The maps of a dataset, exactly as they were exported, and their way back into a database.

There they are the same maps, in quarantine unless somebody vouches for the dataset.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from featuredb.errors import ExportError, FeatureDbError
from featuredb.export.dataset import layout
from featuredb.export.dataset.columns import CAMERAS, MAPS
from featuredb.export.dataset.layout import check_sums
from featuredb.export.dataset.partitions import COLUMNS
from featuredb.export.job import Told
from featuredb.maps.feature_map import MAP_STATUSES, FeatureMap
from featuredb.maps.lineage import reached
from featuredb.maps.unplaced_map import UNPLACED_STATUSES, AnyMap, MapKind, UnplacedMap
from featuredb.store import tables as store
from featuredb.store.changes import ACTIVE, IMPORTED, RETIRED, VOUCHED, anchored, vouch_for
from featuredb.store.database import Database
from featuredb.store.decode import decode_map
from featuredb.store.encode import content_digest
from featuredb.store.snapshot import MapSummary

Row = dict[str, Any]


def read_dataset(folder: Path) -> Iterator[FeatureMap]:
    """The maps of a dataset, in the order of its `maps.parquet`, one in memory at a time.

    Every file is compared with SHA256SUMS before the first map comes, and every map with its own digest.

    Raises:
        ExportError: not a dataset, of an unknown version, damaged, or with contents that contradict each
        other.
    """
    rows, listed = open_dataset(folder)
    return (load_map(folder, row, listed) for row in rows)


def open_dataset(folder: Path) -> tuple[list[Row], frozenset[str]]:
    """What is known of the maps, by the store's columns, and the files that SHA256SUMS vouches for.

    Raises:
        ExportError: as `read_dataset`.
    """
    listed = check_sums(folder)
    for name in (layout.DESCRIPTION, layout.MAPS, layout.CAMERAS):
        check_listed(name, listed, folder)
    layout.read_description(folder)
    wanted = [name for name in MAPS.schema.names if name not in ("created_at", "geometry", "bbox")]
    rows = read_table(folder / layout.MAPS, wanted).to_pylist()
    empty = [n for n in wanted if not MAPS.schema.field(n).nullable and any(row[n] is None for row in rows)]
    if empty:
        raise ExportError(f"{folder / layout.MAPS}: expected values in {', '.join(empty)}, some are missing")
    cameras: dict[str, list[Row]] = defaultdict(list)
    for camera in read_table(folder / layout.CAMERAS, CAMERAS.schema.names).to_pylist():
        cameras[camera["map_id"]].append(camera)
    for row in rows:
        own = sorted(cameras[row["map_id"]], key=lambda camera: int(camera["camera_id"]))
        row["cameras"] = [{name: c[name] for name in ("model", "width", "height", "params")} for c in own]
        row["camera_keys"] = [c["key"] for c in own if c["key"] is not None]
    return rows, listed


def load_map(folder: Path, row: Row, listed: frozenset[str]) -> FeatureMap:
    """One map.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    return decoded(
        folder, row, lambda: {table: _rows_of(folder, table, row, listed) for table in COLUMNS}, FeatureMap
    )


def decoded(
    folder: Path, row: Row, children: Callable[[], dict[str, list[pa.RecordBatch]]], kind: type[MapKind]
) -> MapKind:
    """The map of a row and of the rows of its tables.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    map_id = row["map_id"]
    try:
        found = decode_map(row, children())
    except FeatureDbError as error:
        raise ExportError(f"{folder}, map {map_id}: its files do not make a map ({error})") from error
    if not isinstance(found, kind) or content_digest(found) != row["content_digest"]:
        raise ExportError(
            f"{folder}, map {map_id}: the files hold another map than the one that was exported "
            f"(its digest was {row['content_digest']}); get the dataset once more from its source"
        )
    return found


def _rows_of(
    folder: Path, table: str, row: Mapping[str, Any], listed: frozenset[str]
) -> list[pa.RecordBatch]:
    name = row[f"{table}_file"]
    if name is None:
        return []
    check_listed(name, listed, folder)
    wanted = [column for column in COLUMNS[table].schema.names if column not in ("geometry", "bbox")]
    only = ds.field("map_id") == row["map_id"]
    return list(read_table(folder / name, wanted, only).to_batches())


def read_table(path: Path, columns: list[str] | None = None, only: ds.Expression | None = None) -> pa.Table:
    """Columns (None: all) of the rows of a table that fit.

    Raises:
        ExportError: it cannot be read.
    """
    try:
        return pq.read_table(path, columns=columns, filters=only, use_threads=False, partitioning=None)
    except (OSError, pa.ArrowException, KeyError) as error:
        why = str(error).partition("\n")[0]  # Arrow's have the whole schema below
        raise ExportError(f"{path}: expected a table of a dataset, cannot read it ({why})") from error


def check_listed(name: str, listed: frozenset[str], folder: Path) -> None:
    """Raise ExportError for a file that SHA256SUMS does not vouch for."""
    if name not in listed:
        raise ExportError(
            f"{folder}: SHA256SUMS does not list {name}, which is part of a dataset; copy it again"
        )


def own_rows(folder: Path, listed: frozenset[str]) -> list[Row]:
    """What is known of the maps without a place, by the store's columns; none where the dataset has none.

    Args:
        listed: files that SHA256SUMS vouches for.

    Raises:
        ExportError: the table cannot be read.
    """
    if layout.own_path(store.MAPS) not in listed:
        return []
    return list(read_table(folder / layout.own_path(store.MAPS)).to_pylist())


def load_own(folder: Path, row: Mapping[str, Any], listed: frozenset[str]) -> UnplacedMap:
    """One map without a place.

    Raises:
        ExportError: its rows cannot be read, or are not the map that was exported.
    """
    for table in store.CHILD_TABLES:
        check_listed(layout.own_path(table), listed, folder)
    only = ds.field("map_id") == row["map_id"]
    return decoded(
        folder,
        dict(row),
        lambda: {
            t: read_table(folder / layout.own_path(t), only=only).to_batches() for t in store.CHILD_TABLES
        },
        UnplacedMap,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Imported:
    """What an import did, or would do.

    Attributes:
        created: ids of maps that are visible now and were not before.
        present: ids of maps that the database had already, with the same content; they are left as they are.
        retired: those of them that are retired here, by id with the reason.
        quarantined: active maps of the dataset that came in quarantine; with the ids of maps that placed them
            and are neither in the dataset nor in the database.
    """

    created: tuple[str, ...]
    present: tuple[str, ...]
    retired: Mapping[str, str] = field(default_factory=dict)
    quarantined: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    version: int
    dry_run: bool


def import_dataset(
    database: Database,
    folder: Path,
    *,
    trusted: bool = False,
    dry_run: bool = False,
    told: Told = lambda done, total: None,
) -> Imported:
    """Commit the maps of a dataset, one after the other, parents before what they have placed.

    All of it is compared with its checksums before the first commit. Importing again changes nothing; an
    import that was killed goes on where it was. Active maps come in quarantine until they are promoted, and
    growth does not listen to them. With `trusted` a map keeps its status, with one exception: the store
    lets a map answer only if a chain of maps leads from it to an anchor. Where the dataset and the database
    lack the maps that an active one stands on, it comes in quarantine; `featuredb lineage` shows it, and it
    can be promoted when they are there. Scans of the dataset are left where they are: `featuredb lidar add`
    takes LAZ.

    Args:
        trusted: you vouch for the dataset, and its photos count as your own; also for maps of it that an
            earlier import has left in quarantine.
        dry_run: read and check everything, write nothing.

    Raises:
        ExportError: the folder is no sound dataset, or the database has another map of the same id. Nothing
            has been committed, or the message says what has.
        ConflictError, StoreError: the store failed; the import can be run again.
    """
    rows, listed = open_dataset(folder)
    own = own_rows(folder, listed)
    if own and not dry_run:
        database.require_newest_format("keep maps without a place")
    rows = [*rows, *own]
    own_ids = {row["map_id"] for row in own}
    snapshot = database.snapshot()
    there = {m.map_id: m for m in snapshot.any_maps(include_retired=True)}
    live = {map_id: m for map_id, m in there.items() if m.status != RETIRED}
    _check_rows(folder, rows, {map_id: m.content_digest for map_id, m in live.items()})
    stay = {
        r["map_id"]
        for r in rows
        if r["map_id"] in there.keys() - live.keys()
        and there[r["map_id"]].content_digest == r["content_digest"]
    }
    rows = [row | {"status": RETIRED} if row["map_id"] in stay else row for row in rows]
    missing = _missing_parents(
        rows, {map_id: m.parents if isinstance(m, MapSummary) else () for map_id, m in live.items()}
    )
    held = missing if trusted else {r["map_id"]: () for r in rows if r["status"] == ACTIVE} | missing
    created: list[str] = []
    present: list[str] = []
    for done, row in enumerate(_parents_first(rows)):
        map_id = row["map_id"]
        new = map_id not in there or (map_id not in live and row["status"] != RETIRED)
        if dry_run or new:
            try:
                found = load_own(folder, row, listed) if map_id in own_ids else load_map(folder, row, listed)
            except ExportError as error:
                before = f"; imported before it: {', '.join(created)}" if created and not dry_run else ""
                raise ExportError(f"{error}{before}") from error
            if not dry_run:
                _commit(database, found, _vouched_reason(row, missing), map_id in missing, trusted)
        (created if new else present).append(map_id)
        told(done + 1, len(rows))
    if trusted and not dry_run:
        _vouch_for(database, rows, missing)
    return Imported(
        created=tuple(created),
        present=tuple(present),
        retired={m: there[m].status_reason for m in present if m not in live},
        quarantined={map_id: held[map_id] for map_id in created if map_id in held},
        version=database.poll_version(),
        dry_run=dry_run,
    )


def _vouch_for(database: Database, rows: Sequence[Row], missing: Mapping[str, Sequence[str]]) -> None:
    """Lift the mark of the dataset's maps that an earlier import has left in quarantine."""
    active = {row["map_id"] for row in rows if row["status"] == ACTIVE and row["map_id"] not in missing}
    reasons = {row["map_id"]: _vouched_reason(row, missing) for row in rows if row["status"] != RETIRED}
    vouch = partial(vouch_for, active=active, reasons=reasons)
    database.change_rows("vouch for what was imported", "vouch", VOUCHED, vouch)


def _vouched_reason(row: Row, missing: Mapping[str, Sequence[str]]) -> str:
    """The dataset's, but where it says that nobody has vouched for the map."""
    if row["map_id"] in missing:
        return f"what placed it is not here: {', '.join(missing[row['map_id']])}"
    return VOUCHED if row["status_reason"] == IMPORTED else row["status_reason"] or ""


def _commit(database: Database, feature_map: AnyMap, reason: str, missing: bool, trusted: bool) -> None:
    new = not trusted and feature_map.status != RETIRED
    if (missing or new) and isinstance(feature_map, FeatureMap):
        feature_map = feature_map.with_status("quarantined")
    if new:
        reason = IMPORTED  # not what the dataset says: reasons decide what growth does with a map
    if feature_map.status == RETIRED and not reason:
        reason = "it was retired where the dataset is from"
    database.commit_maps([feature_map], reasons={feature_map.map_id: reason})


def _check_rows(folder: Path, rows: Sequence[Row], digests: Mapping[str, str]) -> None:
    """Refuse what cannot be imported whole; `digests` are those of the maps that live in the database."""
    twice = sorted(map_id for map_id, count in Counter(row["map_id"] for row in rows).items() if count > 1)
    if twice:
        raise ExportError(f"{folder}: expected different map ids, found {', '.join(twice)} more than once")
    known = dict.fromkeys((*MAP_STATUSES, *UNPLACED_STATUSES))
    wrong = sorted({row["status"] for row in rows} - known.keys())
    if wrong:
        raise ExportError(f"{folder}: expected a status of {', '.join(known)}, found {', '.join(wrong)}")
    others = [
        r["map_id"] for r in rows if digests.get(r["map_id"], r["content_digest"]) != r["content_digest"]
    ]
    if others:
        raise ExportError(
            f"{folder}: the database has other maps of the ids {', '.join(others)} (placed anew, thinned, or "
            "exported in part, by licence); nothing was imported; use an empty database, or retire those"
        )


def _missing_parents(rows: Sequence[Row], live: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Active maps of the dataset without a chain to an anchor, and the maps that they would need for one.

    Retired maps are no part of a chain.

    Args:
        live: parents of the maps that live in the database, by id.
    """
    parents = {**live, **{row["map_id"]: row["parents"] for row in rows if row["status"] != RETIRED}}
    known = [{"map_id": m, "parents": p, "status": ACTIVE} for m, p in parents.items()]
    standing = anchored(known)
    fallen = [r["map_id"] for r in rows if r["status"] == ACTIVE and r["map_id"] not in standing]
    return {map_id: tuple(sorted(reached([map_id], parents) - parents.keys())) for map_id in fallen}


def _parents_first(rows: Sequence[Row]) -> list[Row]:
    """In the dataset's order, but for maps that come before their parents there."""
    known = {row["map_id"]: row for row in rows}
    ordered: dict[str, Row] = {}
    for row in rows:
        waiting = [row]
        seen = set()
        while waiting:
            top = waiting[-1]
            seen.add(top["map_id"])
            before = [p for p in top["parents"] if p in known and p not in ordered and p not in seen]
            if before:
                waiting.append(known[before[0]])
            else:
                ordered.setdefault(top["map_id"], waiting.pop())
    return list(ordered.values())
