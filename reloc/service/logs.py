"""Structured logs: one JSON object per line."""

import json
import logging
from datetime import UTC, datetime
from typing import Any, TextIO


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
