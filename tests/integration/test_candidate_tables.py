"""Contributed photos, known queries and promotion on a local disk, and what `verify` says of damage."""

import random
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from featuredb.errors import DatabaseNotFoundError, StoreError
from featuredb.store import Database, maintenance
from featuredb.store import verify as verify_module
from featuredb.store.canaries import add_canary, list_canaries, load_canary_image
from featuredb.store.candidates.photos import (
    append_events,
    contribute,
    list_candidates,
    note_events,
    withdraw,
)
from featuredb.store.commits import new_write_id
from featuredb.store.delta import Table
from featuredb.store.maintenance import VacuumOptions, vacuum
from featuredb.store.tables import CANARIES, CANDIDATE_IMAGES, OBSERVATIONS, SPECS
from featuredb.store.verify import verify
from tests.support.contributions import contribution, find_candidate, load_image
from tests.support.growth_suite import DecisionsSuite
from tests.support.store_suite import NOTHING_KEPT, Place


class TestLocalInbox(DecisionsSuite):
    @pytest.fixture
    def place(self, tmp_path: Path) -> Place:
        return Place(url=str(tmp_path / "maps.db"))


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database.create(tmp_path / "maps.db")


def spoil_only_file(folder: Path) -> None:
    """Turn the image bytes in the only Parquet file around, so that it still reads."""
    (path,) = folder.glob("*.parquet")
    table = pq.read_table(path)
    images = [image[::-1] for image in table["image"].to_pylist()]
    index = table.schema.get_field_index("image")
    pq.write_table(table.set_column(index, table.schema.field(index), pa.array(images, pa.binary())), path)


def test_a_photo_that_is_not_the_one_that_was_given(database: Database) -> None:
    (one,) = contribute(database, [contribution(1)])
    spoil_only_file(Path(database.url, CANDIDATE_IMAGES))
    with pytest.raises(StoreError, match="not the one that was contributed"):
        load_image(database, one)
    *_, problem = verify(database).problems
    assert problem.where == f"candidate {one}"
    assert "hashes differ" in problem.what


def test_nothing_is_given_to_a_database_that_is_gone(database: Database) -> None:
    """Nor is a part of one made where it was."""
    Path(database.url).rename(f"{database.url}.moved")
    with pytest.raises(DatabaseNotFoundError):
        contribute(database, [contribution(1)])
    with pytest.raises(DatabaseNotFoundError):
        add_canary(database, "gate", b"photo", None, origin="person")
    assert not Path(database.url).exists()


def test_a_known_query_that_is_not_the_one_that_was_added(database: Database) -> None:
    canary = add_canary(database, "gate", b"photo", None, origin="person")
    spoil_only_file(Path(database.url, "canaries"))
    with pytest.raises(StoreError, match="not the one that was added"):
        load_canary_image(database, canary)
    *_, problem = verify(database).problems
    assert problem.where == "canary gate"


def test_files_that_are_gone(database: Database) -> None:
    (one,) = contribute(database, [contribution(1)])
    add_canary(database, "gate", b"photo", None, origin="person")
    for name in (CANDIDATE_IMAGES, "canaries"):
        next(Path(database.url, name).glob("*.parquet")).unlink()
    with pytest.raises(StoreError, match="cannot read its image"):
        load_image(database, one)
    with pytest.raises(StoreError, match="featuredb verify"):
        list_canaries(database)
    problems = verify(database).problems
    assert {p.where.split("/")[0].split()[0] for p in problems} >= {"candidate_images", "canaries"}
    next(Path(database.url, "candidates").glob("*.parquet")).unlink()
    with pytest.raises(StoreError, match="cannot read the table candidates"):
        list_candidates(database)
    assert any(p.where == "candidates" for p in verify(database).problems)


def test_events_that_make_no_sense(database: Database) -> None:
    (one,) = contribute(database, [contribution(1)])
    now = datetime.now(UTC)
    stray = {"happened_at": now, "event": "used", "candidate_id": "f" * 32, "map_id": "m"}
    odd = {"happened_at": now, "event": "praised", "candidate_id": one}
    append_events(database, [stray, odd], new_write_id(now))
    assert {(p.where, p.what.split(" of ")[0].split(" that ")[0]) for p in verify(database).problems} == {
        ("candidate " + "f" * 32, "an event 'used'"),
        (f"candidate {one}", "an event 'praised'"),
    }
    assert [c.candidate_id for c in list_candidates(database)] == [one]
    assert find_candidate(database, one).state == "waiting"


def test_an_image_that_is_lost(database: Database) -> None:
    (one,) = contribute(database, [contribution(1)])
    database.table(CANDIDATE_IMAGES).delete_rows("candidate_id", [one])
    (problem,) = verify(database).problems
    assert problem.what == "it is waiting, but its image is not there"


def test_a_withdrawal_that_was_interrupted(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = contribute(database, [contribution(1), contribution(2)])

    def crash(table: Table, *args: object, **kwargs: object) -> int:
        raise StoreError("power cut")

    with monkeypatch.context() as broken:
        broken.setattr(Table, "delete_rows", crash)
        with pytest.raises(StoreError, match="power cut"):
            withdraw(database, [one, other], "asked")
    assert {c.state for c in list_candidates(database)} == {"withdrawn"}
    assert {p.what for p in verify(database).problems} == {
        "it is withdrawn, but its image is still there; withdraw it again"
    }
    withdraw(database, [one], "asked")
    assert [p.where for p in verify(database).problems] == [f"candidate {other}"]
    assert vacuum(database).candidate_images == (), "somebody may be giving it again"
    no_grace = VacuumOptions(orphan_grace_h=0)
    assert vacuum(database, no_grace).candidate_images == (other,)
    assert verify(database).ok


def test_a_photo_that_is_given_again_while_a_vacuum_runs(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    (one,) = contribute(database, [contribution(1)])
    note_events(database, {one: {"event": "withdrawn"}})
    real = maintenance._remove_orphans

    def meanwhile(table: Table, *args: Any) -> Any:
        if table.spec.name == OBSERVATIONS:
            contribute(database, [contribution(1)])
        return real(table, *args)

    monkeypatch.setattr(maintenance, "_remove_orphans", meanwhile)
    assert vacuum(database, VacuumOptions(orphan_grace_h=0)).candidate_images == ()
    assert load_image(database, one) == contribution(1).image


@pytest.mark.parametrize("between", ["events and images", "files and their footers"])
def test_a_withdrawal_while_it_is_verified(
    database: Database, monkeypatch: pytest.MonkeyPatch, between: str
) -> None:
    one, _ = contribute(database, [contribution(1), contribution(2)])
    name = "_stored_digests" if between == "events and images" else "file_digests"
    real, calls = getattr(verify_module, name), list[object]()

    def meanwhile(value: Any) -> Any:
        if not calls and (between == "events and images" or "candidate_images" in value.base_path):
            calls.append(withdraw(database, [one], "asked"))
        return real(value)

    monkeypatch.setattr(verify_module, name, meanwhile)
    assert verify(database).problems == ()
    assert calls


def test_an_image_that_is_lost_is_found_while_others_commit(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    (one,) = contribute(database, [contribution(1)])
    database.table(CANDIDATE_IMAGES).delete_rows("candidate_id", [one])
    real, seeds = verify_module._stored_digests, iter(range(2, 9))

    def meanwhile(database: Database) -> Any:
        contribute(database, [contribution(next(seeds))])
        return real(database)

    monkeypatch.setattr(verify_module, "_stored_digests", meanwhile)
    assert f"candidate {one}" in {problem.where for problem in verify(database).problems}


def test_removing_what_is_not_there_commits_nothing(database: Database) -> None:
    (one,) = contribute(database, [contribution(1)])
    images = database.table(CANDIDATE_IMAGES)
    for values in (["f" * 32], [one], [one]):
        images.delete_rows("candidate_id", values)
    assert database.table(CANDIDATE_IMAGES).version == images.version == 2


def test_images_without_an_event_are_orphans(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    (one,) = contribute(database, [contribution(1)])

    def crash(*args: object) -> None:
        raise StoreError("power cut")

    with monkeypatch.context() as broken:
        broken.setattr("featuredb.store.candidates.photos.append_events", crash)
        with pytest.raises(StoreError, match="power cut"):
            contribute(database, [contribution(2)])
    assert [c.candidate_id for c in list_candidates(database)] == [one]
    report = verify(database)
    assert report.ok
    assert len(report.orphans) == 1
    assert vacuum(database).write_ids == (), "a writer may be about to name them"
    assert vacuum(database, NOTHING_KEPT).write_ids == report.orphans
    assert verify(database).orphans == ()
    assert load_image(database, one) == contribution(1).image


def test_a_clock_that_was_set_back(database: Database) -> None:
    """Events follow each other as they were noted, whatever the clocks of their writers say."""
    tomorrow = (datetime.now(UTC) - contribution().received_at) + timedelta(days=1)
    (one,) = contribute(database, [contribution(1, minute=int(tomorrow.total_seconds() // 60))])
    withdraw(database, [one], "asked")
    assert find_candidate(database, one).state == "withdrawn"


def test_one_photo_is_read_without_the_others(database: Database) -> None:
    """Each photo has its own row group, so that reading one of many does not take them all into memory."""
    contribute(database, [contribution(i) for i in range(20)])
    (path,) = Path(database.url, CANDIDATE_IMAGES).glob("*.parquet")
    metadata = pq.ParquetFile(path).metadata
    assert (metadata.num_rows, metadata.num_row_groups) == (20, 20)
    assert SPECS[CANDIDATE_IMAGES].row_group_rows == 1


def test_a_photo_is_stored_once(database: Database) -> None:
    """Its column has no statistics: the minimum and the maximum would be two more copies."""
    photo = random.Random(7).randbytes(1_000_000)
    given = replace(contribution(1), image=photo)
    contribute(database, [given])
    add_canary(database, "gate", photo, None, origin="person")
    contribute(database, [contribution(2)])
    database.table(CANDIDATE_IMAGES).compact()
    vacuum(database, NOTHING_KEPT)
    for name in (CANDIDATE_IMAGES, CANARIES):
        (path,) = Path(database.url, name).glob("*.parquet")
        assert 1.0 < path.stat().st_size / len(photo) < 1.01
