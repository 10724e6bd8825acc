"""HAProxy as `deploy/haproxy.cfg` sets it up, before a server on this machine."""

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

CONFIG = Path(__file__).parents[1] / "deploy/haproxy.cfg"
_START_S = 10.0


@contextmanager
def proxied(port: int, behind: int) -> Iterator[None]:
    """Within the block who connects to `port` comes to the server at `behind`, both of 127.0.0.1.

    Raises RuntimeError: HAProxy is not installed, or does not start.
    """
    if shutil.which("haproxy") is None:
        raise RuntimeError("haproxy is not installed; expected it as by apt-get install haproxy")
    env = {"FEATUREDB_BIND": f"127.0.0.1:{port}", "FEATUREDB_SERVER": f"127.0.0.1:{behind}"}
    process = subprocess.Popen(["haproxy", "-q", "-db", "-f", str(CONFIG)], env={**os.environ, **env})
    try:
        _wait_for(process, port)
        yield
    finally:
        process.terminate()
        process.wait()


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    end = time.monotonic() + _START_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError as error:
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"haproxy does not listen on 127.0.0.1:{port}") from error
            time.sleep(0.05)
        else:
            return
