"""What honest clients notice while others attack: answer times, failures and the server's memory.

DB has one real map of the PHOTOS, and is made larger by copies of it to 200,000 points. A real server process
with keys (TLS, rules) and a gateway serve it. Three honest clients ask photos with and without a prior, one
of them newly connected each time, quiet and under each attack of tools/attacks.py. A failed question counts
as one that took the deadline.
"""

import itertools
import multiprocessing
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext

import numpy as np
import requests

from featuredb.store import Database
from reloc.service.options import wire_name_of
from tools.attacks import ATTACKS, Target
from tools.figures import say, write_figures
from tools.serve_process import beside, memory_mib, watched_memory
from tools.service_world import (
    ATTACKER,
    DEADLINE_S,
    Service,
    enlarged,
    honest_clients,
    photos_of,
    running_service,
    service_parser,
)

_CONTEXT = multiprocessing.get_context("spawn")
_CALM_S = 3.0  # between attacks
_SECONDS = 30.0  # for each attack
_POINTS = 200_000


def main() -> None:
    args = service_parser(__doc__).parse_args()
    database = Database.open(args.db)
    map_ids = enlarged(database, _POINTS)
    measured: dict[str, dict[str, float]] = {}
    with running_service(args.db, photos_of(args.photos, 6)) as service:
        target = Target(
            config=service.config(ATTACKER),
            name=ATTACKER,
            port=service.port,
            gateway=int(service.gateway.endpoint.rsplit(":", 1)[1]),
            database=wire_name_of(str(args.db)),
            photo=service.photos[0],
            map_ids=map_ids,
            pid=service.server.process.pid,
        )
        for name in ("quiet", *ATTACKS):
            with (
                nullcontext() if name == "quiet" else _attacked(name, target),
                watched_memory(service.server.process.pid) as memory,
                honest_clients(service) as heard,
                _web_client(service) as http,
            ):
                time.sleep(_SECONDS)
            time.sleep(_CALM_S)
            measured[name] = {
                "asked": len(heard.seconds),
                "p99_s": heard.p99_s(),
                "failures": len(heard.failures),
                "wrong": heard.wrong,
                "http_p99_s": float(np.percentile(http, 99)),
                "peak_mib": max(memory),
                "after_mib": memory_mib(service.server.process.pid),
            }
            say(f"{name}: {measured[name]}")
    points = sum(one.points for one in database.snapshot().maps())
    write_figures(args.json, figures(measured) | {"points": points})


def figures(measured: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Those of the quiet server, and the worst of all attacks."""
    *_, last = measured.values()
    others = [of for name, of in measured.items() if name not in ("quiet", "workers killed")]
    return {
        "quiet_p99_s": measured["quiet"]["p99_s"],
        "quiet_mib": measured["quiet"]["peak_mib"],
        "worst_p99_s": max(of["p99_s"] for of in others),
        "worst_http_p99_s": max(of["http_p99_s"] for of in others),
        "failures": sum(of["failures"] for of in others),
        "failures_by_kills": measured["workers killed"]["failures"],
        "wrong": sum(of["wrong"] for of in measured.values()),
        "asked": sum(of["asked"] for of in measured.values()),
        "peak_mib": max(of["peak_mib"] for of in measured.values()),
        "after_mib": last["after_mib"],
    }


@contextmanager
def _attacked(name: str, target: Target) -> Iterator[None]:
    process = _CONTEXT.Process(target=ATTACKS[name], args=(target,), daemon=True)
    process.start()
    time.sleep(_CALM_S)  # it imports, and begins
    try:
        yield
        assert process.is_alive(), f"the attack {name!r} has ended"
    finally:
        process.kill()
        process.join()


@contextmanager
def _web_client(service: Service) -> Iterator[list[float]]:
    """Within the block a client asks over HTTP: seconds, of what has no answer the deadline."""
    heard: list[float] = []
    stop = threading.Event()

    def run() -> None:
        for photo in itertools.cycle(service.photos):
            if stop.wait(1.0):
                return
            start = time.monotonic()
            try:
                answer = requests.post(
                    f"{service.gateway.endpoint}/localise",
                    files={"image": photo},
                    data={"options": '{"exif_prior": true}'},
                    timeout=DEADLINE_S,
                )
                ok = answer.status_code == 200
            except requests.RequestException:
                ok = False
            heard.append(time.monotonic() - start if ok else DEADLINE_S)

    with beside([threading.Thread(target=run)], stop):
        yield heard


if __name__ == "__main__":
    main()
