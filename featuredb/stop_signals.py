"""What a process does when it is told to stop."""

import logging
import multiprocessing
import multiprocessing.util
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NoReturn


@contextmanager
def on_stop_signals(stop: Callable[[], object]) -> Iterator[None]:
    """Within it SIGINT and SIGTERM call `stop`, at any time and more than once; call from the main thread."""
    before = {number: signal.signal(number, lambda *_: stop()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def sigterm_as_ctrl_c() -> Iterator[None]:
    """Within it SIGTERM interrupts as Ctrl-C does, so that temporary files go; elsewhere than in the main
    thread nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def handle_as_before() -> None:
    """SIGTERM is answered as Python knows it, whatever a native library has put in place of that."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)


def end_process(code: int) -> NoReturn:
    """End a process that has done its work, though threads of it may still be in native code.

    Python's own end takes the interpreter from under them: of 25 processes with threads that polled a
    database 23 ended with SIGSEGV, of 25 that ended so none. What multiprocessing keeps in a folder for
    temporary files goes with it.
    """
    try:
        for child in multiprocessing.active_children():
            child.kill()
        shutil.rmtree(multiprocessing.util.get_temp_dir(), ignore_errors=True)
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):  # whoever reads it is gone
                stream.flush()
    finally:
        os._exit(code)
