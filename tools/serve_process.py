"""`featuredb serve` and `featuredb gateway` as processes of their own."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import psutil


class CommandProcess:
    """A command that says on its first line where it is, and runs until it is stopped.

    Attributes:
        announced: that line. endpoint: what stands there after "on". errors: lines of its log so far.
    """

    def __init__(self, *argv: object) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "featuredb.cli", *map(str, argv)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONFAULTHANDLER": "1"},
        )
        self.errors: list[str] = []
        # Read both pipes to their ends, so that the server never waits for us.
        self._reader = threading.Thread(target=lambda: self.errors.extend(self.process.stderr or ()))
        self._reader.start()
        self.announced = self.process.stdout.readline()
        assert " on " in self.announced, (self.announced, self.stop(), self.errors)
        self.endpoint = self.announced.split(" on ")[1].split(";")[0].split(", asking")[0].strip()

    def stop(self, number: int = signal.SIGTERM, timeout_s: float = 60.0) -> int:
        """The exit code. Raises subprocess.TimeoutExpired: it does not end, and is killed."""
        self.process.send_signal(number)
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        self._reader.join(10)
        self.process.stdout.close()
        self.process.stderr.close()
        return code

    @property
    def workers(self) -> list[int]:
        """Process ids of the workers, once there are some: grandchildren, since they are forked."""
        end = time.monotonic() + 20.0
        while not (found := grandchildren(self.process.pid)):
            assert time.monotonic() < end, "no worker is there"
            time.sleep(0.01)
        return found

    def log(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.errors if line.startswith("{")]


class ServeProcess(CommandProcess):
    """`featuredb serve`, on a free port where no configuration says another."""

    def __init__(self, *argv: object) -> None:
        where = () if "--config" in argv else ("--listen", "tcp/127.0.0.1:0")
        super().__init__("serve", *argv, *where)


def memory_mib(pid: int) -> float:
    """Of a process and all that it has started; what they share counts once."""
    total = 0
    for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
        with suppress(psutil.Error):  # it has ended meanwhile
            total += process.memory_full_info().pss
    return total / 2**20


def children(pid: int) -> list[int]:
    """Process ids of a process's children."""
    with suppress(psutil.NoSuchProcess):
        return [one.pid for one in psutil.Process(pid).children() if one.status() != psutil.STATUS_ZOMBIE]
    return []


def grandchildren(pid: int) -> list[int]:
    """Process ids of the children's children."""
    return [worker for child in children(pid) for worker in children(child)]


@contextmanager
def beside(threads: Sequence[threading.Thread], stop: threading.Event) -> Iterator[None]:
    """Within the block these run, until they are told to stop."""
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@contextmanager
def watched_memory(pid: int, every_s: float = 1.0) -> Iterator[list[float]]:
    """Looks at the memory of a process and its own again and again within the block: MiB, in order."""
    seen, stop = [memory_mib(pid)], threading.Event()

    def run() -> None:
        while not stop.wait(every_s):
            with suppress(psutil.Error):  # it has ended
                seen.append(memory_mib(pid))

    with beside([threading.Thread(target=run)], stop):
        yield seen
