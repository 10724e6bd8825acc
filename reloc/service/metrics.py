"""Counts and latencies of a server, and its page for Prometheus."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from reloc.service.session import ServiceStartError
from reloc.wire.server import Latency, QueryCounts, StatusReply
from reloc.wire.status_metrics import status_metrics

_LATENCY_WINDOW = 1000  # latest queries; enough for a 99th percentile, forgets a slow start


@dataclass(slots=True)
class ServerMetrics:
    """Counters that threads share; every method takes the lock."""

    _lock: threading.Lock = field(default_factory=threading.Lock)
    _received: int = 0
    _localised: int = 0
    _not_localised: Counter[str] = field(default_factory=Counter)
    _errors: Counter[str] = field(default_factory=Counter)
    _latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENCY_WINDOW))

    def received(self) -> None:
        with self._lock:
            self._received += 1

    def answered(self, reason: str | None, latency_ms: float) -> None:
        """An answer went out: localised (reason None) or not."""
        with self._lock:
            self._latency_ms.append(latency_ms)
            if reason is None:
                self._localised += 1
            else:
                self._not_localised[reason] += 1

    def failed(self, code: str) -> None:
        """An error went out."""
        with self._lock:
            self._errors[code] += 1

    def counts(self) -> QueryCounts:
        with self._lock:
            return QueryCounts(
                received=self._received,
                localised=self._localised,
                not_localised=dict(sorted(self._not_localised.items())),
                errors=dict(sorted(self._errors.items())),
            )

    def latency(self) -> Latency:
        with self._lock:
            values = np.array(self._latency_ms)
        if not len(values):
            return Latency(count=0, p50=None, p90=None, p99=None, max=None)
        p50, p90, p99 = (round(float(v), 3) for v in np.percentile(values, [50, 90, 99]))
        return Latency(count=len(values), p50=p50, p90=p90, p99=p99, max=round(float(values.max()), 3))


@contextmanager
def metrics_page(port: int, status: Callable[[], StatusReply | None]) -> Iterator[int]:
    """Within the block `http://127.0.0.1:PORT/metrics` says what the server's status does; the port.

    Args:
        port: 0 takes a free one.
        status: None while the server does not answer yet.

    Raises:
        ServiceStartError: the port is taken.
    """
    registry = CollectorRegistry()
    registry.register(_Status(status))
    ProcessCollector(registry=registry)
    try:
        server, thread = start_http_server(port, addr="127.0.0.1", registry=registry)
    except OSError as error:
        raise ServiceStartError(
            f"cannot listen on 127.0.0.1:{port}: {error.strerror or error}; choose another --metrics-port"
        ) from error
    try:
        yield server.server_port
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Status(Collector):
    def __init__(self, status: Callable[[], StatusReply | None]) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        return status_metrics(self._status())
