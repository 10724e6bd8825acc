"""A single bit turned over, a log cut off anywhere: found by `verify` or harmless, never an exception."""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from featuredb.errors import StoreError
from featuredb.store import Database
from featuredb.store.canaries import list_canaries
from featuredb.store.durable import publish
from tests.support.bit_flips import flip_bits, outcome, rich_database, seen
from tests.support.maps import random_map

FLIPS = 15  # `python -m tests.support.bit_flips` makes as many as wanted


@pytest.fixture(scope="module", autouse=True)
def _checkpoints_soon() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(publish, "CHECKPOINT_INTERVAL", 2)
        yield


@pytest.fixture(scope="module")
def rich(_checkpoints_soon: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database to be copied."""
    return Path(rich_database(tmp_path_factory.mktemp("rich") / "maps.db").url)


@pytest.fixture
def database(rich: Path, tmp_path: Path) -> Database:
    return Database(str(shutil.copytree(rich, tmp_path / "maps.db")))


@pytest.mark.slow
def test_single_bits(database: Database, tmp_path: Path) -> None:
    found = flip_bits(database, tmp_path / "copy.db", FLIPS, seed=1)
    assert {kind for kind, what in found if what == "missed"} == set()
    assert sum(count for (_, what), count in found.items() if what == "found") > FLIPS / 2


@pytest.mark.parametrize(
    ("table", "version", "word", "other"),
    [
        pytest.param("maps", 3, b'"remove":{"path":"p', b'"remove":{"path":"q', id="what is removed"),
        pytest.param("maps", 1, b'"add":{"path":', b'"add":{"qath":', id="what is added"),
        pytest.param(
            "candidate_images", 1, b'minValues\\":{\\"candidate_id\\":\\"', b"", id="where a photo may be"
        ),
    ],
)
def test_bits_by_which_readers_go(
    database: Database, tmp_path: Path, table: str, version: int, word: bytes, other: bytes
) -> None:
    """Entries that still read, but name another file, or files that readers skip."""
    truth = seen(database)
    path = Path(database.url, table, "_delta_log", f"{version:020d}.json")
    content = path.read_bytes()
    assert word.split(b":")[0] in content
    if not other:  # readers look for a photo where its id is between minimum and maximum
        word = re.search(rb'minValues[^}]*candidate_id\\":\\"\w', content)[0]  # type: ignore[index]
        other = word[:-1] + b"z"
    path.write_bytes(content.replace(word, other))
    assert outcome(database, truth) == "found"


def test_a_checkpoint_that_says_less_than_the_entries(database: Database) -> None:
    database.commit_map(random_map(4, extent_m=10.0))
    truth = seen(database)
    path = Path(database.url, "maps", "_delta_log", f"{4:020d}.checkpoint.parquet")
    rows = pq.read_table(path)
    first = next(i for i, add in enumerate(rows["add"].to_pylist()) if add)
    pq.write_table(pa.concat_tables([rows.slice(0, first), rows.slice(first + 1)]), path)
    assert outcome(database, truth) == "found"


@pytest.mark.parametrize(("column", "value"), [("request", None), ("request", "{"), ("created_at", None)])
def test_rows_of_known_queries_without_sense(database: Database, column: str, value: str | None) -> None:
    truth = seen(database)
    (path,) = Path(database.url, "canaries").glob("*.parquet")
    rows = pq.read_table(path)
    at = rows.column_names.index(column)
    pq.write_table(rows.set_column(at, column, pa.array([value], rows[column].type)), path)
    assert outcome(database, truth) == "found"
    with pytest.raises(StoreError, match=r"damaged.*featuredb verify"):
        list_canaries(database)


@pytest.mark.parametrize(
    "damage",
    ["cut off", *(pytest.param(name, marks=pytest.mark.evaluation) for name in ("missing", "empty"))],
)
def test_every_log_entry(database: Database, damage: str, tmp_path: Path) -> None:
    truth = seen(database)
    entries = sorted(Path(database.url).glob("*/_delta_log/*.json"))
    assert len(entries) > 12
    copy = tmp_path / "copy.db"
    for entry in entries:
        shutil.copytree(database.url, copy)
        for path in sorted((copy / entry.relative_to(database.url)).parent.glob("*.json")):
            if path.name == entry.name or (damage == "cut off" and path.name > entry.name):
                path.unlink()
        if damage == "empty":
            (copy / entry.relative_to(database.url)).touch()
        assert outcome(Database(str(copy)), truth) == "found", entry
        shutil.rmtree(copy)
