"""The server's end of one worker process."""

import multiprocessing
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.reduction import send_handle
from types import ModuleType
from typing import TypeVar

from pydantic import BaseModel

from reloc.service.workers.answering import (
    DEFECT,
    OUT_OF_MEMORY,
    REFUSAL,
    Answerer,
    WorkerLimits,
    answer_all,
)
from reloc.service.workers.area_files import LocaliserFiles
from reloc.wire.query import ErrorCode, ErrorReply, RequestError

# Forked from a process that has imported everything and runs no threads: a new one is there in milliseconds.
_CONTEXT = multiprocessing.get_context("forkserver")
_STARTING = threading.Lock()
_Reply = TypeVar("_Reply", bound=BaseModel)
_NOT_STARTED = "no worker process can be started"
_JOIN_S = 5.0  # for one that has ended or is killed


def prepare_workers() -> None:
    """Let the process begin from which workers are forked: its imports take seconds.

    It and this one may have as many open files as the system allows: each map and area is one.
    """
    from multiprocessing.forkserver import ensure_running

    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    _CONTEXT.set_forkserver_preload(["reloc.service.workers.preload"])
    ensure_running()


@contextmanager
def _without_script() -> Iterator[None]:
    """Within the block a new process does not run the script of the program again to import it."""
    with _STARTING:
        own = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = own


class WorkerFailedError(Exception):
    """The process has ended before it answered, or met a defect; the message is for the client, too."""


class WorkerProcess:
    """A process that answers one message at a time; of one thread, but for `kill`."""

    def __init__(self, limits: WorkerLimits, answerer: Answerer) -> None:
        """Raises WorkerFailedError where no process can be started."""
        try:
            self._connection, theirs = _CONTEXT.Pipe()
        except OSError as error:  # too many open files
            raise WorkerFailedError(_NOT_STARTED) from error
        self._limits = limits
        self._open: LocaliserFiles | None = None
        self.killed = False  # by `kill`
        self._process = _CONTEXT.Process(
            target=answer_all, args=(theirs, limits, answerer), name="localise", daemon=True
        )
        try:
            with _without_script():
                self._process.start()
        except (EOFError, OSError) as error:  # no memory, or whom it is forked from has ended
            self._connection.close()
            raise WorkerFailedError(_NOT_STARTED) from error
        finally:
            theirs.close()

    def is_alive(self) -> bool:
        """Between queries: then there is nothing to be read but the end. One that was told to end is not."""
        return not self.killed and not self._connection.poll() and self._process.is_alive()

    def kill(self) -> None:
        """From any thread: whoever waits for an answer gets WorkerFailedError."""
        self.killed = True
        self._process.kill()

    def close(self) -> None:
        """End it; the owner's last call."""
        self._process.kill()
        self._process.join(_JOIN_S)
        self._connection.close()

    def open(self, files: LocaliserFiles) -> None:
        """Answer from this localiser; does nothing where it does already.

        Raises:
            WorkerFailedError: the process has ended.
        """
        if files is self._open:
            return
        try:
            self._connection.send(tuple(file.key for file in files))
            for file in files:
                send_handle(self._connection, file.file.fileno(), self._process.pid)
            self._connection.recv_bytes()
        except (EOFError, OSError) as error:
            raise self._ended() from error
        self._open = files

    def ask(
        self,
        files: LocaliserFiles,
        ask: object,
        data: bytes,
        reply: type[_Reply],
        time_s: float,
        late: RequestError,
    ) -> _Reply:
        """What the process's answerer answers about an image file, from a localiser, read as `reply`.

        Raises:
            late: it took longer than `time_s`, and the process is killed.
            RequestError: why there is no answer; TOO_LARGE where the process has ended for want of memory.
            WorkerFailedError: the process has ended otherwise, or there was a defect.
        """
        end = time.perf_counter() + time_s
        watch = threading.Timer(time_s, self.kill)  # one that has stopped does not even read
        watch.start()
        try:
            self.open(files)
            self._connection.send(ask)
            self._connection.send_bytes(data)
            answer = self._connection.recv_bytes()
        except (EOFError, OSError, WorkerFailedError) as error:
            if time.perf_counter() >= end:
                raise late from error
            ended = self._ended()
            if self._process.exitcode != OUT_OF_MEMORY:
                raise ended from error
            raise RequestError(
                ErrorCode.TOO_LARGE,
                f"the picture needs more than the {self._limits.memory_bytes >> 20} MiB of memory that it "
                "may; send a smaller one",
            ) from error
        finally:
            watch.cancel()
        kind, content = answer[:1], answer[1:]
        if kind == DEFECT:
            raise WorkerFailedError("the server failed") from RuntimeError(content.decode())
        if kind == REFUSAL:
            refusal = ErrorReply.model_validate_json(content)
            raise RequestError(ErrorCode(refusal.code), refusal.message)
        return reply.model_validate_json(content)

    def _ended(self) -> WorkerFailedError:
        self._process.join(_JOIN_S)
        code = self._process.exitcode
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        return WorkerFailedError(f"the worker process ended with {how}")
