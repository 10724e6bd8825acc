"""The database: Delta tables, snapshots, commits, checks, SQL. The home of deltalake and DuckDB.

What this package names is imported when it is asked for: a command's help needs none of it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from featuredb.store.commits import CommitResult, StatusResult
    from featuredb.store.database import Database
    from featuredb.store.durable.log import Commit
    from featuredb.store.snapshot import MapSummary, Snapshot, UnplacedSummary, UtmBox

__all__ = [
    "Commit",
    "CommitResult",
    "Database",
    "MapSummary",
    "Snapshot",
    "StatusResult",
    "UnplacedSummary",
    "UtmBox",
]

_MODULES = {
    "commits": ("CommitResult", "StatusResult"),
    "database": ("Database",),
    "durable.log": ("Commit",),
    "snapshot": ("MapSummary", "Snapshot", "UnplacedSummary", "UtmBox"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
