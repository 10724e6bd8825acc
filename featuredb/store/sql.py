"""Read-only SQL over one snapshot, by DuckDB. The home of duckdb.

DuckDB sees Arrow datasets that show only rows of that snapshot, pulls the columns and row groups that a query
needs, and has no way to files, network, extensions or settings.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from html import escape
from typing import Any

import duckdb
import pyarrow as pa

from featuredb.errors import StoreError
from featuredb.extras import require
from featuredb.store import tables
from featuredb.store.database import Database
from featuredb.store.decode import plain_times
from featuredb.store.durable.filesystem import read_errors
from featuredb.store.encode import rows_table
from featuredb.store.scans import list_scans, scan_rows
from featuredb.store.snapshot import Snapshot

_BATCH_ROWS = 1024  # rows that are fetched at a time; bounds memory, not the result
_SHOWN_ROWS = 20  # in a notebook
_ALLOWED = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)

_CAMERAS_VIEW = """
    CREATE VIEW cameras AS
    SELECT map_id, camera_id, c.model, c.width, c.height, c.params, camera_keys[camera_id + 1] AS camera_key
    FROM (SELECT map_id, camera_keys, unnest(cameras) AS c, generate_subscripts(cameras, 1) - 1 AS camera_id
          FROM stored_maps WHERE status <> 'retired')
"""
# Rows of maps without a place have no UTM coordinates, zone and tile.
_CHILD_VIEW = """
    CREATE VIEW {name} AS
    SELECT * EXCLUDE (write_id) REPLACE ({places} nullif(zone, 0) AS zone,
        CASE WHEN zone <> 0 THEN tile END AS tile)
    FROM stored_{name}
"""
_UTM_OR_NULL = "".join(
    f"CASE WHEN zone <> 0 THEN {name} END AS {name}, " for name in ("easting", "northing", "height")
)
_LIDAR_VIEW = (
    f"CREATE VIEW {tables.LIDAR} AS SELECT * EXCLUDE (write_id, points_checksum) FROM stored_{tables.LIDAR}"
)
_LIDAR_POINTS_VIEW = f"""
    CREATE VIEW {tables.LIDAR_POINTS} AS
    SELECT s.scan_id, p.* EXCLUDE (write_id)
    FROM stored_{tables.LIDAR_POINTS} p JOIN stored_{tables.LIDAR} s ON p.write_id = s.write_id
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class SqlResult:
    """Column names and the rows, which are computed while one iterates; once only."""

    columns: tuple[str, ...]
    rows: Iterator[tuple[Any, ...]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SqlTable:
    """All rows of a query, as an Arrow table."""

    table: Any

    def arrow(self) -> Any:
        """A `pyarrow.Table`."""
        return self.table

    def df(self) -> Any:
        """A `pandas.DataFrame`.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        require("notebook", "df()", "pandas")
        return self.table.to_pandas()

    def __len__(self) -> int:
        return int(self.table.num_rows)

    def __repr__(self) -> str:
        columns = ", ".join(f"{field.name} {field.type}" for field in self.table.schema)
        return f"{len(self)} rows of {columns}"

    def _repr_html_(self) -> str:
        """The first rows, for a notebook."""
        shown = self.table.slice(0, _SHOWN_ROWS).to_pylist()
        head = "".join(f"<th>{escape(name)}</th>" for name in self.table.column_names)
        rows = ("".join(f"<td>{escape(str(v))}</td>" for v in row.values()) for row in shown)
        body = "".join(f"<tr>{cells}</tr>" for cells in rows)
        return f"<table><tr>{head}</tr>{body}</table><p>{len(self)} rows</p>"


class SqlSession(AbstractContextManager["SqlSession"]):
    """DuckDB over one snapshot; a context manager.

    Views: `maps` (retired ones included, see its column `status`); `images`, `points`, `observations` and
    `cameras` of the maps that are not retired. With the database also its scans as they are now: `lidar`
    (retired ones included) and `lidar_points` of those that are not retired; `candidates` (events of
    contributed photos) and `canaries`, both without images.
    """

    def __init__(self, snapshot: Snapshot, database: Database | None = None) -> None:
        self.snapshot = snapshot
        self._connection = duckdb.connect(":memory:", config={"python_enable_replacements": "false"})
        self._register()
        if database is not None:
            self._register_scans(database)
            self._register_growth(database)
        self._connection.execute("SET enable_external_access = false")
        self._connection.execute("SET lock_configuration = true")

    def __exit__(self, *failed: object) -> None:
        self._connection.close()

    def query(self, text: str) -> SqlResult:
        """Run one SELECT (or WITH, FROM, VALUES, DESCRIBE, SHOW, SUMMARIZE, EXPLAIN).

        Raises:
            StoreError: not one reading statement, or DuckDB refuses it; the message is DuckDB's.
        """
        with _sql_errors():
            self._connection.execute(self._statement(text))
        columns = tuple(column[0] for column in self._connection.description or [])
        return SqlResult(columns=columns, rows=self._fetch())

    def table(self, text: str) -> SqlTable:
        """The same, with all rows at once.

        Raises:
            StoreError: as `query`.
        """
        with _sql_errors():
            return SqlTable(table=self._connection.sql(self._statement(text)).to_arrow_table())

    def _statement(self, text: str) -> Any:
        if not isinstance(text, str):
            raise StoreError(f"SQL: expected the text of a SELECT, found {text!r}")
        statements = self._connection.extract_statements(text)
        if len(statements) != 1 or statements[0].type not in _ALLOWED:
            found = ", ".join(s.type.name for s in statements) or "nothing"
            raise StoreError(f"SQL: expected one SELECT, found {found}; this is read-only")
        return statements[0]

    def _register(self) -> None:
        self._connection.register("stored_maps", plain_times(rows_table(tables.MAPS, self.snapshot.rows())))
        self._connection.execute("CREATE VIEW maps AS SELECT * EXCLUDE (write_id) FROM stored_maps")
        self._connection.execute(_CAMERAS_VIEW)
        for name in tables.CHILD_TABLES:
            self._connection.register(f"stored_{name}", self.snapshot.dataset(name, include_retired=False))
            places = "" if name == tables.OBSERVATIONS else _UTM_OR_NULL
            self._connection.execute(_CHILD_VIEW.format(name=name, places=places))

    def _register_scans(self, database: Database) -> None:
        rows = plain_times(rows_table(tables.LIDAR, scan_rows(database)))
        self._connection.register(f"stored_{tables.LIDAR}", rows)
        points = tables.SPECS[tables.LIDAR_POINTS].schema.empty_table()
        if database.has(tables.LIDAR):
            named = [scan.write_id for scan in list_scans(database)]
            points = database.table(tables.LIDAR_POINTS).dataset([("write_id", "in", named)])
        self._connection.register(f"stored_{tables.LIDAR_POINTS}", points)
        self._connection.execute(_LIDAR_VIEW)
        self._connection.execute(_LIDAR_POINTS_VIEW)

    def _register_growth(self, database: Database) -> None:
        for name, hidden in ((tables.CANDIDATES, "event_index"), (tables.CANARIES, "image")):
            columns = [n for n in tables.SPECS[name].schema.names if n not in (hidden, "write_id")]
            rows = tables.SPECS[name].schema.empty_table().select(columns)
            if database.has(name):
                with read_errors(f"cannot read the table {name}"):
                    rows = database.table(name).dataset().to_table(columns)
            self._connection.register(name, plain_times(rows))

    def _fetch(self) -> Iterator[tuple[Any, ...]]:
        with _sql_errors():
            while rows := self._connection.fetchmany(_BATCH_ROWS):
                yield from rows


@contextmanager
def _sql_errors() -> Iterator[None]:
    try:
        yield
    except (duckdb.Error, OSError, pa.ArrowException) as error:
        raise StoreError(f"SQL: {error}") from error
