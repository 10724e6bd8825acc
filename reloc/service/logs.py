"""What a server writes down: events counted, with how long the latest took, and logs of JSON lines."""

import json
import logging
import threading
from collections import Counter, deque
from datetime import UTC, datetime
from typing import Any, TextIO

import numpy as np

_LATEST = 1000  # enough for a 99th percentile, forgets a slow start; half a minute of one live session


class Tally:
    """Events by kind and code; threads share it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()
        self._latency_ms: deque[float] = deque(maxlen=_LATEST)

    def add(self, kind: str, code: str = "", latency_ms: float | None = None) -> None:
        """One more event, and how long it took."""
        with self._lock:
            self._counts[kind, code] += 1
            if latency_ms is not None:
                self._latency_ms.append(latency_ms)

    def count(self, kind: str) -> int:
        """Events of a kind, of whatever code."""
        return sum(self.by_code(kind).values())

    def by_code(self, kind: str) -> dict[str, int]:
        """Events of a kind by their code, sorted."""
        with self._lock:
            return {code: n for (of, code), n in sorted(self._counts.items()) if of == kind}

    def latency(self, *percents: int) -> dict[str, Any]:
        """`count`, percentiles such as `p50`, and `max` of the latest 1000, milliseconds; None before any."""
        with self._lock:
            values = np.array(self._latency_ms)
        names = [*(f"p{percent}" for percent in percents), "max"]
        if not len(values):
            return {"count": 0, **dict.fromkeys(names)}
        found = [*np.percentile(values, percents), values.max()]
        return {"count": len(values)} | {n: round(float(v), 3) for n, v in zip(names, found, strict=True)}


class JsonLinesFormatter(logging.Formatter):
    """time, level, logger, message, and the `fields` that a record carries (event, request_id ...)."""

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        more = getattr(record, "fields", None)
        if isinstance(more, dict):
            line.update({name: value for name, value in more.items() if name not in line})
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log_to(stream: TextIO) -> None:
    """Write the service's logs to a stream; for the program's entry, not for library code."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLinesFormatter())
    for name in ("reloc", "featuredb"):
        logger = logging.getLogger(name)
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        logger.propagate = False  # or each line comes a second time, in the program's own format


def fields(event: str, **values: object) -> dict[str, object]:
    """What a line has besides its message, as `extra` of a logger's method."""
    return {"fields": {"event": event, **values}}
