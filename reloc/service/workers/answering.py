"""What a worker process does: decode and localise pictures, one at a time, over areas that it has mapped."""

import math
import os
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle
from pathlib import Path
from typing import Any

import cv2
from pydantic import BaseModel
from threadpoolctl import threadpool_limits

from reloc.localiser import Localiser
from reloc.service.workers.area_files import MappedAreas
from reloc.wire.query import ErrorReply, RequestError, encode

# What the first byte of an answer says of the rest.
REPLY, REFUSAL, DEFECT = b"R", b"E", b"D"
OUT_OF_MEMORY = 77  # exit code

# Answers a message with an image file in the process, to which it is sent as it is when that starts.
# Raises RequestError: why there is no answer.
Answerer = Callable[[Any, bytes, Localiser], BaseModel]


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerLimits:
    """What one picture may use."""

    threads: int  # of OpenCV and BLAS
    memory_bytes: int  # of address space, beyond what the process has before
    processor_s: float  # of all threads together


class _Stop:
    """SIGTERM ends an idle process at once, and one that has a picture in hand after it."""

    def __init__(self) -> None:
        self.busy = self.wanted = False
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server

    def _on_signal(self, *_: object) -> None:
        self.wanted = True
        if not self.busy:
            os._exit(0)


def answer_all(connection: Connection, limits: WorkerLimits, answerer: Answerer) -> None:
    """Until the other end is closed: answers what the answerer is asked.

    And to keys of a localiser's files, a tuple, that follow as descriptors: empty, it answers from now on.
    """
    stop, areas = _Stop(), MappedAreas()
    localiser: Localiser | None = None
    unlimited = resource.getrlimit(resource.RLIMIT_AS)
    cv2.setNumThreads(limits.threads)
    threadpool_limits(limits.threads)
    while not stop.wanted:
        try:
            message = connection.recv()
            stop.busy = True
            if isinstance(message, tuple):
                resource.setrlimit(resource.RLIMIT_AS, unlimited)
                localiser = _opened(connection, message, areas)
                answer = b""
            else:
                data = connection.recv_bytes()
                assert localiser is not None
                _limit(limits)
                answer = _answer(answerer, message, data, localiser)
            connection.send_bytes(answer)
        except (EOFError, OSError):
            return
        except (MemoryError, RuntimeError, cv2.error) as error:
            if not _is_out_of_memory(error):
                raise
            os._exit(OUT_OF_MEMORY)
        stop.busy = False


def _opened(connection: Connection, keys: tuple[int, ...], areas: MappedAreas) -> Localiser:
    """Raises SystemExit, and says why, where a file cannot be mapped."""
    try:
        localiser: Localiser = areas.localiser(keys, lambda: recv_handle(connection))
    except OSError as error:
        if isinstance(error, ConnectionError):
            raise
        sys.exit(f"a worker cannot map the areas: {error}")
    return localiser


def _limit(limits: WorkerLimits) -> None:
    """Limits of the next picture, above what the process has and has used so far."""
    times = os.times()
    used_s = times.user + times.system
    _set_limit(resource.RLIMIT_CPU, math.ceil(used_s + limits.processor_s) + 1)
    statm = Path("/proc/self/statm")
    if statm.exists():  # Linux
        now = int(statm.read_text().split()[0]) * resource.getpagesize()
        _set_limit(resource.RLIMIT_AS, now + limits.memory_bytes)


def _set_limit(which: int, wanted: int) -> None:
    """As wanted, or as the system that the server runs on allows at most."""
    _, hard = resource.getrlimit(which)
    resource.setrlimit(which, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard))


def _answer(answerer: Answerer, ask: object, data: bytes, localiser: Localiser) -> bytes:
    try:
        return REPLY + encode(answerer(ask, data, localiser))
    except RequestError as error:
        return REFUSAL + encode(ErrorReply(code=error.code, message=error.message, request_id=None))
    except Exception as error:  # the server logs it
        if _is_out_of_memory(error):
            raise
        return DEFECT + traceback.format_exc().encode()


def _is_out_of_memory(error: Exception) -> bool:
    if isinstance(error, cv2.error):
        return bool(error.code == cv2.Error.StsNoMem)
    # A thread has no place for its stack.
    return isinstance(error, MemoryError) or str(error) == "can't start new thread"
