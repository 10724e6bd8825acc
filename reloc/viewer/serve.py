"""Run the viewer until told to stop."""

import signal
import sys
import webbrowser
from types import FrameType

from fastapi import FastAPI

from reloc.viewer.server import HOST, listen, uvicorn_server


def serve(app: FastAPI, port: int, *, browser: bool, path: str = "") -> None:
    """Serve until SIGINT or SIGTERM, after printing the address; call from the main thread.

    Args:
        browser: also open the page. path: of the page, below the address.

    Raises:
        ViewerStartError: cannot listen.
    """
    # uvicorn stops in good order on these, and then raises them again for whoever had them before.
    before = {number: signal.signal(number, _stopped) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with listen(port) as bound:
            url = f"http://{HOST}:{bound.getsockname()[1]}/{path}"
            sys.stdout.write(f"{url}; stop with Ctrl-C\n")
            sys.stdout.flush()
            # Connections wait in the socket until the server runs.
            if browser and not webbrowser.open(url):
                sys.stderr.write("no browser was found; open the address by hand\n")
            uvicorn_server(app).run(sockets=[bound])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stopped(number: int, frame: FrameType | None) -> None:
    """The end of the command is no failure of it."""
