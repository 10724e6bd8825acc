"""A proxy in front of an S3 server, in a process of its own, that fails as networks and busy stores do.

python -m tests.support.s3_faults PORT PORT_OF_THE_SERVER
"""

import http.client
import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from tests.support.s3_server import daemon, free_port, wait_for

CLIENT_TIMEOUT_S, RETRIES = 1.0, 2
RETRIED = 1 + RETRIES  # requests that a client makes before it gives up
# A client that gives up soon: so that an outage ends an operation within seconds.
IMPATIENT = {
    "AWS_REQUEST_TIMEOUT": f"{CLIENT_TIMEOUT_S:.0f}s",
    "timeout": f"{CLIENT_TIMEOUT_S:.0f}s",
    "max_retries": str(RETRIES),
    "backoff_config.init_backoff": "1ms",
    "backoff_config.max_backoff": "5ms",
}

# What is done to a request. Those of LOST have done their work when the client hears of a failure.
REFUSED = ("500", "503", "cut", "silent")
LOST = ("lost 500", "lost answer", "lost time", "torn answer")
KINDS = (*REFUSED, *LOST)
SLOW = ("silent", "lost time")  # the client waits
_WRITES = ("PUT", "POST", "DELETE")
_PLAN = "/_plan"
_ERROR = "<?xml version='1.0'?><Error><Code>{}</Code><Message>a fault of the test</Message></Error>"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """What happens to the requests `first` to `first + count - 1`.

    writes: of those that write; else of all. path: of those that have this in their path.
    """

    kind: str
    first: int = 0
    count: int
    writes: bool = True
    path: str = ""


class FaultyStore:
    """A server with such a proxy before it. `options`: by which deltalake reaches it."""

    def __init__(self, options: dict[str, str], port: int) -> None:
        self._port = port
        self.options = {**options, **IMPATIENT, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}"}

    @contextmanager
    def failing(self, fault: Fault | None) -> Iterator[None]:
        """Requests meet the fault inside of the block."""
        self._plan(fault)
        try:
            yield
        finally:
            self._plan(None)

    def _plan(self, fault: Fault | None) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._port)
        connection.request("PUT", _PLAN, json.dumps(asdict(fault) if fault else None))
        self.injected = int(connection.getresponse().read())
        connection.close()


@contextmanager
def faulty_store(options: dict[str, str]) -> Iterator[FaultyStore]:
    """A proxy before the server that these storage options name."""
    port, server = free_port(), urlsplit(options["AWS_ENDPOINT_URL"]).port
    with daemon(sys.executable, "-m", "tests.support.s3_faults", str(port), str(server)):
        wait_for(port)
        yield FaultyStore(options, port)


class _Plan:
    """The fault that is planned, and how many requests have met it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._fault: Fault | None = None
        self._requests = self._injected = 0

    def set(self, fault: Fault | None) -> int:
        """Returns how many requests met the one before."""
        with self._lock:
            injected = self._injected
            self._fault, self._requests, self._injected = fault, 0, 0
            return injected

    def next(self, method: str, path: str) -> str:
        """What happens to the next request, "" for nothing."""
        with self._lock:
            fault = self._fault
            if fault is None or (fault.writes and method not in _WRITES) or fault.path not in path:
                return ""
            number = self._requests - fault.first
            self._requests += 1
            met = 0 <= number < fault.count
            self._injected += met
            return fault.kind if met else ""


class _Proxy(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else each answer waits 40 ms
    plan = _Plan()
    server_port = 0

    def handle_request(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if self.path == _PLAN:
            planned = json.loads(body)
            injected = self.plan.set(Fault(**planned) if planned else None)
            return self._answer(200, [], str(injected).encode())
        kind = self.plan.next(self.command, self.path)
        status, headers, content = self._forward(body) if kind not in REFUSED else (0, [], b"")
        if kind in SLOW:
            time.sleep(CLIENT_TIMEOUT_S * 1.5)
        if kind in ("500", "lost 500"):
            return self._answer(500, [], _ERROR.format("InternalError").encode())
        if kind == "503":
            return self._answer(503, [], _ERROR.format("SlowDown").encode())
        if kind == "torn answer" and content and self.command != "HEAD":
            self._answer(status, headers, content, sent=len(content) // 2)
        elif not kind:
            return self._answer(status, headers, content)
        self.close_connection = True
        self.connection.shutdown(socket.SHUT_RDWR)
        return None

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = handle_request  # noqa: N815

    def _forward(self, body: bytes) -> tuple[int, list[tuple[str, str]], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.server_port)
        connection.request(self.command, self.path, body, dict(self.headers.items()))
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, answer.getheaders(), content

    def _answer(
        self, status: int, headers: list[tuple[str, str]], content: bytes, sent: int | None = None
    ) -> None:
        self.send_response_only(status)
        for name, value in headers:
            if name.lower() not in ("connection", "transfer-encoding", "content-length"):
                self.send_header(name, value)
        length = {n.lower(): v for n, v in headers}.get("content-length", str(len(content)))
        self.send_header("Content-Length", length if self.command == "HEAD" else str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content[:sent])
            self.wfile.flush()

    def log_message(self, format: str, *args: Any) -> None:
        pass


def main(port: str, server_port: str) -> None:
    _Proxy.server_port = int(server_port)
    ThreadingHTTPServer(("127.0.0.1", int(port)), _Proxy).serve_forever()


if __name__ == "__main__":
    main(*sys.argv[1:])
