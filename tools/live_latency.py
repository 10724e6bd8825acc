"""How long poses take, live: a film streamed at its own speed to a server of its own.

    python -m tools.live_latency DB VIDEO [--camera MODEL,WIDTH,HEIGHT,PARAMS...] [--clients 1] [--seconds 40]

The server is `featuredb serve DB`, a process of its own on a free port of this machine; the clients are
threads of this process. Prints, of all clients together, the median and the 95th percentile of the time from
sending a frame to its pose, how many of the frames were answered, and the median and 95th percentile of the
server's stages: queue (waiting for the frame before), decode, track, reply (the pose on Earth); and how many
cores the server took. The load of the machine stands beside it: figures of a busy machine are not those of
the program.

A town and a film of it, in a few minutes:

    featuredb simworld town; featuredb ingest photos town.db town/drone
    python -c "from featuredb.simworld.film_world import FilmOptions, write_film; \\
               from featuredb.simworld.flight_path import PathOptions; \\
               from featuredb.simworld.world import WorldOptions; \\
               write_film('film', FilmOptions(world=WorldOptions.short(1), frames=600, \\
                          path=PathOptions(half_extent_m=(32.0, 26.0))))"
"""

import argparse
import contextlib
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from reloc.client import Client
from reloc.client.film import StreamedFilm, StreamOptions, stream_film
from reloc.query_arguments import parse_camera

_SERVE = "import sys; from featuredb.cli.main import main; sys.exit(main(sys.argv[1:]))"


@contextlib.contextmanager
def serving(database: Path, sessions: int) -> Iterator[tuple[str, int]]:
    """A server of the database in a process of its own: its endpoint and its number."""
    options = ["--listen", "tcp/127.0.0.1:0", "--live-sessions", str(sessions), "--contributions", "off"]
    with subprocess.Popen(
        [sys.executable, "-c", _SERVE, "serve", str(database), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as server:
        try:
            assert server.stdout is not None
            said = server.stdout.readline()
            found = re.search(r" on (tcp/\S+);", said)
            if found is None:
                raise SystemExit(f"live_latency: the server did not start ({said!r}); try `featuredb serve`")
            yield found[1], server.pid
        finally:
            server.terminate()


def measure(
    endpoint: str, video: str, camera: str | None, clients: int, seconds: float
) -> list[StreamedFilm]:
    """Stream the film by so many clients at a time."""

    def stream(_: int) -> StreamedFilm:
        with Client(endpoint) as client:
            options = StreamOptions(end_s=seconds)
            return stream_film(client, video, camera=parse_camera(camera), options=options)

    with ThreadPoolExecutor(clients) as pool:
        return list(pool.map(stream, range(clients)))


def cpu_s(process: int) -> float:
    """Processor time that a process has taken so far, as Linux tells it."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def report(found: Sequence[StreamedFilm]) -> str:
    """The figures in words."""
    points = [point for film in found for point in film.trajectory.points]
    frames, sent = sum(film.frames for film in found), sum(film.sent for film in found)
    states = {state: sum(p.state == state for p in points) for state in ("tracking", "relocalised", "lost")}
    lines = [
        f"{frames} frames, {sent} sent, {len(points)} answered ({1 - len(points) / frames:.1%} dropped): "
        + ", ".join(f"{count} {state}" for state, count in states.items()),
        _percentiles("from sending a frame to its pose", [film.latency_ms for film in found]),
    ]
    stages = {stage: [film.timings_ms[stage] for film in found] for stage in found[0].timings_ms}
    lines += [_percentiles(f"server: {stage}", values) for stage, values in stages.items()]
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    lines.append(f"load of the machine {load}; {os.cpu_count()} cores")
    return "\n".join(lines) + "\n"


def _percentiles(name: str, values: Sequence[np.ndarray]) -> str:
    p50, p95 = np.percentile(np.concatenate(values), [50, 95])
    return f"{name:34s} median {p50:7.1f} ms   95 % {p95:7.1f} ms"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("database", type=Path, metavar="DB")
    parser.add_argument("video", metavar="VIDEO")
    parser.add_argument("--camera", metavar="MODEL,WIDTH,HEIGHT,PARAMS...", help="default: estimated")
    parser.add_argument("--clients", type=int, default=1, help="at a time (%(default)s)")
    parser.add_argument("--seconds", type=float, default=40.0, help="of the film (%(default)s)")
    given = parser.parse_args(arguments)
    with serving(given.database, given.clients) as (endpoint, process):
        began, used = time.perf_counter(), cpu_s(process)
        found = measure(endpoint, given.video, given.camera, given.clients, given.seconds)
        cores = (cpu_s(process) - used) / (time.perf_counter() - began)
    sys.stdout.write(report(found) + f"the server took {cores:.2f} cores\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
