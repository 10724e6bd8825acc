"""SQL over one snapshot: the documented queries, against numpy, and all that is refused."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from featuredb.errors import StoreError
from featuredb.geo.tiles import tile_of
from featuredb.store import Database
from featuredb.store.sql import SqlSession
from tests.support.maps import random_map

MAPS = [random_map(seed, points=80 + seed, images=3 + seed) for seed in range(3)]
DOCUMENT = Path(__file__).parents[2] / "docs" / "sql.md"


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    database = Database.create(tmp_path_factory.mktemp("sql") / "maps.db")
    database.commit_maps(MAPS)
    return database


def documented_query(title: str) -> str:
    """The statement below a heading of docs/sql.md."""
    match = re.search(rf"^### {title}\n.*?```sql\n(.*?)```", DOCUMENT.read_text(), re.DOTALL | re.MULTILINE)
    assert match, f"docs/sql.md has no example {title!r}"
    return match[1]


def rows(database: Database, query: str) -> list[tuple[object, ...]]:
    with SqlSession(database.snapshot()) as session:
        return list(session.query(query).rows)


def test_points_per_tile(database: Database) -> None:
    tiles, counts = np.unique(np.concatenate([tile_of(m.points.utm) for m in MAPS]), return_counts=True)
    expected = sorted(zip([32632] * len(tiles), tiles.tolist(), counts.tolist(), strict=True))
    assert sorted(rows(database, documented_query("Points per tile"))) == expected


def test_images_per_map(database: Database) -> None:
    found = rows(database, documented_query("Images per map"))
    assert sorted(found) == [(m.map_id, m.name, len(m.images)) for m in MAPS]


def test_ten_worst_reprojection_errors(database: Database) -> None:
    found = rows(database, documented_query("The ten worst reprojection errors"))
    errors = np.sort(np.concatenate([m.points.error_px for m in MAPS]))[::-1][:10]
    assert [row[2] for row in found] == errors.tolist()
    for map_id, point, error, track, easting, northing, height in found:
        points = next(m for m in MAPS if m.map_id == map_id).points
        assert points.error_px[point] == error
        assert points.track_length[point] == track
        assert points.utm[point].tolist() == [easting, northing, height]


def test_every_documented_query_runs(database: Database) -> None:
    queries = re.findall(r"```sql\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert len(queries) >= 5
    for query in queries:
        assert rows(database, query), query


def test_cameras_and_descriptors(database: Database) -> None:
    found = rows(database, "select camera_id, model, params, camera_key from cameras where map_id = 'map-1'")
    assert sorted(found) == [
        (i, c.model, list(c.params), key)
        for i, (c, key) in enumerate(zip(MAPS[1].cameras, MAPS[1].camera_keys, strict=True))
    ]
    first = rows(
        database,
        "select descriptor from observations where map_id = 'map-1' and descriptor is not null "
        "order by observation_index limit 1",
    )
    seen = MAPS[1].observations
    assert first[0][0] == seen.descriptors[np.flatnonzero(seen.has_descriptor)[0]].tobytes()


def test_retired_maps_show_in_maps_alone(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "maps.db")
    database.commit_maps(MAPS)
    database.retire("map-1", "test")
    assert sorted(rows(database, "select map_id, status from maps")) == [
        ("map-0", "active"),
        ("map-1", "retired"),
        ("map-2", "active"),
    ]
    for view in ("images", "points", "observations", "cameras"):
        assert sorted(rows(database, f"select distinct map_id from {view}")) == [("map-0",), ("map-2",)]


@pytest.mark.parametrize(
    "query",
    [
        "create table t as select 1",
        "drop view points",
        "insert into points values (1)",
        "delete from maps",
        "update maps set status = 'active'",
        "copy maps to '{out}'",
        "copy (select 1) to '{out}'",
        "attach '{out}' as other",
        "export database '{out}'",
        "install httpfs",
        "load httpfs",
        "set enable_external_access = true",
        "pragma enable_profiling",
        "select * from read_csv('{secret}')",
        "select * from read_parquet('{secret}')",
        "select * from read_text('{secret}')",
        "select * from '{secret}'",
        "select * from glob('{secret}')",
        "select * from MAPS_OF_PYTHON",
        "explain analyze copy maps to '{out}'",
        "select 1; select 2",
        "",
        "selec 1",
    ],
)
def test_what_does_not_read_the_snapshot_is_refused(database: Database, tmp_path: Path, query: str) -> None:
    MAPS_OF_PYTHON = pa.table({"a": [1]})  # noqa: F841 - DuckDB could find it by its name
    secret, out = tmp_path / "secret.csv", tmp_path / "out"
    secret.write_text("password\nhunter2\n")
    with pytest.raises(StoreError, match=r"^SQL: "):
        rows(database, query.format(secret=secret, out=out))
    assert not out.exists()
    assert len(database.snapshot().maps()) == 3


def test_only_the_columns_and_files_asked_for_are_read(tmp_path: Path) -> None:
    """A query on points still answers when every descriptor is unreadable, so it did not read them."""
    database = Database.create(tmp_path / "maps.db")
    database.commit_maps(MAPS)
    for path in Path(database.url, "observations").rglob("*.parquet"):
        path.write_bytes(b"")
    assert rows(database, "select count(*) from points") == [(sum(len(m.points) for m in MAPS),)]
    with pytest.raises(StoreError):
        rows(database, "select sum(x) from observations")


def test_rows_come_as_they_are_fetched(database: Database) -> None:
    with SqlSession(database.snapshot()) as session:
        result = session.query("select i from range(1000000000) t(i)")
        assert [next(result.rows)[0] for _ in range(3)] == [0, 1, 2]
