"""A server under mixed load for long: queries, commits, reloads, kills, hostile messages.

Honest clients ask as in tools/attacks_benchmark.py; meanwhile maps are committed and retired, workers killed,
and truncated photos and broken messages sent, in turn. Every answer must be that of the quiet server, every
question must have an answer or an error of the server's, and the memory must stay as it was.
"""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from statistics import median

from featuredb.errors import ServiceError
from featuredb.store import Database
from reloc.client import Client
from reloc.client.connection import NO_SERVER, TIMEOUT
from tools.commands import first_map
from tools.figures import say, write_figures
from tools.serve_process import watched_memory
from tools.service_world import (
    ATTACKER,
    Service,
    honest_clients,
    moved,
    photos_of,
    running_service,
    service_parser,
)

_EVENT_S = 5.0  # between two of what happens beside the queries


class Events:
    """What happens beside the queries. Attributes: counts, by what it was."""

    def __init__(self, database: Database, service: Service, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self._database, self._service, self._photo = database, service, service.photos[0]
        self._rng = random.Random(seed)
        self._original = first_map(database)
        self._turns = cycle((self._commit, self._kill, self._send_broken, self._retire, self._kill))

    def next(self) -> None:
        event: Callable[[], None] = next(self._turns)
        event()
        self.counts[event.__name__.strip("_")] += 1

    def _commit(self) -> None:
        number = 100 + self.counts["commit"]
        self._map_id = f"soak-{number}"
        self._database.commit_map(replace(moved(self._original, number), map_id=self._map_id))

    def _retire(self) -> None:
        self._database.retire(self._map_id, "its turn is over")

    def _kill(self) -> None:
        os.kill(self._rng.choice(self._service.server.workers), signal.SIGKILL)

    def _send_broken(self) -> None:
        with Client(config_path=self._service.config(ATTACKER)) as client:
            for share in (0.1, 0.5, 0.9):
                try:
                    client.localise(self._photo[: int(share * len(self._photo))])
                except ServiceError as error:
                    self.counts[f"broken {error.code}"] += 1


def main() -> None:
    parser = service_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    args = parser.parse_args()
    database = Database.open(args.db)
    with running_service(args.db, photos_of(args.photos, 4)) as service:
        events = Events(database, service, seed=1)
        end = time.monotonic() + 60 * args.minutes
        with (
            watched_memory(service.server.process.pid, every_s=5.0) as memory,
            honest_clients(service) as heard,
        ):
            while time.monotonic() < end:
                time.sleep(_EVENT_S)
                events.next()
        with Client(config_path=service.config(ATTACKER)) as client:
            status = client.status()
    exit_code = service.server.process.returncode
    failures = Counter(heard.failures)
    quarter = len(memory) // 4
    early, late = median(memory[quarter : 2 * quarter]), median(memory[-quarter:])
    say(f"failures {dict(failures)}, events {dict(events.counts)}, {status.reload}")
    figures = {
        "asked": len(heard.seconds),
        "wrong": heard.wrong,
        "missing": failures[TIMEOUT] + failures[NO_SERVER],
        "failed": sum(failures.values()),
        "kills": events.counts["kill"],
        "reloads": status.reload.count,
        "p99_s": heard.p99_s(),
        "late_mib": late,
        "grown_mib": late - early,
        "exit_code": exit_code,
    }
    write_figures(args.json, figures)


if __name__ == "__main__":
    main()
