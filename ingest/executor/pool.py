"""A pool of processes in which a worker that dies takes nothing but its own task with it.

`concurrent.futures.ProcessPoolExecutor` ends all its workers when one dies, and does not say whose task
it was. Here each worker has a pipe of its own.
"""

import logging
import multiprocessing
import multiprocessing.connection
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Self, TypeVar

from ingest.executor.interface import Executor, InProcessExecutor, Lost, Progress, given_up, no_progress
from ingest.executor.worker import READY, capped_environment, serve

_LOG = logging.getLogger(__name__)
# Beside other tasks, then twice alone: what died for want of memory has all of it then.
_RUNS_ALONE = 2
# Workers that die before they are ready, in a row: then it is the environment and no task.
_FAILED_STARTS = 3

Item = TypeVar("Item")
Result = TypeVar("Result")


class PoolExecutor:
    """Runs tasks on worker processes, which start on first use and end with the context.

    Workers are spawned, never forked: threads of the parent (FAISS, Arrow) do not survive a fork.
    """

    def __init__(self, workers: int) -> None:
        self._count = workers
        self._workers: list[_Worker] = []
        self._failed_starts = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failed: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._workers = []

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result | Lost]:
        """See `Executor.map`."""
        results: dict[int, Any] = {}
        died: list[int] = []

        def done(index: int, value: Any) -> None:
            results[index] = value
            progress(stage, len(results), len(items))

        try:
            for index in self._run(stage, function, items, range(len(items)), self._count, done):
                died.append(index)
            for index in died:
                for _ in range(_RUNS_ALONE):
                    if not list(self._run(stage, function, items, [index], 1, done)):
                        break
                else:
                    ended = f"ended {_RUNS_ALONE + 1} worker processes, at last alone"
                    done(index, given_up(stage, items[index], ended))
        except BaseException:
            self._drop_busy()
            raise
        return [results[i] for i in range(len(items))]

    def _run(
        self,
        stage: str,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        indices: Sequence[int],
        most: int,
        done: Callable[[int, Any], None],
    ) -> list[int]:
        """Run some items on at most that many workers; those whose worker died."""
        todo, died = deque(indices), []
        while todo or any(w.task is not None for w in self._workers):
            self._give(function, items, todo, most)
            busy = {w.connection: w for w in self._workers if w.task is not None or not w.ready}
            for connection in multiprocessing.connection.wait(list(busy)):
                worker = busy[connection]  # type: ignore[index]
                task = worker.task
                try:
                    answer = worker.receive()
                except (EOFError, OSError):
                    self._buried(stage, worker)
                    if task is not None:
                        died.append(task)
                    continue
                if answer is None:  # it is ready now
                    self._failed_starts = 0
                    continue
                assert task is not None
                good, value = answer
                if not good:
                    raise value
                done(task, value)
        return died

    def _give(
        self, function: Callable[[Any], Any], items: Sequence[Any], todo: deque[int], most: int
    ) -> None:
        """A task to every ready worker that has none, and as many workers as the tasks can use."""
        free = [w for w in self._workers if w.ready and w.task is None]
        running = sum(w.task is not None for w in self._workers)
        for worker in free[: max(0, most - running)]:
            if todo:
                worker.send(todo.popleft(), function, items)
        starting = sum(not w.ready for w in self._workers)
        if todo and len(self._workers) < most and starting < len(todo):
            with capped_environment():
                while len(self._workers) < most and starting < len(todo):
                    self._workers.append(_Worker())
                    starting += 1

    def _buried(self, stage: str, worker: "_Worker") -> None:
        """Remove a worker that died.

        Raises:
            IngestError: it never came to life, and others before it neither.
        """
        from featuredb.errors import IngestError

        self._workers.remove(worker)
        end = worker.end()
        if worker.ready:
            _LOG.warning("%s: a worker process ended (%s); its task runs again", stage, end)
            return
        self._failed_starts += 1
        if self._failed_starts >= _FAILED_STARTS:
            raise IngestError(
                f"{stage}: expected worker processes, found that {self._failed_starts} in a row ended while "
                f"starting ({end}); what was finished is kept: see their output above, or use --workers 1"
            )

    def _drop_busy(self) -> None:
        """End the workers whose answers nobody waits for any more."""
        for worker in [w for w in self._workers if w.task is not None or not w.ready]:
            worker.kill()
            self._workers.remove(worker)


@contextmanager
def open_executor(workers: int, dask: str | None = None, shared: Sequence[Path] = ()) -> Iterator[Executor]:
    """The executor that somebody asks for.

    Args:
        workers: processes; 1 runs everything in this one.
        dask: address of a scheduler, whose workers run the tasks instead.
        shared: folders that all of these must see, the work folder first.
    """
    if dask is not None:
        from ingest.executor.dask_cluster import DaskExecutor

        with DaskExecutor(dask, shared=shared) as cluster:
            yield cluster
    elif workers == 1:
        yield InProcessExecutor()
    else:
        with PoolExecutor(workers) as pool:
            yield pool


class _Worker:
    """One process and the pipe to it."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection: Connection
        self.connection, child = context.Pipe()
        self._process: SpawnProcess = context.Process(
            target=serve, args=(child,), name="featuredb-worker", daemon=True
        )
        self._process.start()
        child.close()  # else its end would never be seen here
        self.ready = False
        self.task: int | None = None

    def send(self, index: int, function: Callable[[Any], Any], items: Sequence[Any]) -> None:
        message = pickle.dumps((function, items[index]))
        self.task = index
        try:
            self.connection.send_bytes(message)
        except OSError:
            _LOG.debug("%s died between two tasks", self._process)  # seen again when its answer is read

    def receive(self) -> tuple[bool, Any] | None:
        """Its answer; None for the word that it is ready.

        Raises:
            EOFError, OSError: it is dead.
        """
        message = self.connection.recv_bytes()
        if not self.ready and message == READY:
            self.ready = True
            return None
        answer: tuple[bool, Any] = pickle.loads(message)
        self.task = None
        return answer

    def end(self) -> str:
        """How a dead one ended, for people."""
        self.connection.close()
        self._process.join()
        code = self._process.exitcode or 0
        return f"signal {-code}, {signal.strsignal(-code)}" if code < 0 else f"exit code {code}"

    def kill(self) -> None:
        self._process.kill()
        self.end()

    def stop(self) -> None:
        """Hang up; an idle worker ends by itself."""
        self.connection.close()
        self._process.join(10.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
