"""What a table says of its log, while others commit."""

from pathlib import Path

from featuredb.store import Database
from featuredb.store.tables import MAPS
from tests.support.maps import random_map


def test_commits_of_a_table_end_with_its_version(tmp_path: Path) -> None:
    database = Database.create(str(tmp_path / "town.db"))
    database.commit_map(random_map(1, extent_m=10.0))
    before = database.table(MAPS)
    told = before.commits()
    for seed in (2, 3):
        database.commit_map(random_map(seed, extent_m=10.0))
    assert before.commits() == told
    assert before.commits(limit=1) == told[:1]
    assert [commit.version for commit in told] == list(range(before.version, -1, -1))
