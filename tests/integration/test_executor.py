"""Executors: the same results from each, and a worker that dies costs its own tasks only."""

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from featuredb.errors import IngestError
from ingest.executor import InProcessExecutor, Lost, PoolExecutor

_MINUTE_S = 60.0
_OPENCV_THREADS = "OPENCV_FOR_THREADS_NUM"  # set while all tests run; caps must hold without it


def square(value: int) -> int:
    return value * value


def fail_at_three(value: int) -> int:
    if value == 3:
        raise ValueError("three is not wanted")
    return value


class UnpicklableError(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__("a text that is not how it was made")
        self.both = one + two


def fail_strangely(value: int) -> int:
    raise UnpicklableError(value, value)


def die_at_five(value: int) -> int:
    if value == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


class Marked:
    """Dies on the first run, and leaves a mark so that it lives on the second."""

    def __init__(self, folder: Path, number: int) -> None:
        self.folder, self.number = folder, number

    def __str__(self) -> str:
        return f"task {self.number}"


def die_once(task: Marked) -> int:
    runs = task.folder / str(task.number)
    with runs.open("a") as file:
        file.write("x")
    if task.number % 4 == 1 and len(runs.read_text()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.01)
    return task.number * task.number


def thread_caps(_: int) -> tuple[str | None, int]:
    import cv2

    return os.environ.get("OMP_NUM_THREADS"), cv2.getNumThreads()


def test_pool_and_in_process_agree_and_report_progress() -> None:
    items = list(range(40))
    told: list[tuple[str, int, int]] = []
    with PoolExecutor(2) as pool:
        found = pool.map("squares", square, items, lambda *step: told.append(step))
        assert pool.map("again", square, [7]) == [49]
        assert pool.map("nothing", square, []) == []
    assert found == InProcessExecutor().map("squares", square, items) == [i * i for i in items]
    assert told[-1] == ("squares", 40, 40)
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)


def test_a_task_that_raises_is_raised_here_and_the_pool_goes_on() -> None:
    with PoolExecutor(2) as pool:
        with pytest.raises(ValueError, match="three is not wanted") as caught:
            pool.map("numbers", fail_at_three, list(range(10)))
        assert "In a worker process" in "".join(caught.value.__notes__)
        with pytest.raises(RuntimeError, match="UnpicklableError: a text"):
            pool.map("strange", fail_strangely, [1])
        assert pool.map("squares", square, [3, 4]) == [9, 16]


def test_a_task_that_kills_its_workers_is_lost_and_the_rest_goes_on() -> None:
    found: list[Any] = []

    def run() -> None:
        with PoolExecutor(2) as pool:
            found.extend(pool.map("numbers", die_at_five, list(range(50))))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(_MINUTE_S)
    assert not thread.is_alive()
    (lost,) = [f for f in found if isinstance(f, Lost)]
    assert found.index(lost) == 5
    assert lost.task == "5"
    assert "out of memory" in lost.reason
    assert [f for f in found if f is not lost] == [i for i in range(50) if i != 5]


def test_tasks_that_a_dead_worker_had_run_again_and_no_others(tmp_path: Path) -> None:
    tasks = [Marked(tmp_path, k) for k in range(20)]
    with PoolExecutor(2) as pool:
        assert pool.map("marked", die_once, tasks) == [k * k for k in range(20)]
    runs = {k: len((tmp_path / str(k)).read_text()) for k in range(20)}
    assert runs == {k: 2 if k % 4 == 1 else 1 for k in range(20)}


def test_a_worker_killed_from_outside_costs_nothing_but_time() -> None:
    def kill_one(_: str, done: int, __: int) -> None:
        if done == 10:
            pool._workers[0]._process.kill()

    with PoolExecutor(2) as pool:
        assert pool.map("squares", square, list(range(40)), kill_one) == [i * i for i in range(40)]
        assert pool.map("squares", square, [6]) == [36]


def test_workers_have_their_threads_capped_and_the_parent_keeps_its_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv(_OPENCV_THREADS, raising=False)
    with PoolExecutor(1) as pool:
        (caps,) = pool.map("caps", thread_caps, [0])
    assert caps == ("1", 1)
    assert os.environ["OMP_NUM_THREADS"] == "7"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs the extra `dask`")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(_OPENCV_THREADS, raising=False)
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as cluster:
            yield cluster


@pytest.mark.slow
def test_dask_gives_the_same_and_survives_its_workers(cluster: Any, tmp_path: Path) -> None:
    from ingest.executor.dask_cluster import DaskExecutor

    told: list[int] = []
    (tmp_path / "marks").mkdir()
    with DaskExecutor(cluster.scheduler_address, shared=[tmp_path]) as dask:
        items = list(range(40))
        found = dask.map("squares", square, items, lambda _, done, __: told.append(done))
        assert found == InProcessExecutor().map("squares", square, items)
        assert told == list(range(1, 41))
        (caps,) = dask.map("caps", thread_caps, [0])
        assert caps[1] == 1
        with pytest.raises(ValueError, match="three is not wanted"):
            dask.map("numbers", fail_at_three, list(range(10)))
        tasks = [Marked(tmp_path / "marks", k) for k in range(4)]
        assert dask.map("marked", die_once, tasks) == [0, 1, 4, 9]
        numbers = dask.map("numbers", die_at_five, list(range(8)))
        assert isinstance(numbers[5], Lost)
        assert [n for n in numbers if not isinstance(n, Lost)] == [0, 1, 2, 3, 4, 6, 7]
    assert [p.name for p in tmp_path.iterdir()] == ["marks"]  # what the check wrote is gone


@pytest.mark.slow
def test_dask_workers_that_cannot_take_part_are_named(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ingest.executor import dask_cluster
    from ingest.executor.dask_cluster import DaskExecutor

    address = cluster.scheduler_address
    with pytest.raises(IngestError, match=r"workers cannot.*does not see .*photos"):
        DaskExecutor(address, shared=[tmp_path / "work", tmp_path / "photos"])
    monkeypatch.setattr(dask_cluster, "version", lambda _: "0.0")
    with pytest.raises(IngestError, match=r"featuredb .* there, 0\.0 here"):
        DaskExecutor(address, shared=[tmp_path])
    monkeypatch.setattr(dask_cluster, "_CONNECT_S", 0.5)
    with pytest.raises(IngestError, match="cannot be reached"):
        DaskExecutor("tcp://127.0.0.1:1", shared=[tmp_path])


@pytest.mark.slow
def test_dask_workers_on_their_way_are_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ingest.executor import dask_cluster
    from ingest.executor.dask_cluster import DaskExecutor

    distributed = pytest.importorskip("distributed", reason="needs the extra `dask`")
    with distributed.LocalCluster(n_workers=0, threads_per_worker=1, dashboard_address=":0") as empty:
        empty.scale(1)
        with DaskExecutor(empty.scheduler_address, shared=[tmp_path]) as dask:
            assert dask.map("squares", square, [3]) == [9]
    monkeypatch.setattr(dask_cluster, "_CONNECT_S", 2.0)  # the scheduler itself is reached
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=":0") as empty,
        pytest.raises(IngestError, match="found none within 2 s"),
    ):
        DaskExecutor(empty.scheduler_address, shared=[tmp_path])


def test_without_dask_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ingest.executor.dask_cluster import DaskExecutor

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(IngestError, match=r"pip install 'featuredb\[dask\]'"):
        DaskExecutor("tcp://127.0.0.1:8786", shared=[tmp_path])
