"""One interface to run many independent tasks: in this process or on a pool of processes.

Only the standard library is imported here: a worker sets its thread caps before numpy, OpenCV and
FAISS are loaded, because they read them when they are.
"""

import logging
import multiprocessing
import multiprocessing.connection
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from types import TracebackType
from typing import Protocol, Self, TypeVar

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
Result = TypeVar("Result")
Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total) from the calling thread."""

# What OpenMP, OpenBLAS and MKL read when they are loaded.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_QUEUED_PER_WORKER = 4  # keeps workers busy without holding thousands of pending results in memory


def no_progress(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


class Executor(Protocol):
    """Runs a function over items; results come in the items' order."""

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result]: ...


class InProcessExecutor:
    """Runs everything in the calling thread: for tests and for debuggers."""

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result]:
        results: list[Result] = []
        for item in items:
            results.append(function(item))
            progress(stage, len(results), len(items))
        return results


class PoolExecutor:
    """Runs tasks on worker processes, which start on first use and end with the context.

    Functions must be importable by name (no lambdas). Workers are spawned, never forked: threads of the
    parent (FAISS, Arrow) do not survive a fork.
    """

    def __init__(self, workers: int, threads_per_worker: int = 1) -> None:
        self._workers = workers
        self._threads = threads_per_worker
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    def map(
        self,
        stage: str,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        progress: Progress = no_progress,
    ) -> list[Result]:
        """Run `function` over `items`.

        Raises:
            IngestError: a worker process died (out of memory, killed); says which items it had.
            Exception: whatever the function raised.
        """
        results: dict[int, Result] = {}
        pending: dict[Future[Result], int] = {}
        todo = iter(range(len(items)))
        with _environment({name: str(self._threads) for name in _THREAD_VARIABLES}):
            try:
                while len(results) < len(items):
                    for i in todo:
                        pending[self._ready().submit(function, items[i])] = i
                        if len(pending) >= _QUEUED_PER_WORKER * self._workers:
                            break
                    done, _ = wait(pending, return_when=FIRST_COMPLETED)
                    for future in done:
                        results[pending[future]] = future.result()
                        del pending[future]
                    progress(stage, len(results), len(items))
            except BrokenProcessPool as error:
                raise _dead_worker(stage, [items[i] for i in pending.values()]) from error
            finally:
                for future in pending:
                    future.cancel()
        return [results[i] for i in range(len(items))]

    def _ready(self) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                max_workers=self._workers,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_start_worker,
                initargs=(self._threads,),
            )
        return self._pool


def _dead_worker(stage: str, items: Sequence[object]) -> Exception:
    from featuredb.errors import IngestError

    shown = ", ".join(str(i) for i in items[:3])
    return IngestError(
        f"{stage}: a worker process died (killed, or out of memory) while {len(items)} tasks were open, "
        f"among them {shown}; what was finished is kept: run the same command again, with fewer --workers "
        "if memory is short"
    )


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the children that start meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _start_worker(threads: int) -> None:
    """First thing in a worker: caps for libraries that are already loaded, and an end with the parent."""
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()
    import cv2

    cv2.setNumThreads(threads)


def _end_with_parent() -> None:
    """A parent that is killed cannot end its workers; they would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)
