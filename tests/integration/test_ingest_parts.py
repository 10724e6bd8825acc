"""Work folder and executor: what is written is complete, and what dies is told."""

import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import IngestError
from ingest.executor import InProcessExecutor, PoolExecutor
from ingest.workspace import (
    atomic_file,
    atomic_folder,
    default_root,
    read_arrays,
    read_json,
    remove_leftovers,
    write_arrays,
    write_json,
)


def square(value: int) -> int:
    return value * value


def fail_at_three(value: int) -> int:
    if value == 3:
        raise ValueError("three is not wanted")
    return value


def die_at_five(value: int) -> int:
    if value == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def thread_caps(_: int) -> tuple[str | None, int]:
    import cv2

    return os.environ.get("OMP_NUM_THREADS"), cv2.getNumThreads()


def test_pool_and_in_process_agree_and_report_progress() -> None:
    items = list(range(40))
    told: list[tuple[str, int, int]] = []
    with PoolExecutor(2) as pool:
        found = pool.map("squares", square, items, lambda *step: told.append(step))
        assert pool.map("again", square, [7]) == [49]
    assert found == InProcessExecutor().map("squares", square, items) == [i * i for i in items]
    assert told[-1] == ("squares", 40, 40)
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)


def test_a_task_that_raises_is_raised_here() -> None:
    with PoolExecutor(2) as pool, pytest.raises(ValueError, match="three is not wanted"):
        pool.map("numbers", fail_at_three, list(range(10)))


def test_a_worker_that_dies_is_an_error_and_no_hang() -> None:
    failed: list[BaseException] = []

    def run() -> None:
        with PoolExecutor(2) as pool:
            try:
                pool.map("numbers", die_at_five, list(range(50)))
            except IngestError as error:
                failed.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(60.0)
    assert not thread.is_alive()
    assert len(failed) == 1
    assert "worker process died" in str(failed[0])
    assert "run the same command again" in str(failed[0])


def test_workers_have_their_threads_capped_and_the_parent_keeps_its_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with PoolExecutor(1) as pool:
        (caps,) = pool.map("caps", thread_caps, [0])
    assert caps == ("1", 1)
    assert os.environ["OMP_NUM_THREADS"] == "7"


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
    assert remove_leftovers(tmp_path) == 1
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
