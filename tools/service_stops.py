"""Does a server that is stopped in the middle of its load end, cleanly and in time?

Each time a server process is started, asked by several clients at once, and told to stop by SIGTERM at a
random moment. Clean is: exit code 0 within the time that queries in hand may take, nothing left of its
processes, and an answer or an error for each question that it had taken.
"""

import random
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from featuredb.errors import ServiceError
from reloc.client import Client
from reloc.client.connection import TIMEOUT
from tools.figures import say, write_figures
from tools.serve_process import ServeProcess, beside, children
from tools.service_world import photos_of, service_parser

_STOPS, _CLIENTS = 200, 4
_STOP_S = 30.0  # ten for queries in hand, ten for live sessions, ten for the inbox
_LOG_LINES = 200  # a trace of every thread has some hundred
_LATEST_S = 2.0  # the last moment of the signal, after the first question


class Stopped(NamedTuple):
    """One stop. `codes`: what clients heard, "" for an answer. left: processes that outlived it.
    log: the last lines that the server wrote."""

    seconds: float
    exit_code: int | None
    codes: list[str]
    left: int
    log: list[str]

    @property
    def clean(self) -> bool:
        return self.exit_code == 0 and not self.left and TIMEOUT not in self.codes


def stopped_under_load(database: Path, photo: bytes, after_s: float) -> Stopped:
    """Start a server, ask, and stop it so long after the first question."""
    server = ServeProcess(database)
    tree = [server.process.pid, *children(server.process.pid), *server.workers]
    codes: list[str] = []
    asking = threading.Event()

    def ask() -> None:
        try:
            with Client(server.endpoint) as client:
                while server.process.poll() is None:
                    asking.set()
                    client.localise(photo, timeout_s=_STOP_S)
                    codes.append("")
        except ServiceError as error:
            codes.append(error.code)

    code: int | None = None
    with beside([threading.Thread(target=ask) for _ in range(_CLIENTS)], threading.Event()):
        asking.wait(_STOP_S)
        time.sleep(after_s)
        start = time.monotonic()
        with suppress(subprocess.TimeoutExpired):
            code = server.stop(timeout_s=_STOP_S)
        seconds = time.monotonic() - start
    end = time.monotonic() + 5.0
    while (left := sum(Path(f"/proc/{pid}").exists() for pid in tree)) and time.monotonic() < end:
        time.sleep(0.05)
    return Stopped(seconds, code, codes, left, server.errors[-_LOG_LINES:])


def main() -> None:
    args = service_parser(__doc__).parse_args()
    (photo,) = photos_of(args.photos, 1)
    rng = random.Random(1)
    found = []
    for number in range(_STOPS):
        found.append(stopped_under_load(args.db, photo, rng.uniform(0.0, _LATEST_S)))
        if not found[-1].clean:
            say(f"stop {number}: {found[-1]._replace(log=[])}\n{''.join(found[-1].log)}")
    figures = {
        "stops": len(found),
        "clean": sum(one.clean for one in found),
        "slowest_s": max(one.seconds for one in found),
    }
    write_figures(args.json, figures)


if __name__ == "__main__":
    main()
