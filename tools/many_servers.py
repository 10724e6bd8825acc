"""What several servers of one database behind a router carry, and what becomes of queries when one is killed.

Each server is a process whose only worker takes 100 ms for a photo and does nothing else. Clients ask without
pause: one server, two, four; then two of which one is killed (SIGKILL) in the middle.
"""

import io
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray
from PIL import Image

from featuredb.errors import ServiceError
from reloc.client import Client
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest, LocaliseResult
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.session import bind_free_port
from reloc.service.source import ServedArea
from tools.figures import study_parser, write_figures

_TAKES_S = 0.1
_ASKING = 12  # threads of clients
_SECONDS = 8.0
_DATABASE = "town"


class _Slow:
    """A localiser that takes its time and finds nothing."""

    options, snapshot, areas = LocaliseOptions(), 1, ()

    def localise(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, size: tuple[int, int]
    ) -> LocaliseResult:
        time.sleep(_TAKES_S)
        nothing = {"features": 0, "matches": 0, "inliers": 0}
        return LocaliseResult(reason="NO_COVERAGE", detail="", snapshot=self.snapshot, **nothing)


def main() -> None:
    args = study_parser(__doc__).parse_args()
    rates = {}
    for count in (1, 2, 4):
        with servers(count) as (router, _):
            rates[count] = ask(router, _SECONDS)["answered"] / _SECONDS
    with servers(2) as (router, processes):
        killed = ask(router, _SECONDS, lambda: processes[0].kill())
    figures = {
        "one_per_s": rates[1],
        "two_times": rates[2] / rates[1],
        "four_times": rates[4] / rates[1],
        "killed_answered": killed["answered"],
        "killed_lost": killed["lost"],
    }
    write_figures(args.json, figures)


@contextmanager
def servers(count: int) -> Iterator[tuple[str, list[Any]]]:
    """A router's endpoint, and so many server processes that are connected to it."""
    context = multiprocessing.get_context("spawn")
    endpoint = bind_free_port("tcp/127.0.0.1:0")
    config = zenoh.Config.from_json5(f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}}}')
    config.insert_json5("scouting/multicast/enabled", "false")
    pipes = [context.Pipe() for _ in range(count)]  # an event would wait for a killed one
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(config))
        processes = [context.Process(target=_serve, args=(endpoint, theirs)) for _, theirs in pipes]
        for process in processes:
            process.start()
        try:
            with Client(endpoint, _DATABASE, connect_timeout_s=60.0) as client:
                while len(client.statuses()) < count:
                    time.sleep(0.1)
            yield endpoint, processes
        finally:
            for process, (ours, theirs) in zip(processes, pipes, strict=True):
                theirs.close()
                ours.close()
                process.join()


def _serve(router: str, until_closed: Connection) -> None:
    options = ServeOptions(listen=("tcp/127.0.0.1:0",), connect=(router,), workers=1, contributions=False)
    source = SimpleNamespace(version=lambda: 1, load=lambda: ServedArea(localiser=_Slow(), maps=()))
    with Server.start(source, options, _DATABASE):
        until_closed.poll(None)


def ask(router: str, seconds: float, in_the_middle: Callable[[], None] = lambda: None) -> Counter[str]:
    """Queries that were answered, and that were not, of clients that ask without pause for so long."""
    picture = io.BytesIO()
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(picture, "png")
    with Client(router, _DATABASE) as client, ThreadPoolExecutor(_ASKING) as pool:
        end = time.monotonic() + seconds

        def ask_on() -> Counter[str]:
            asked: Counter[str] = Counter()
            while time.monotonic() < end:
                try:
                    client.localise(picture.getvalue())
                    asked["answered"] += 1
                except ServiceError:
                    asked["lost"] += 1
            return asked

        asking = [pool.submit(ask_on) for _ in range(_ASKING)]
        time.sleep(0.5 * seconds)
        in_the_middle()
        return sum((one.result() for one in asking), Counter())


if __name__ == "__main__":
    from tools import many_servers  # workers look for its classes there, and not in a program

    many_servers.main()
