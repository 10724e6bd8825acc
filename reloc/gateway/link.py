"""The way to the server: one Zenoh client for all threads, which connects with the first question."""

import threading
import time
from collections.abc import Callable
from typing import TypeVar

from featuredb.errors import ServiceError
from reloc.client import NO_SERVER, Client
from reloc.gateway.options import GatewayOptions

_T = TypeVar("_T")

# After a server was waited for in vain nobody waits so long: a hundred requests would, one after another.
_PAUSE_S = 1.0


class Link:
    """Asks the server, from any thread; Zenoh itself connects again with one that has restarted."""

    def __init__(self, options: GatewayOptions) -> None:
        self._client = Client(
            options.connect,
            options.database,
            config_path=options.config_path,
            connect_timeout_s=options.connect_timeout_s,
        )
        self._finding = threading.Lock()
        self._refusal: tuple[float, ServiceError] | None = None

    def ask(self, question: Callable[[Client], _T]) -> _T:
        """The server's answer. If nobody answers, or not yet, a server is looked for once.

        Raises:
            ServiceError: as of `reloc.client.Client`.
        """
        try:
            return question(self._client)
        except ServiceError as error:
            if error.code != NO_SERVER:
                raise
        self._find()
        return question(self._client)

    def close(self) -> None:
        """Close the session; nobody may ask any more."""
        self._client.close()

    def _find(self) -> None:
        with self._finding:
            if self._refusal is not None and time.monotonic() < self._refusal[0]:
                raise ServiceError(self._refusal[1].code, self._refusal[1].message)
            try:
                self._client.open()
            except ServiceError as error:
                self._refusal = (time.monotonic() + _PAUSE_S, error)
                raise
