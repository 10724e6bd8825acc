"""What every commit has in common: its name, its place as the very next version, result and history."""

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from featuredb.errors import ConflictError, SnapshotNotFoundError
from featuredb.store.changes import Change
from featuredb.store.delta import Table
from featuredb.store.durable.log import CHANGED, OPERATION, REASON, Commit
from featuredb.store.encode import EncodedMap, rows_table

# A commit whose child rows are older than this is refused, because a vacuum may already have taken them for
# orphans; it is well below the vacuum's shortest default grace of a day.
LONGEST_COMMIT = timedelta(hours=6)

KEPT_FROM = "featuredb.kept_from"  # key of what a vacuum's commit says


@dataclass(frozen=True, slots=True, kw_only=True)
class CommitResult:
    """What became of one map.

    Attributes:
        created: False if the map was visible already and nothing had to be done.
        version: snapshot in which the map is visible.
        flagged: ids of other maps that this commit put into quarantine, because what placed them gave way.
    """

    map_id: str
    created: bool
    version: int
    write_id: str
    flagged: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusResult:
    """What a change of status did.

    Attributes:
        changed: ids of the maps whose status changed, none where nothing was to be done; those asked for
            first, behind them maps that were quarantined because they hang on one of these alone.
    """

    version: int
    changed: tuple[str, ...]


def new_write_id(now: datetime) -> str:
    """32 hex digits that begin with the time in milliseconds, so that an orphan tells its age."""
    return f"{int(now.timestamp() * 1000):012x}{uuid.uuid4().hex[:20]}"


def write_time(write_id: str) -> datetime:
    """When the rows of a write id were begun, UTC."""
    return datetime.fromtimestamp(int(write_id[:12], 16) / 1000.0, tz=UTC)


def commit_as_of(as_of: int | datetime, commits: Sequence[Commit]) -> Commit:
    """The commit of a number, or the newest at a time; commits come newest first."""
    first_kept = oldest_kept_version(commits)
    readable = [commit for commit in commits if commit.version >= first_kept]
    if isinstance(as_of, datetime):
        if as_of.tzinfo is None:
            raise SnapshotNotFoundError(f"expected a time with a time zone, found {as_of.isoformat()}")
        fitting = [commit for commit in readable if commit.timestamp <= as_of]
    else:
        fitting = [commit for commit in readable if commit.version == as_of]
    if not fitting:
        raise SnapshotNotFoundError(
            f"expected a version from {readable[-1].version} ({readable[-1].timestamp.isoformat()}) to "
            f"{readable[0].version}, found {as_of}; `featuredb history` lists them, older ones were vacuumed"
        )
    return fitting[0]


def oldest_kept_version(commits: Sequence[Commit]) -> int:
    """The oldest version whose files no vacuum has taken; vacuum notes it in its commit."""
    return max((int(c.metadata.get(KEPT_FROM, 0)) for c in commits), default=0)


def check_children(encoded: EncodedMap, table_of: Callable[[str], Table]) -> None:
    """Refuse to name rows that have gone.

    Raises:
        ConflictError: a vacuum of less grace than this commit took has removed them.
    """
    for name, rows in encoded.children.items():
        found = table_of(name).count("write_id", encoded.row["write_id"]) if len(rows) else 0
        if found != len(rows):
            raise ConflictError(
                f"commit of {encoded.row['map_id']}: expected its {len(rows)} rows of {name}, found {found}; "
                "a vacuum has removed them, and nothing was committed: commit again"
            )


def apply_change(
    table: Table,
    change: Change,
    *,
    operation: str,
    changed: Sequence[str] = (),
    reason: str = "",
    extra: Mapping[str, str] | None = None,
) -> int:
    """Commit a change of `maps` or `lidar` as the very next version and return its number.

    Args:
        changed: ids of the maps or scans that history names with it.

    Raises:
        StaleVersionError: someone else committed since `table` was read.
    """
    if change.added is not None and not change.added:
        return table.version
    metadata = {OPERATION: operation, CHANGED: "\n".join(changed), REASON: reason, **(extra or {})}
    if change.added is not None:
        return table.swap(rows_table(table.spec.name, change.added), mode="append", metadata=metadata)
    return table.swap(rows_table(table.spec.name, change.rows), mode="overwrite", metadata=metadata)
