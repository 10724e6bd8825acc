"""How long one query takes.

Each image with its own GPS as prior, decoded, localised and answered in this process, and then the same over
Zenoh on loopback; medians over images and repeats. Transport is the client's wall time less the server's own.
Beside it, between the same queries: OpenCV's SIFT alone (3,000 features of the photo at 1000 px), and its
decoding in grey. A query without its decoding is compared with the one, its decoding with the other.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import median

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from featuredb.features.shrink import shrunk
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from reloc.client import Client, LocaliseReply
from reloc.localiser import Localiser
from reloc.service.handler import answer_query
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from reloc.wire.query import LocaliseWireRequest, RequestOptions
from tools.figures import study_parser, write_figures

_REPEAT, _THREADS = 5, 2
_SIDE_PX, _FEATURES = 1000, 3000
_WITH_PRIOR = LocaliseWireRequest(options=RequestOptions(exif_prior=True))


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("db")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE")
    args = parser.parse_args()
    database = Database.open(args.db)
    cv2.setNumThreads(_THREADS)
    threadpool_limits(_THREADS)
    localiser = Localiser.open(database)
    direct = timed(lambda data: answer_query(_WITH_PRIOR, data, localiser), args.images)
    options = ServeOptions(listen=("tcp/127.0.0.1:0",), threads_per_worker=_THREADS)
    with start_server(database, options) as server, Client(server.endpoints[0]) as client:
        ask = partial(client.localise, exif_prior=True, timeout_s=60.0)
        served = timed(ask, args.images)
    figures = {name: median(one[name] for one in served) for name in served[0]}
    figures |= {"asked": len(served), "localised": sum(one["localised"] for one in served)}
    write_figures(args.json, figures | {"in_process_ms": median(one["wall_ms"] for one in direct)})


def timed(ask: Callable[[bytes], LocaliseReply], images: Sequence[Path]) -> list[dict[str, float]]:
    """Each image five times, after one round that is not counted: times measured from outside, and beside
    those of OpenCV with the same photo, right after it."""
    found = []
    contents = [path.read_bytes() for path in images]
    for data in contents * (_REPEAT + 1):
        start = time.perf_counter()
        reply = ask(data)
        wall_ms = 1e3 * (time.perf_counter() - start)
        opencv, decode_ms = opencv_ms(data), reply.timings_ms["decode"]
        times = {
            "wall_ms": wall_ms,
            "transport_ms": wall_ms - reply.timings_ms["total"],
            "sift_ms": opencv["sift"],
            "over_sift": (wall_ms - decode_ms) / opencv["sift"],
            "over_decode": decode_ms / opencv["decode"],
            "localised": reply.status == "localised",
        }
        found.append(times)
    return found[len(contents) :]


def opencv_ms(data: bytes) -> dict[str, float]:
    """Milliseconds of OpenCV's decoding in grey, and of its SIFT with 3,000 features at 1000 px."""
    clock = StageClock()
    gray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    clock.lap("decode")
    small = shrunk(np.asarray(gray, dtype=np.uint8), _SIDE_PX)
    clock.lap("shrink")
    cv2.SIFT_create(_FEATURES).detectAndCompute(small, None)
    clock.lap("sift")
    return clock.milliseconds()


if __name__ == "__main__":
    main()
