"""A database of an older format made one of the newest. Each step is one commit; what was cut off goes on."""

from featuredb.store.commits import upgrade_metadata
from featuredb.store.database import Database
from featuredb.store.decode import read_rows
from featuredb.store.encode import rows_table
from featuredb.store.retry import retry_stale
from featuredb.store.tables import FORMAT_VERSION, MAPS


def upgrade(database: Database) -> list[str]:
    """Bring all tables to the newest format.

    All maps and snapshots stay as they are. `maps` comes last: until then the format is the old one.

    Returns:
        What was done, a sentence for each step; none where nothing was to be done.

    Raises:
        ConflictError: other writers were faster too many times.
        StoreError: the store failed.
    """
    steps: list[str] = []
    for name in reversed(database.tables()):
        found = database.table(name).format
        if found < FORMAT_VERSION:
            _to_newest_format(database, name)
            steps.append(f"{name}: format {found} became {FORMAT_VERSION}, which older releases cannot read")
    return steps


def _to_newest_format(database: Database, name: str) -> None:
    def attempt() -> None:
        table = database.table(name)
        if name == MAPS:
            table.upgrade(rows_table(MAPS, read_rows(table)), upgrade_metadata())
        else:
            table.upgrade()

    retry_stale(f"upgrade of {name}", attempt)
