"""A database of an older release made one of today's. Each step is one commit; what was cut off goes on."""

import pyarrow as pa
import pyarrow.compute as pc

from featuredb.store.commits import read_rows, upgrade_metadata
from featuredb.store.database import Database
from featuredb.store.delta import Table
from featuredb.store.durable.log import acknowledge, acknowledged
from featuredb.store.durable.making import is_of_an_older_release
from featuredb.store.encode import map_rows_table
from featuredb.store.retry import retry_stale
from featuredb.store.tables import FORMAT_VERSION, MAPS, SPECS


def upgrade(database: Database) -> list[str]:
    """Bring all tables to the newest format, and files and records to what this release writes.

    All maps and snapshots stay as they are. `maps` comes last: until then the format is the old one.

    Returns:
        What was done, a sentence for each step; none where nothing was to be done.

    Raises:
        ConflictError: other writers were faster too many times.
        StoreError: the store failed.
    """
    steps: list[str] = []
    for name in (*(name for name in SPECS if name != MAPS), MAPS):
        if Table.exists(database.table_url(name), database.storage_options):
            steps += _upgrade_table(database, name)
    return steps


def _upgrade_table(database: Database, name: str) -> list[str]:
    steps = []
    table = database.table(name)
    record = acknowledged(table.storage)
    if table.format < FORMAT_VERSION:
        steps.append(
            f"{name}: format {table.format} became {FORMAT_VERSION}, which older releases cannot read"
        )
        retry_stale(f"upgrade of {name}", lambda: _to_newest_format(database.table(name)))
    if name != MAPS:  # whose rows are never removed
        rewritten = 0
        while database.table(name).rewrite(_old_rows):
            rewritten += 1
        if rewritten:
            steps.append(f"{name}: {rewritten} files of an older release written anew")
    if record is None:
        table = database.table(name)
        acknowledge(table.storage, table.version)
        steps.append(f"{name}: version {table.version} noted as the last one that is committed")
    return steps


def _to_newest_format(table: Table) -> None:
    if table.spec.name == MAPS:
        table.upgrade(map_rows_table(read_rows(table)), upgrade_metadata())
    else:
        table.upgrade()


def _old_rows(table: Table) -> pa.Table | None:
    """All rows of the writes that the first file of an older release has rows of, or None."""
    schema = table.dataset().schema
    fragments = {fragment.path: fragment for fragment in table.dataset().get_fragments()}
    old = next((f for f in fragments.values() if is_of_an_older_release(f)), None)
    if old is None:
        return None
    ids = pc.unique(old.to_table(schema, ["write_id"])["write_id"])
    return pa.concat_tables(
        rows.filter(pc.is_in(rows["write_id"], ids))
        for file in table.files()
        if any((file.min_write_id or i) <= i <= (file.max_write_id or i) for i in ids.to_pylist())
        for rows in [fragments[file.path].to_table(schema)]
    )
