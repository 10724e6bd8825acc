"""What a server sends, read: messages, errors, and the codes that the client gives itself."""

from typing import Any, TypeVar

import zenoh
from pydantic import BaseModel, ValidationError

from featuredb.errors import ServiceError
from reloc.wire.query import ErrorReply

_Message = TypeVar("_Message", bound=BaseModel)

# Codes that no server sends; the client raises them itself.
NO_SERVER = "NO_SERVER"
TIMEOUT = "TIMEOUT"
BAD_REPLY = "BAD_REPLY"


def first_reply(
    session: zenoh.Session, key: str, model: type[_Message], timeout_s: float, **query: Any
) -> _Message | None:
    """The first answer to a query, or None where nobody answers; `query`: what else `session.get` is told.

    Raises:
        ServiceError: the answer is an error, or none.
    """
    source = zenoh.SourceInfo(session.id, 0)  # one client among others
    for reply in session.get(key, timeout=timeout_s, source_info=source, **query):
        if reply.ok is not None:
            return read_message(reply.ok.payload.to_bytes(), model)
        if reply.err is not None:
            raise _service_error(reply.err.payload.to_bytes(), timeout_s)
    return None


def read_message(payload: bytes, model: type[_Message]) -> _Message:
    """A message of the server.

    Raises:
        ServiceError: BAD_REPLY, it is none.
    """
    try:
        return model.model_validate_json(payload)
    except ValidationError as error:
        raise ServiceError(
            BAD_REPLY, f"expected a {model.__name__}, found {payload[:200]!r}: {error}"
        ) from error


def _service_error(payload: bytes, timeout_s: float) -> ServiceError:
    """The error of a `reply_err`."""
    try:
        error = ErrorReply.model_validate_json(payload)
    except ValidationError:  # not of the server: Zenoh itself gave up
        if payload == b"Timeout":
            return ServiceError(TIMEOUT, f"no answer within {timeout_s:g} s")
        return ServiceError(BAD_REPLY, f"expected an error as JSON, found {payload[:200]!r}")
    return ServiceError(error.code, error.message, error.request_id)
