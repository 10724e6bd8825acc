"""How long one query takes, step by step.

    uv run python tools/query_benchmark.py DB IMAGE...

Each image with its own GPS as prior, decoded, localised and answered in this process, and then the same over
Zenoh on loopback; medians over images and repeats. Transport is the client's wall time less the server's own.
Prints how many answers have stages that add up to their wall time within 1 ms and 2 %.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from featuredb.features.decode import DEFAULT_LIMITS
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from reloc.client import Client, LocaliseReply
from reloc.localiser import Localiser
from reloc.service.handler import answer_query
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from reloc.service.workers.answering import capped_process
from reloc.wire.query import LocaliseWireRequest, RequestOptions
from tools.figures import study_parser, write_figures

_REPEAT, _THREADS = 5, 2
_SUM_TOLERANCE_MS, _SUM_TOLERANCE_REL = 1.0, 0.02
_WITH_PRIOR = LocaliseWireRequest(options=RequestOptions(exif_prior=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class Timed:
    """One query.

    Attributes:
        wall_ms: measured from outside.
        stages_ms: as the answer says them, without their total.
        total_ms: of the stages, as the answer says it.
    """

    reply: LocaliseReply
    wall_ms: float
    stages_ms: dict[str, float]
    total_ms: float

    @property
    def adds_up(self) -> bool:
        """Whether the stages account for the wall time."""
        tolerance_ms = _SUM_TOLERANCE_MS + _SUM_TOLERANCE_REL * self.wall_ms
        return abs(sum(self.stages_ms.values()) - self.wall_ms) <= tolerance_ms


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database = Database.open(args.db)
    with capped_process(_THREADS):
        localiser = Localiser.open(database)
        direct = run_direct(localiser, args.images)
        served = run_served(database, args.images)
    write_figures(args.json, report_ours(direct, served))
    return 0


def run_direct(localiser: Localiser, images: Sequence[Path]) -> list[Timed]:
    """Each image five times in this process, after one round that is not counted."""

    def ask(data: bytes) -> LocaliseReply:
        return answer_query(
            data,
            _WITH_PRIOR,
            localiser,
            limits=DEFAULT_LIMITS,
            request_id="",
            clock=StageClock(),
        )

    return _rounds(ask, images)


def run_served(database: Database, images: Sequence[Path]) -> list[Timed]:
    """The same over Zenoh."""
    options = ServeOptions(listen=("tcp/127.0.0.1:0",), threads_per_worker=_THREADS)
    with start_server(database, options) as server, Client(server.endpoints[0]) as client:
        return _rounds(lambda data: client.localise(data, exif_prior=True, timeout_s=60.0), images)


def _rounds(ask: Callable[[bytes], LocaliseReply], images: Sequence[Path]) -> list[Timed]:
    timed = []
    contents = [path.read_bytes() for path in images]
    for number in range(_REPEAT + 1):
        for data in contents:
            start = time.perf_counter()
            reply = ask(data)
            wall_ms = 1e3 * (time.perf_counter() - start)
            stages = {name: ms for name, ms in reply.timings_ms.items() if name != "total"}
            if number:
                timed.append(
                    Timed(reply=reply, wall_ms=wall_ms, stages_ms=stages, total_ms=reply.timings_ms["total"])
                )
    return timed


def report_ours(direct: Sequence[Timed], served: Sequence[Timed]) -> dict[str, float]:
    """Print both ways of asking; the figures."""
    names = list(dict.fromkeys(name for one in served for name in one.stages_ms))
    lines = [f"{'median ms':<16}{'in process':>12}{'over Zenoh':>12}"]
    for name in names:
        a, b = (median(one.stages_ms.get(name, 0.0) for one in group) for group in (direct, served))
        lines.append(f"{name:<16}{a:>12.2f}{b:>12.2f}")
    transport = [one.wall_ms - one.total_ms for one in served]
    walls = [median(one.wall_ms for one in group) for group in (direct, served)]
    lines.append(f"{'transport':<16}{'':>12}{median(transport):>12.2f}")
    lines.append(f"{'wall':<16}{walls[0]:>12.2f}{walls[1]:>12.2f}")
    adding = sum(one.adds_up for one in direct)
    localised = sum(one.reply.status == "localised" for one in served)
    lines.append(f"{adding} of {len(direct)} answers in process add up to their wall time")
    lines.append(f"{localised} of {len(served)} localised")
    sys.stdout.write("\n".join(lines) + "\n\n")
    sys.stdout.flush()
    return {
        "wall_ms": walls[1],
        "in_process_ms": walls[0],
        "transport_ms": median(transport),
        "asked": len(served),
        "localised": localised,
    }


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__)
    parser.add_argument("db")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
