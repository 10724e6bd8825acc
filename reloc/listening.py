"""HTTP servers of this process: where they listen, and how they run until they are told to stop."""

import logging
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import uvicorn
from fastapi import FastAPI

from featuredb.errors import FeatureDbError
from featuredb.stop_signals import on_stop_signals

_BACKLOG = 128
_LAST_PORT = 65_535
CLIENT_GONE = 499  # a request whose client has gone (nginx's status): nobody reads it, but counts show it


class ListenError(FeatureDbError):
    """Nothing can listen there."""


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 takes a free one.

    Raises:
        ListenError: the port is taken or none, or the host is not this machine's.
    """
    if not 0 <= port <= _LAST_PORT:
        raise ListenError(f"--port: expected 0 to {_LAST_PORT}, found {port}")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        bound = socket.create_server((host, port), family=family, backlog=_BACKLOG)
        # asyncio does so only for sockets that it makes itself. Without it the body of an answer waits for
        # the acknowledgement of its head: 40 ms on a connection that is kept.
        bound.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return bound
    except OSError as error:
        raise ListenError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; choose a port with --port, 0 takes "
            "a free one, and with --host an address of this machine"
        ) from error


def uvicorn_server(app: FastAPI, **options: Any) -> uvicorn.Server:
    """The server of an application, not yet running; `run(sockets=[...])` runs it. `options`: uvicorn's."""
    logging.getLogger("uvicorn.error").setLevel(logging.WARNING)
    quiet: dict[str, Any] = {"log_config": None, "access_log": False, "server_header": False}
    return uvicorn.Server(uvicorn.Config(app, ws="none", **quiet, **options))


def run(
    server: uvicorn.Server, listening: Callable[[], socket.socket], on_ready: Callable[[str], None]
) -> None:
    """Serve until SIGINT or SIGTERM; call from the main thread. `on_ready` is told the address."""
    # uvicorn handles these while it runs, and then raises them again; one that comes before counts as well.
    with on_stop_signals(partial(setattr, server, "should_exit", True)), listening() as bound:
        host, port = bound.getsockname()[:2]
        on_ready(f"http://{f'[{host}]' if ':' in host else host}:{port}")
        server.run(sockets=[bound])  # until then connections wait in the socket
