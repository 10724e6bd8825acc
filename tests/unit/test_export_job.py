"""An export is there whole or not at all."""

from pathlib import Path

import pytest

from featuredb.errors import ExportError
from featuredb.export.job import ExportJob, folder_name, size_of, whole_or_nothing
from featuredb.export.selection import Selection
from featuredb.store import Database
from tests.support.maps import random_map


def test_what_is_written_appears_at_the_end(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()  # an empty folder gives way
    with whole_or_nothing(tmp_path / "out") as part:
        part.mkdir()
        (part / "a").write_bytes(b"123")
        assert not any((tmp_path / "out").iterdir())
    assert size_of(tmp_path / "out") == 3
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_names_that_are_too_long_for_file_systems_are_cut(tmp_path: Path) -> None:
    names = [folder_name("ド" * 80 + end) for end in (".jpg", "a.jpg")]
    assert len(set(names)) == 2
    for name in names:
        assert name.endswith(".jpg")
        (tmp_path / f"{name}.json").touch()
    assert folder_name("é.jpg") == "%C3%A9.jpg"


@pytest.mark.parametrize("folder", [True, False])
def test_an_error_leaves_nothing(tmp_path: Path, folder: bool) -> None:
    def fail() -> None:
        with whole_or_nothing(tmp_path / "out") as part:
            if folder:
                part.mkdir()
                (part / "a").write_bytes(b"123")
            else:
                part.write_bytes(b"123")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(ExportError, match="nothing is overwritten"), whole_or_nothing(tmp_path / "out"):
        pass
    assert (tmp_path / "out").read_text() == "mine"
    with pytest.raises(ExportError, match="make it first"), whole_or_nothing(tmp_path / "no" / "out"):
        pass


def test_a_job_gives_its_maps_and_tells_how_far_it_is(tmp_path: Path) -> None:
    database = Database.create(tmp_path / "db")
    for k in range(3):
        database.commit_map(random_map(k))
    told: list[tuple[int, int]] = []
    job = ExportJob(
        database=database,
        snapshot=database.snapshot(),
        selection=Selection(),
        out=tmp_path / "out",
        told=lambda done, total: told.append((done, total)),
    )
    assert [m.map_id for m in job.maps()] == ["map-0", "map-1", "map-2"]
    assert told == [(1, 3), (2, 3), (3, 3)]
