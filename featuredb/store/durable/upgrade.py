"""A database of an older release made one of today's. Each step is one commit; what was cut off goes on."""

from collections.abc import Collection

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

_COMMIT_BYTES = 256 * 2**20  # of old files whose rows one commit writes anew: they are in memory at once


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
        rewritten = _rewrite_old_files(database, name)
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


def _rewrite_old_files(database: Database, name: str) -> int:
    """Write the files of older releases anew; returns how many there were."""
    fragments = database.table(name).dataset().get_fragments()
    old = {fragment.path for fragment in fragments if is_of_an_older_release(fragment)}
    while database.table(name).rewrite(lambda table: _some_rows(table, old)):
        pass
    return len(old)


def _some_rows(table: Table, old: Collection[str]) -> pa.Table | None:
    """All rows of the writes in the first of these files, as many as one commit takes, or None."""
    schema, files = table.dataset().schema, table.files()
    fragments = {fragment.path: fragment for fragment in table.dataset().get_fragments()}
    taken, size_bytes = list[pa.ChunkedArray](), 0
    for file in files:
        if file.path in old and (not taken or size_bytes + file.size_bytes <= _COMMIT_BYTES):
            taken.append(fragments[file.path].to_table(schema, ["write_id"])["write_id"])
            size_bytes += file.size_bytes
    if not taken:
        return None
    ids = pc.unique(pa.chunked_array([chunk for ids in taken for chunk in ids.chunks]))
    return pa.concat_tables(
        rows.filter(pc.is_in(rows["write_id"], ids))
        for file in files
        if any((file.min_write_id or i) <= i <= (file.max_write_id or i) for i in ids.to_pylist())
        for rows in [fragments[file.path].to_table(schema)]
    )
