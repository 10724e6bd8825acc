"""Hot reload: watch the store, load newer areas beside the running one, hand them over."""

import logging
import threading
from collections.abc import Callable

from reloc.service.logs import fields
from reloc.service.source import DatabaseSource, ServedArea

logger = logging.getLogger(__name__)

_MAX_RETRY_S = 60.0  # a broken snapshot is tried again, ever less often up to this


class AreaWatcher:
    """Polls a source in a thread; a load that fails leaves everything as it is and is tried again."""

    def __init__(
        self,
        source: DatabaseSource,
        *,
        served_version: int,
        poll_interval_s: float,
        on_area: Callable[[ServedArea], None],
        on_failure: Callable[[int, str], None],
    ) -> None:
        self._source = source
        self._served = served_version
        self._interval_s = poll_interval_s
        self._on_area = on_area
        self._on_failure = on_failure
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="area-watcher", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self, timeout_s: float) -> None:
        """Stop; a load in progress is waited for at most `timeout_s`."""
        self._stop.set()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        wait_s = self._interval_s
        while not self._stop.wait(wait_s):
            wait_s = self._interval_s if self._poll() else min(2 * wait_s, _MAX_RETRY_S)

    def _poll(self) -> bool:
        """One look at the source; False when it failed."""
        version = self._served
        try:
            version = self._source.version()
            if version == self._served:
                return True
            area = self._source.load()
            if self._stop.is_set():
                return True
            self._on_area(area)
            self._served = area.snapshot
        except Exception as error:
            # A store may break in many ways; the area in service is whole and stays.
            told = fields("reload_failed", snapshot=version)
            logger.exception("reload failed; the running snapshot stays in service", extra=told)
            self._on_failure(version, f"{type(error).__name__}: {error}")
            return False
        return True
