"""Run the gateway until told to stop."""

import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from reloc import listening
from reloc.configuration import read_configuration
from reloc.gateway.app import create_app
from reloc.gateway.options import GatewayOptions
from reloc.wire.keys import is_loopback

# Connections, idle ones with them; who needs more stands behind a proxy that holds them.
_MAX_CONNECTIONS = 512
_KEEP_ALIVE_S = 10
_LOOK_S = 1.0  # at each connection


class _TimedHeads(H11Protocol):
    """Closes connections that have no request in hand for too long, also where its head comes byte by byte.

    uvicorn's own timeout begins after an answer and ends with any byte.
    """

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._idle_since = self.loop.time()
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._idle_since = self.loop.time()

    def _look(self) -> None:
        if self.transport.is_closing():
            return
        idle = self.cycle is None or self.cycle.response_complete
        if idle and self.loop.time() >= self._idle_since + self.timeout_keep_alive:
            self.transport.close()
        else:
            self.loop.call_later(_LOOK_S, self._look)


def listen(options: GatewayOptions) -> socket.socket:
    """A listening socket.

    Raises:
        ListenError: as `reloc.listening.listen`, or other machines reach it and `insecure` is not set.
    """
    if not (options.insecure or is_loopback(options.host)):
        raise listening.ListenError(
            f"{options.host} can be reached by other machines, and the gateway speaks no TLS and checks "
            "nobody; let it listen on 127.0.0.1 behind a proxy that does, or say --insecure"
        )
    return listening.listen(options.host, options.port)


def uvicorn_server(options: GatewayOptions) -> uvicorn.Server:
    """The server of the application, not yet running; `run(sockets=[listen(options)])` runs it."""
    return listening.uvicorn_server(
        create_app(options),
        # Who sends too much is answered at once; this one then reads on and throws away until the
        # keep-alive is over, so that the answer is not lost by a reset.
        http=_TimedHeads,
        lifespan="on",
        limit_concurrency=_MAX_CONNECTIONS,
        timeout_keep_alive=_KEEP_ALIVE_S,
        # What is in hand is answered first, and it takes no longer than this.
        timeout_graceful_shutdown=int(options.timeout_s) + 1,
    )


def serve(options: GatewayOptions, on_ready: Callable[[str], None] = lambda url: None) -> None:
    """Serve until SIGINT or SIGTERM; call from the main thread.

    Raises:
        ListenError: cannot listen. InvalidValueError: the configuration cannot be read.
    """
    if options.config_path is not None:
        read_configuration(options.config_path)  # each question would be answered by its error
    listening.run(
        uvicorn_server(options), partial(listen, options), lambda url: on_ready(url + options.prefix)
    )
