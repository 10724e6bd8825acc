"""The database: Delta tables, snapshots, commits, checks, SQL. The home of deltalake and DuckDB."""

from featuredb.store.commits import HistoryEntry
from featuredb.store.database import CommitResult, Database, StatusResult
from featuredb.store.snapshot import MapSummary, Snapshot, UnplacedSummary, UtmBox

__all__ = [
    "CommitResult",
    "Database",
    "HistoryEntry",
    "MapSummary",
    "Snapshot",
    "StatusResult",
    "UnplacedSummary",
    "UtmBox",
]
