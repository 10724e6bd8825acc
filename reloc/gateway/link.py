"""The way to the server: one Zenoh session for all threads, opened when needed and again when it is dead."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from featuredb.errors import ServiceError
from reloc.client import NO_SERVER, Client
from reloc.gateway.options import GatewayOptions

_T = TypeVar("_T")

# After a failed connection so long nobody tries again: a hundred requests do not wait one after another.
_PAUSE_S = 1.0


@dataclass(slots=True, eq=False)
class _Line:
    """An open client, how many threads use it, and whether it is given up."""

    client: Client
    users: int = 0
    retired: bool = False


class Link:
    """Asks the server, from any thread; a server that restarts is found again without a restart of ours."""

    def __init__(self, options: GatewayOptions) -> None:
        self._options = options
        self._lock = threading.Lock()  # of the fields below; held for moments
        self._opening = threading.Lock()  # of the one that connects
        self._line: _Line | None = None
        self._refusal: tuple[float, ServiceError] | None = None
        self._closed = False
        self.sessions = 0

    def ask(self, question: Callable[[Client], _T]) -> _T:
        """The server's answer. If nobody answers any more, a new session is tried once.

        Raises:
            ServiceError: as of `reloc.client.Client`.
        """
        try:
            return self._asked(question)
        except ServiceError as error:
            if error.code != NO_SERVER or self._refused() is not None:
                raise
        return self._asked(question)

    def close(self) -> None:
        """Close the session when its last user is done."""
        with self._lock:
            self._closed = True
            line = self._line
        if line is not None:
            self._retire(line)

    def _asked(self, question: Callable[[Client], _T]) -> _T:
        line = self._take()
        try:
            return question(line.client)
        except ServiceError as error:
            if error.code == NO_SERVER:
                self._retire(line)
            raise
        finally:
            with self._lock:
                line.users -= 1
                last = line.retired and line.users == 0
            if last:
                line.client.close()

    def _take(self) -> _Line:
        with self._opening:
            with self._lock:
                if self._line is not None:
                    self._line.users += 1
                    return self._line
                if self._closed:
                    raise ServiceError(NO_SERVER, "the gateway is stopping")
            refusal = self._refused()
            if refusal is not None:
                raise ServiceError(refusal.code, refusal.message)
            client = Client(
                self._options.connect,
                self._options.database,
                config_path=self._options.config_path,
                connect_timeout_s=self._options.connect_timeout_s,
            )
            try:
                client.open()
            except ServiceError as error:
                with self._lock:
                    self._refusal = (time.monotonic() + _PAUSE_S, error)
                raise
            with self._lock:
                self._refusal = None
                self._line = _Line(client, users=1)
                self.sessions += 1
                return self._line

    def _refused(self) -> ServiceError | None:
        """The failure to connect that still counts."""
        with self._lock:
            if self._refusal is not None and time.monotonic() < self._refusal[0]:
                return self._refusal[1]
            return None

    def _retire(self, line: _Line) -> None:
        """Nobody takes it any more; whoever uses it last closes it."""
        with self._lock:
            line.retired = True
            if self._line is line:
                self._line = None
            idle = line.users == 0
        if idle:
            line.client.close()
