"""Serve one database until told to stop."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server

from featuredb.stop_signals import on_stop_signals
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, count_candidates
from reloc.service.contributions.inbox import Inbox
from reloc.service.options import ServeOptions, wire_name_of
from reloc.service.server import Server
from reloc.service.session import ServiceStartError
from reloc.service.source import DatabaseSource
from reloc.wire.server import StatusReply
from reloc.wire.status_metrics import Figures, status_metrics

_TURN_S = 1.0  # of waiting for a signal


@contextmanager
def metrics_page(port: int, status: Callable[[], StatusReply | None]) -> Iterator[int]:
    """Within the block `http://127.0.0.1:PORT/metrics` says what the server's status does; the port.

    Port 0 takes a free one. The status is None while the server does not answer yet.

    Raises:
        ServiceStartError: the port is taken.
    """
    registry = CollectorRegistry()
    registry.register(Figures(lambda: status_metrics(status())))
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


def start_server(database: Database, options: ServeOptions | None = None) -> Server:
    """Load the database's maps and listen; the server runs until `close`.

    Raises:
        ServiceStartError: cannot listen (port taken, bad endpoint, bad configuration), or open to strangers.
        FeatureDbError: the maps cannot be loaded.
    """
    options = options or ServeOptions()
    name = options.name or wire_name_of(database.url)
    inbox = None
    if options.contributions:
        inbox = Inbox(partial(contribute, database), partial(count_candidates, database), options.inbox)
    return Server.start(DatabaseSource(database, options.bbox), options, name, inbox)


def serve(
    database: Database,
    options: ServeOptions | None = None,
    *,
    on_ready: Callable[[Server], None] = lambda server: None,
) -> None:
    """Serve until SIGINT or SIGTERM; queries in hand are answered first. Call from the main thread.

    Raises:
        As `start_server`.
    """
    stop = threading.Event()
    started: list[Server] = []

    def status() -> StatusReply | None:
        return started[0].status() if started else None

    with on_stop_signals(stop.set), ExitStack() as stack:
        if options is not None and options.metrics_port is not None:
            # Before the maps are loaded: that takes long, and the port may be taken.
            stack.enter_context(metrics_page(options.metrics_port, status))
        started.append(stack.enter_context(start_server(database, options)))
        on_ready(started[0])
        # A signal that a library's thread receives does not end a wait: its handler runs at the next.
        while not stop.wait(_TURN_S):
            pass
