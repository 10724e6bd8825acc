"""Tasks on the workers of a Dask cluster; the only module that knows Dask (extra `dask`).

Tasks and workers exchange results as files of the work folder, so every worker must see it, and the photos,
under the same paths: a shared file system. That is checked before the first task.
"""

import os
import queue
import uuid
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self, TypeVar

from featuredb.errors import IngestError
from ingest.executor.interface import Lost, Progress, given_up, no_progress
from ingest.executor.worker import cap_threads

_QUEUED_PER_THREAD = 4  # keeps workers busy without a scheduler full of pending tasks
_CONNECT_S = 30.0
# A cluster whose last worker went may get others from its batch system; so long is waited for them.
_NO_WORKERS_S = 300.0
_POLL_S = 2.0

Item = TypeVar("Item")
Result = TypeVar("Result")


class DaskExecutor:
    """Runs tasks on the cluster whose scheduler listens at `address`, e.g. "tcp://10.0.0.1:8786".

    Dask runs the tasks of a worker that died again on the others; a task that it gives up (by default after
    the fourth worker) is `Lost`.

    Args:
        shared: folders that every worker must see: the work folder (written to) first, then the photos'.

    Raises:
        IngestError: `distributed` is not installed, nobody answers at the address, there are no workers, or
            one of them does not see the folders or has another version of featuredb.
    """

    def __init__(self, address: str, *, shared: Sequence[Path] = ()) -> None:
        self._address = address
        self._client = _connected(address)
        try:
            self._client.register_plugin(_thread_caps())
            _require_shared(self._client, address, [p.absolute() for p in shared])
        except BaseException:
            self._client.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        self._client.close()

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result | Lost]:
        """See `Executor.map`."""
        results: dict[int, Any] = {}
        todo = iter(range(len(items)))
        waiting: dict[str, tuple[int, Any]] = {}
        finished: queue.Queue[Any] = queue.Queue()

        def submit(count: int) -> None:
            for _, index in zip(range(count), todo, strict=False):
                key = f"{stage}-{index}-{uuid.uuid4().hex}"
                future = self._client.submit(function, items[index], key=key, pure=False)
                waiting[key] = (index, future)
                future.add_done_callback(finished.put)

        try:
            submit(max(16, _QUEUED_PER_THREAD * self._threads()))
            while waiting:
                future = self._next(stage, finished)
                index, _ = waiting[future.key]
                results[index] = self._outcome(stage, items[index], future)
                del waiting[future.key]
                submit(1)
                progress(stage, len(results), len(items))
        finally:
            if waiting:
                self._client.cancel([future for _, future in waiting.values()], force=True)
        return [results[i] for i in range(len(items))]

    def _threads(self) -> int:
        return sum(self._client.ncores().values())

    def _next(self, stage: str, finished: "queue.Queue[Any]") -> Any:
        """The next finished task."""
        idle_s = 0.0
        while True:
            try:
                return finished.get(timeout=_POLL_S)
            except queue.Empty:
                idle_s = self._checked(stage, idle_s)

    def _outcome(self, stage: str, item: object, future: Any) -> Any:
        """A finished task's result; `Lost` where Dask gave it up."""
        from distributed import KilledWorker

        idle_s = 0.0
        while True:
            try:
                return future.result(timeout=_POLL_S)
            except KilledWorker as error:
                return given_up(stage, item, f"ended {error.allowed_failures + 1} Dask workers")
            except TimeoutError:
                if future.status == "error":
                    raise  # the task's own
                # Its worker died before the result was fetched: Dask computes it again.
                idle_s = self._checked(stage, idle_s)

    def _checked(self, stage: str, idle_s: float) -> float:
        """For how long there have been no workers.

        Raises:
            IngestError: the scheduler is gone, or there have been no workers for too long.
        """
        again = "what was finished is kept: run the same command again"
        if self._client.status != "running":
            raise IngestError(
                f"{stage}: the connection to the Dask scheduler at {self._address} is lost; {again}"
            )
        if self._threads():
            return 0.0
        if idle_s >= _NO_WORKERS_S:
            raise IngestError(
                f"{stage}: the Dask cluster at {self._address} has had no workers for {idle_s:.0f} s; {again}"
            )
        return idle_s + _POLL_S


def _connected(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError as error:
        raise IngestError(
            "--dask needs the extra `dask`: pip install 'featuredb[dask]', here and on every worker"
        ) from error
    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise IngestError(
            f"--dask {address}: expected the address of a Dask scheduler, such as tcp://10.0.0.1:8786, found "
            f"that it cannot be reached: {error}"
        ) from error


def _thread_caps() -> Any:
    """A plugin that gives the libraries of every worker one thread, those that come later too."""
    from distributed import WorkerPlugin

    class ThreadCaps(WorkerPlugin):  # type: ignore[misc]  # it has no types
        name = "featuredb-thread-caps"

        def setup(self, worker: Any) -> None:
            cap_threads()

    return ThreadCaps()


def _require_shared(client: Any, address: str, folders: list[Path]) -> None:
    """Every worker sees the folders, and what this process wrote into the first, where it may write.

    Raises:
        IngestError: names the workers that do not.
    """
    try:  # a worker that died a moment ago is on its way back
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError as error:
        raise IngestError(
            f"--dask {address}: expected a cluster with workers, found none within {_CONNECT_S:g} s; start "
            "some first"
        ) from error
    token = f".tmp-shared-{uuid.uuid4().hex}"
    if folders:
        folders[0].mkdir(parents=True, exist_ok=True)
        (folders[0] / token).touch()
    try:
        problems: dict[str, Any] = client.run(
            _problem, [str(f) for f in folders], token, version("featuredb"), on_error="return"
        )
    finally:
        for folder in folders[:1]:
            (folder / token).unlink(missing_ok=True)
    bad = [f"{worker}: {problem}" for worker, problem in sorted(problems.items()) if problem]
    if bad:
        raise IngestError(
            f"--dask {address}: {len(bad)} of {len(problems)} workers cannot take part. Workers exchange "
            "results through the work folder, so all need it (--work DIR) and the photos under the same "
            "paths on a shared file system, and the same featuredb. " + "; ".join(bad[:3])
        )


def _problem(folders: list[str], token: str, wanted_version: str) -> str:
    """On a worker: what is wrong, "" if nothing is."""
    found = version("featuredb")
    if found != wanted_version:
        return f"featuredb {found} there, {wanted_version} here"
    for folder in folders:
        if not os.access(folder, os.R_OK):
            return f"does not see {folder}"
    if folders and not (Path(folders[0]) / token).is_file():
        return f"{folders[0]} there is another folder than here"
    if folders and not os.access(folders[0], os.W_OK):
        return f"cannot write to {folders[0]}"
    return ""
