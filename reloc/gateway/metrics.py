"""Counts and durations of the gateway, and the figures of its server, for Prometheus."""

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4 as MEDIA_TYPE
from prometheus_client.registry import Collector

from reloc.wire.server import StatusReply
from reloc.wire.status_metrics import status_metrics

__all__ = ["MEDIA_TYPE", "GatewayMetrics"]

_NAME = "featuredb_gateway_"
# A query takes 0.2 s and at most the timeout of 10 s; health and maps take milliseconds.
_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


class GatewayMetrics:
    """Counters that threads share."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            f"{_NAME}requests", "HTTP requests answered.", ("route", "status"), registry=self._registry
        )
        self._seconds = Histogram(
            f"{_NAME}request_seconds",
            "Time to the answer.",
            ("route",),
            buckets=_BUCKETS_S,
            registry=self._registry,
        )

    def observe(self, route: str, status: int, seconds: float) -> None:
        """A request was answered."""
        self._requests.labels(route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def text(self, in_flight: int, sessions: int, server: StatusReply | None) -> bytes:
        """The whole page; `server` is what the server says of itself, None if it does not answer."""
        moment = CollectorRegistry()
        moment.register(_Moment(in_flight, sessions, server))
        return generate_latest(self._registry) + generate_latest(moment)


class _Moment(Collector):
    """What is so when the page is asked for."""

    def __init__(self, in_flight: int, sessions: int, server: StatusReply | None) -> None:
        self._in_flight, self._sessions, self._server = in_flight, sessions, server

    def collect(self) -> Iterator[Metric]:
        yield GaugeMetricFamily(f"{_NAME}in_flight", "Photos in hand.", value=self._in_flight)
        yield CounterMetricFamily(f"{_NAME}sessions", "Zenoh sessions opened.", value=self._sessions)
        yield from status_metrics(self._server)
