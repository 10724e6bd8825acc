"""Run the viewer until told to stop."""

import sys
import webbrowser
from functools import partial

from fastapi import FastAPI

from featuredb.stop_signals import on_stop_signals
from reloc.viewer.server import HOST, listen, uvicorn_server


def serve(app: FastAPI, port: int, *, browser: bool, path: str = "") -> None:
    """Serve until SIGINT or SIGTERM, after printing the address; call from the main thread.

    Args:
        browser: also open the page. path: of the page, below the address.

    Raises:
        ViewerStartError: cannot listen.
    """
    server = uvicorn_server(app)
    # uvicorn handles these while it runs, and then raises them again; one that comes before counts as well.
    with on_stop_signals(partial(setattr, server, "should_exit", True)), listen(port) as bound:
        url = f"http://{HOST}:{bound.getsockname()[1]}/{path}"
        sys.stdout.write(f"{url}; stop with Ctrl-C\n")
        sys.stdout.flush()
        # Connections wait in the socket until the server runs.
        if browser and not webbrowser.open(url):
            sys.stderr.write("no browser was found; open the address by hand\n")
        server.run(sockets=[bound])
