"""Counts and durations of the gateway in Prometheus' text format, version 0.0.4."""

import threading
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable

from reloc.wire.server import StatusReply

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"

# A query takes 0.2 s and at most the timeout of 10 s; health and maps take milliseconds.
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


class GatewayMetrics:
    """Counters that threads share."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: Counter[tuple[str, int]] = Counter()
        self._buckets: dict[str, list[int]] = {}
        self._seconds: Counter[str] = Counter()

    def observe(self, route: str, status: int, seconds: float) -> None:
        """A request was answered."""
        with self._lock:
            self._requests[route, status] += 1
            self._seconds[route] += seconds  # type: ignore[assignment]  # a Counter adds floats as well
            counts = self._buckets.setdefault(route, [0] * (len(_BUCKETS_S) + 1))
            counts[bisect_left(_BUCKETS_S, seconds)] += 1

    def text(self, in_flight: int, sessions: int, server: StatusReply | None) -> str:
        """The whole page; `server` is what the server says of itself, None if it does not answer."""
        with self._lock:
            requests = sorted(self._requests.items())
            buckets = {route: list(counts) for route, counts in sorted(self._buckets.items())}
            seconds = dict(self._seconds)
        lines = _block(
            "featuredb_gateway_requests_total",
            "counter",
            "HTTP requests answered.",
            ((f'{{route="{route}",status="{status}"}}', count) for (route, status), count in requests),
        )
        lines += _block("featuredb_gateway_request_seconds", "histogram", "Time to the answer.", ())
        for route, counts in buckets.items():
            lines += _histogram(route, counts, seconds[route])
        lines += _block("featuredb_gateway_in_flight", "gauge", "Photos in hand.", (("", in_flight),))
        lines += _block(
            "featuredb_gateway_sessions_total", "counter", "Zenoh sessions opened.", (("", sessions),)
        )
        lines += _block(
            "featuredb_server_up", "gauge", "1 if a server answers.", (("", int(server is not None)),)
        )
        if server is not None:
            lines += _server(server)
        return "\n".join(lines) + "\n"


def _histogram(route: str, counts: list[int], seconds: float) -> list[str]:
    name, total, lines = "featuredb_gateway_request_seconds", 0, []
    for bound, count in zip((*map(str, _BUCKETS_S), "+Inf"), counts, strict=True):
        total += count
        lines.append(f'{name}_bucket{{route="{route}",le="{bound}"}} {total}')
    return [
        *lines,
        f'{name}_sum{{route="{route}"}} {seconds:.6f}',
        f'{name}_count{{route="{route}"}} {total}',
    ]


def _server(status: StatusReply) -> list[str]:
    queries = status.queries
    outcomes = [
        ('{outcome="localised",code=""}', queries.localised),
        *((f'{{outcome="not_localised",code="{_label(c)}"}}', n) for c, n in queries.not_localised.items()),
        *((f'{{outcome="error",code="{_label(c)}"}}', n) for c, n in queries.errors.items()),
    ]
    return [
        *_block("featuredb_server_queries_total", "counter", "Queries by what became of them.", outcomes),
        *_block("featuredb_server_queue_length", "gauge", "Queries that wait.", (("", status.queue.length),)),
        *_block("featuredb_server_workers_busy", "gauge", "Queries in work.", (("", status.queue.busy),)),
        *_block("featuredb_server_maps", "gauge", "Maps that answer.", (("", status.maps),)),
        *_block("featuredb_server_snapshot", "gauge", "Version served.", (("", status.snapshot),)),
        *_block("featuredb_server_uptime_seconds", "gauge", "Since its start.", (("", status.uptime_s),)),
    ]


def _block(name: str, kind: str, told: str, samples: Iterable[tuple[str, float]]) -> list[str]:
    return [
        f"# HELP {name} {told}",
        f"# TYPE {name} {kind}",
        *(f"{name}{labels} {value}" for labels, value in samples),
    ]


def _label(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
