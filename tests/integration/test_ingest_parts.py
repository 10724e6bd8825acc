"""Work folder: what is written is complete."""

import os
from pathlib import Path

import numpy as np
import pytest

from featuredb.atomic import atomic_file, atomic_folder
from featuredb.errors import IngestError
from ingest.workspace import default_root, read_arrays, read_json, remove_leftovers, write_arrays, write_json


def test_an_interrupted_write_leaves_nothing(tmp_path: Path) -> None:
    def write_half(temporary: Path) -> None:
        if temporary.is_dir():
            temporary = temporary / "0"
        temporary.write_bytes(b"half")
        raise RuntimeError("interrupted")

    for writer in (atomic_file, atomic_folder):
        with pytest.raises(RuntimeError, match="interrupted"), writer(tmp_path / "result") as temporary:
            write_half(temporary)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_there_already_stays(tmp_path: Path) -> None:
    for text in ("first", "second"):
        with atomic_folder(tmp_path / "models") as folder:
            (folder / "points").write_text(text)
    assert (tmp_path / "models" / "points").read_text() == "first"
    assert [p.name for p in tmp_path.iterdir()] == ["models"]


def test_arrays_and_json_come_back(tmp_path: Path) -> None:
    arrays = {"xy": np.arange(6.0).reshape(3, 2), "name": np.array("sift")}
    write_arrays(tmp_path / "deep" / "a.npz", arrays)
    found = read_arrays(tmp_path / "deep" / "a.npz")
    np.testing.assert_array_equal(found["xy"], arrays["xy"])
    assert str(found["name"]) == "sift"
    write_json(tmp_path / "a.json", {"one": [1, 2]})
    assert read_json(tmp_path / "a.json") == {"one": [1, 2]}


def test_damaged_files_are_named(tmp_path: Path) -> None:
    for name, read in (("a.npz", read_arrays), ("a.json", read_json)):
        (tmp_path / name).write_bytes(b"PK\x03\x04 not what it seems")
        with pytest.raises(IngestError, match=name):
            read(tmp_path / name)


def test_old_leftovers_go_and_fresh_ones_stay(tmp_path: Path) -> None:
    old, fresh, done = tmp_path / ".tmp-1-a.npz", tmp_path / ".tmp-2-b.npz", tmp_path / "c.npz"
    for path in (old, fresh, done):
        path.write_bytes(b"x")
    os.utime(old, (0, 0))
    os.utime(done, (0, 0))
    remove_leftovers(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".tmp-2-b.npz", "c.npz"]


def test_work_lies_in_a_local_database_and_in_the_cache_for_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert default_root("/data/maps.db") == Path("/data/maps.db/_work")
    assert default_root("file:///data/maps.db") == Path("/data/maps.db/_work")
    remote = default_root("s3://bucket/maps")
    assert remote.is_relative_to(tmp_path / "cache")
    assert remote != default_root("s3://bucket/others")
