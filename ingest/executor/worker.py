"""The worker's side of the process pool; nothing heavy until a task is there."""

import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from featuredb.extras import leave_out_pandas

# What OpenMP, OpenBLAS and MKL read when they are loaded.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
READY = b"ready"


@contextmanager
def capped_environment() -> Iterator[None]:
    """One thread for the libraries of the children that start meanwhile."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def cap_threads() -> None:
    """One thread for libraries that do not read the environment, or are loaded already."""
    import cv2
    from threadpoolctl import threadpool_limits

    cv2.setNumThreads(1)
    threadpool_limits(1)


def serve(connection: Connection) -> None:
    """Answer tasks until the parent hangs up: (function, item) in, (True, result) or (False, error) out."""
    leave_out_pandas()
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    cap_threads()
    try:
        connection.send_bytes(READY)
        while True:
            connection.send_bytes(_answer(connection.recv_bytes()))
    except (EOFError, OSError):
        return  # the parent hung up


def _answer(message: bytes) -> bytes:
    try:
        function, item = pickle.loads(message)
        return pickle.dumps((True, function(item)))
    except Exception as error:  # noqa: BLE001 (it travels to the parent and is raised there)
        return _pickled_error(error)


def _pickled_error(error: Exception) -> bytes:
    """The error with the worker's traceback as a note; as text where it does not survive pickling."""
    note = "In a worker process:\n" + "".join(traceback.format_exception(error))
    plain: Any = RuntimeError(f"{type(error).__name__}: {error}")
    for candidate in (error, plain):
        candidate.add_note(note)
        try:
            message = pickle.dumps((False, candidate))
            pickle.loads(message)
        except Exception:  # noqa: BLE001 (any class may refuse in its own way)
            continue
        return message
    raise AssertionError("a RuntimeError of a text can be pickled")


def _end_with_parent() -> None:
    """A parent that is killed cannot end its workers; they would go on with their task."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)
