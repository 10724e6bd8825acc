"""A server's page for Prometheus."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
from prometheus_client.core import Metric
from prometheus_client.registry import Collector

from reloc.service.session import ServiceStartError
from reloc.wire.server import StatusReply
from reloc.wire.status_metrics import status_metrics


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
