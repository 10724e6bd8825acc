"""One Delta table, typed: what the store needs of deltalake.

What deltalake 1.6 does, and tests/integration/test_delta_behaviour.py pins:
- An append rebases onto whatever was committed meanwhile. Right for child rows, which nobody else names.
- So does an overwrite: rows that another writer appended meanwhile would live on beside the new ones. Nothing
  that depends on what it read may therefore go through the library's own retries.
- `max_commit_retries=0` makes any commit a compare-and-swap on the version the table object was loaded at: if
  the next log entry exists already, it raises. All commits to `maps` go this way.
"""

import operator
import re
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.fs as fs
from deltalake import CommitProperties, DeltaTable, PostCommitHookProperties, Schema, write_deltalake
from deltalake.exceptions import CommitFailedError, DeltaError

from featuredb.errors import ConflictError, StoreError
from featuredb.store.durable.ages import old_files, old_scratch_folders, remove_files
from featuredb.store.durable.filesystem import store_errors, table_files
from featuredb.store.durable.log import Commit, acknowledge, check_end, read_commit
from featuredb.store.durable.making import (
    check_format,
    create_table,
    description,
    format_of,
    why_not_opened,
    writer_properties,
)
from featuredb.store.durable.publish import Sight, commit_locally, create_locally
from featuredb.store.retry import ATTEMPTS, StaleVersionError, retry_stale
from featuredb.store.tables import FORMAT_VERSION, TableSpec

T = TypeVar("T")

Condition = tuple[str, Literal["=", ">=", "<=", "in"], Any]  # column, relation, value; texts for "in"
_RELATIONS: dict[str, Callable[[Any, Any], ds.Expression]] = {
    "=": operator.eq,
    ">=": operator.ge,
    "<=": operator.le,
    "in": lambda column, texts: column.isin(pa.array(texts, pa.string())),
}
COMMIT_ID = "featuredb.commit_id"  # in the entries of compare-and-swaps
_HEX = re.compile(r"[0-9a-f]{1,64}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DataFile:
    """One live Parquet file of a table, as the log describes it.

    Attributes:
        write_id: of all its rows; None where the log does not say that they have the same.
    """

    path: str
    rows: int
    write_id: str | None


class Table:
    """A Delta table at one version. Not for use by several threads at once; make one object each."""

    def __init__(self, url: str, delta: Any, spec: TableSpec, storage_options: dict[str, str] | None) -> None:
        self._url = url
        self._delta = delta
        self.spec = spec
        self._storage_options = storage_options

    @classmethod
    def exists(cls, url: str, storage_options: dict[str, str] | None) -> bool:
        """Whether there is a Delta table of any kind."""
        with store_errors(f"cannot reach {url}"):
            return bool(DeltaTable.is_deltatable(url, storage_options=storage_options))

    @classmethod
    def create(cls, url: str, spec: TableSpec, storage_options: dict[str, str] | None) -> None:
        """Create the table where there is none; harmless where there is one."""
        if cls.exists(url, storage_options):
            return
        try:
            if "://" in url:
                create_table(url, spec, storage_options)
            else:
                create_locally(Path(url), lambda work: create_table(work, spec, None))
            acknowledge(table_files(url, storage_options), 0)
        except (DeltaError, OSError, StaleVersionError) as error:
            # Two creators at once: the loser finds the winner's table.
            if isinstance(error, OSError) or not cls.exists(url, storage_options):
                raise StoreError(f"cannot create table {url}: {error}") from error

    @classmethod
    def load(
        cls, url: str, spec: TableSpec, storage_options: dict[str, str] | None, version: int | None = None
    ) -> "Table":
        """Open the newest (or the given) version.

        Raises:
            DatabaseNotFoundError: no Delta table of this system there.
            SnapshotNotFoundError: no such version.
            StoreError: the store cannot be reached, or was written by a newer format.
        """
        try:
            delta = DeltaTable(url, version=version, storage_options=storage_options)
        except (DeltaError, OSError) as error:
            raise why_not_opened(url, storage_options, version, error) from error
        if version is None:
            check_end(url, table_files(url, storage_options, delta), int(delta.version()))
        check_format(url, spec, delta)
        return cls(url, delta, spec, storage_options)

    @property
    def version(self) -> int:
        return int(self._delta.version())

    @property
    def storage(self) -> fs.FileSystem:
        """The table's files; paths are relative to it."""
        return table_files(self._url, self._storage_options, self._delta)

    @property
    def format(self) -> int:
        """Format of the table, one of READABLE_FORMATS."""
        return int(format_of(self._delta.metadata()))

    def upgrade(self, rows: pa.Table | None = None, metadata: Mapping[str, str] | None = None) -> None:
        """Make a table of the newest format of one of an older one; harmless where it is of the newest.

        New columns are null in the rows that are there. Each step is one commit; after a crash the next call
        goes on where it was.

        Args:
            rows: all rows of the table, where columns must become nullable: they are written anew.

        Raises:
            StaleVersionError: someone committed in between; with `rows` nothing of theirs is overwritten.
            StoreError: the store failed.
        """
        if self.format == FORMAT_VERSION:
            return
        there = {field.name for field in self._delta.schema().fields}
        new = [field for field in Schema.from_arrow(self.spec.schema).fields if field.name not in there]
        if rows is not None and new:
            self.swap(rows, mode="overwrite", metadata=dict(metadata or {}), schema_mode="overwrite")
            self.refresh()

        def alter(delta: Any) -> None:
            if rows is None and new:
                delta.alter.add_columns(new)
            delta.alter.set_table_description(description())

        self._commit("upgrade", alter, "columns")

    def refresh(self) -> None:
        """Move to the newest version.

        Raises:
            StoreError: the store cannot be reached.
        """
        with store_errors(f"cannot read the log of {self._url}"):
            self._delta.update_incremental()
            check_end(self._url, self.storage, self.version)

    def dataset(self, where: Sequence[Condition] = ()) -> ds.Dataset:
        """The rows that meet all conditions, in the files that the log does not exclude."""
        filesystem = self.storage
        if "://" in self._url:
            filesystem = None  # deltalake's, which knows the files' sizes
        pruning = [condition for condition in where if condition[1] != "in"]
        with store_errors(f"cannot read {self._url}"):
            rows = self._delta.to_pyarrow_dataset(
                file_pruning_predicate=pruning or None, filesystem=filesystem
            )
            for column, relation, value in where:
                rows = rows.filter(_RELATIONS[relation](ds.field(column), value))
            return rows

    def count(self, column: str, value: str) -> int:
        """The rows with a value in a column of which the log has statistics."""
        with store_errors(f"cannot read {self._url}"):
            return int(self.dataset([(column, "=", value)]).count_rows())

    def files(self) -> list[DataFile]:
        """The live files."""
        rows = pa.table(self._delta.get_add_actions(flatten=True)).to_pylist()
        return [
            DataFile(
                path=unquote(row["path"]),
                rows=row.get("num_records") or 0,  # a damaged entry may not say
                write_id=first if (first := row.get("min.write_id")) == row.get("max.write_id") else None,
            )
            for row in rows
        ]

    def commits(self, limit: int | None = None) -> list[Commit]:
        """The log up to this version, newest first; each entry is one small file to read.

        Not by deltalake's `history`: where others have committed since the table was opened, it lists their
        entries, too, and numbers the newest of them with this table's version.
        """
        versions = range(self.version, -1, -1)[:limit]
        with store_errors(f"cannot read the log of {self._url}"):
            return [read_commit(self.storage, version) for version in versions]

    def append(self, rows: pa.Table | pa.RecordBatchReader) -> None:
        """Append child rows, of a table or as a stream; concurrent appends rebase and all land.

        Raises:
            ConflictError, StoreError
        """
        properties = CommitProperties(max_commit_retries=ATTEMPTS)
        try:
            self._commit(
                "write", lambda delta: self._write(delta, rows, "append", properties), "columns", rebase=True
            )
        except StaleVersionError as error:
            raise ConflictError(f"{error}; run the command again") from error

    def swap(
        self,
        rows: pa.Table,
        *,
        mode: Literal["append", "overwrite"],
        metadata: dict[str, str],
        schema_mode: Literal["overwrite"] | None = None,
    ) -> int:
        """Commit as the version right after the one this object holds, and return it.

        Raises:
            StaleVersionError: the table has moved on; nothing was committed.
            StoreError: the store failed; an object store that does not answer may have taken the entry.
        """
        expected, mine = self.version + 1, uuid.uuid4().hex
        properties = CommitProperties(max_commit_retries=0, custom_metadata={**metadata, COMMIT_ID: mine})
        try:
            found, _ = self._commit(
                "write", lambda delta: self._write(delta, rows, mode, properties, schema_mode), "files"
            )
        except StoreError:
            if not self._has_taken(expected, mine):
                raise
            found = expected
        if found != expected:
            raise StoreError(f"{self._url}: expected version {expected}, found {found}")
        return expected

    def delete_rows(
        self, column: str, values: Iterable[str], metadata: Mapping[str, str] | None = None
    ) -> None:
        """Remove the rows with these values (ids in hexadecimal) in one commit, or none where there are none.

        Their bytes stay in files of earlier versions until a vacuum.
        """
        wanted = pa.array(values, pa.string())
        predicate = _is_in(column, wanted.to_pylist())
        properties = CommitProperties(custom_metadata=dict(metadata or {}))
        none = self.spec.schema.empty_table()

        # Not deltalake's `delete`: what it keeps has types that Arrow cannot filter, and other encodings.
        def delete(delta: Any) -> None:
            batches = self.dataset().to_batches(columns=[column], use_threads=False)
            if any(pc.any(pc.is_in(batch[column], wanted)).as_py() for batch in batches):
                self._write(delta, none, "overwrite", properties, predicate=predicate)

        self._maintain(delete)

    def compact(self) -> int:
        """Merge small files of each partition; returns the number of files saved."""
        metrics = self._maintain(
            lambda delta: delta.optimize.compact(writer_properties=writer_properties(self.spec))
        )
        return int(metrics["numFilesRemoved"]) - int(metrics["numFilesAdded"])

    def vacuum(
        self, grace: timedelta, *, dry_run: bool, keep_versions: Sequence[int] = (), untracked: bool = True
    ) -> list[str]:
        """Delete files that no version uses any more; returns their paths.

        Args:
            grace: files that were written or dropped within this time, by the store's clock, stay.
            keep_versions: whose files stay, beside those of the newest.
            untracked: also files that the log does not know: those of crashed writers, but with a short
                grace those of a writer at work, too.
        """
        with store_errors(f"cannot vacuum {self._url}"):
            unused = self._delta.vacuum(
                retention_hours=0,
                dry_run=True,
                enforce_retention_duration=False,
                full=untracked,
                keep_versions=list(keep_versions) or None,
            )
            old = old_files(self.storage, [str(path) for path in unused], grace) if unused else []
            folders = old_scratch_folders(self.storage, grace) if untracked else []
            if not dry_run:
                remove_files(self._url, self.storage, old, folders)
        return [*old, *folders]

    def _write(
        self,
        delta: Any,
        rows: pa.Table | pa.RecordBatchReader,
        mode: Literal["append", "overwrite"],
        properties: CommitProperties,
        schema_mode: Literal["overwrite"] | None = None,
        predicate: str | None = None,
    ) -> None:
        write_deltalake(
            delta,
            rows if schema_mode else self._in_its_format(rows),
            mode=mode,
            schema_mode=schema_mode,
            predicate=predicate,
            writer_properties=writer_properties(self.spec),
            commit_properties=properties,
            post_commithook_properties=PostCommitHookProperties(cleanup_expired_logs=False),
        )

    def _commit(
        self, what: str, operation: Callable[[Any], T], sight: Sight, *, rebase: bool = False
    ) -> tuple[int, T]:
        """Run what commits to a deltalake table; returns the new version and what it gave.

        Raises:
            StaleVersionError: others have committed; nothing of this can be seen.
            StoreError: the store failed.
        """
        try:
            if "://" not in self._url:
                done = commit_locally(Path(self._url), self._delta, operation, sight, rebase=rebase)
            else:  # what an object store has taken is durable, and it gets data files before the entry
                result = operation(self._delta)
                done = self.version, result
            acknowledge(self.storage, done[0])
            return done
        except CommitFailedError as error:
            raise StaleVersionError(f"{what} of {self._url}: {error}") from error
        except (DeltaError, OSError) as error:
            raise StoreError(f"cannot {what} {self._url}: {error}") from error

    def _has_taken(self, version: int, commit_id: str) -> bool:
        """Whether an entry is one's own, though an object store's answer to it was lost."""
        if "://" not in self._url:
            return False
        try:
            found = read_commit(self.storage, version)
        except (StoreError, OSError):
            return False
        if found.metadata.get(COMMIT_ID) != commit_id:
            return False
        acknowledge(self.storage, version)
        return True

    def _in_its_format(self, rows: pa.Table | pa.RecordBatchReader) -> pa.Table | pa.RecordBatchReader:
        """Rows without the columns that a table of an older format does not have."""
        if self.format == FORMAT_VERSION or isinstance(rows, pa.RecordBatchReader):
            return rows
        there = {field.name for field in self._delta.schema().fields}
        return rows.select([name for name in rows.column_names if name in there])

    def _maintain(self, operation: Callable[[Any], T]) -> T:
        """Run an operation that rewrites files, again if a concurrent writer got in between."""

        def attempt() -> T:
            self.refresh()
            return self._commit("maintain", operation, "rows", rebase=True)[1]

        return retry_stale(f"maintenance of {self.spec.name}", attempt)


def _is_in(column: str, values: Iterable[str]) -> str:
    """A predicate of SQL: that a column of ids in hexadecimal has one of these values."""
    wanted = sorted(values)
    if not all(_HEX.fullmatch(value) for value in wanted):
        raise StoreError(f"{column}: expected ids in hexadecimal, found {wanted[:3]}")
    return f"{column} IN ({', '.join(repr(value) for value in wanted)})"
