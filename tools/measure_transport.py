"""How long Zenoh takes for one query: client's wall time less the server's own, over loopback.

Run: python tools/measure_transport.py [--kilobytes 500] [--queries 50]

The server does everything but localise: it receives, queues, decodes and answers with a reply of usual
length. Prints the median, the 90th percentile and the largest, in milliseconds.
"""

import argparse
import io
import sys
import time
from collections.abc import Sequence

import numpy as np
from PIL import Image

from reloc.client import Client
from reloc.options import LocaliseOptions
from reloc.result import LocaliseRequest, LocaliseResult
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.source import ServedArea


class NoMaps:
    """Answers every query at once."""

    snapshot = 0
    areas = ()
    options = LocaliseOptions()

    def localise(self, gray: np.ndarray, request: LocaliseRequest) -> LocaliseResult:
        return LocaliseResult(
            reason="NO_COVERAGE",
            detail="",
            pose=None,
            confidence=0.0,
            features=0,
            matches=0,
            inliers=0,
            runner_up=None,
            snapshot=0,
        )


class NoMapsSource:
    """A source that never changes."""

    def version(self) -> int:
        return 0

    def load(self) -> ServedArea:
        return ServedArea(localiser=NoMaps(), maps=())


def noise_jpeg(kilobytes: int) -> bytes:
    """A 1600x1067 JPEG of about so many bytes: noise at the quality that gives them."""
    rng = np.random.default_rng(0)
    coarse = Image.fromarray(rng.integers(0, 256, (534, 800), dtype=np.uint8)).resize((1600, 1067))
    best = b""
    for quality in range(5, 100, 5):
        out = io.BytesIO()
        coarse.save(out, "JPEG", quality=quality)
        if not best or abs(out.tell() - 1000 * kilobytes) < abs(len(best) - 1000 * kilobytes):
            best = out.getvalue()
    return best


def measure(data: bytes, queries: int) -> tuple[np.ndarray, np.ndarray]:
    """Transport and decoding of each query, milliseconds, (queries,) each."""
    transport, decoding = [], []
    options = ServeOptions(listen=("tcp/127.0.0.1:0",))
    with (
        Server.start(NoMapsSource(), options, "transport") as server,
        Client(server.endpoints[0], server.database) as client,
    ):
        for _ in range(queries):
            start = time.perf_counter()
            reply = client.localise(data)
            wall_ms = (time.perf_counter() - start) * 1e3
            transport.append(wall_ms - reply.timings_ms["total"])
            decoding.append(reply.timings_ms["decode"])
    return np.array(transport), np.array(decoding)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kilobytes", type=int, default=500)
    parser.add_argument("--queries", type=int, default=50)
    args = parser.parse_args(argv)
    data = noise_jpeg(args.kilobytes)
    transport, decoding = measure(data, args.queries)
    sys.stdout.write(
        f"{len(data) / 1000:.0f} kB JPEG of 1600x1067, {args.queries} queries over loopback TCP\n"
    )
    for name, values in (("transport", transport), ("decode", decoding)):
        p50, p90 = np.percentile(values, [50, 90])
        sys.stdout.write(f"{name:10s} median {p50:6.2f}  p90 {p90:6.2f}  max {values.max():6.2f} ms\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
