"""What a server sends, read: messages, errors, and the codes that the client gives itself."""

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from featuredb.errors import ServiceError
from reloc.wire.query import ErrorReply

_Message = TypeVar("_Message", bound=BaseModel)

# Codes that no server sends; the client raises them itself.
NO_SERVER = "NO_SERVER"
TIMEOUT = "TIMEOUT"
BAD_REPLY = "BAD_REPLY"


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


def service_error(payload: bytes, timeout_s: float) -> ServiceError:
    """The error of a `reply_err`."""
    try:
        error = ErrorReply.model_validate_json(payload)
    except ValidationError:  # not of the server: Zenoh itself gave up
        if payload == b"Timeout":
            return ServiceError(TIMEOUT, f"no answer within {timeout_s:g} s")
        return ServiceError(BAD_REPLY, f"expected an error as JSON, found {payload[:200]!r}")
    return ServiceError(error.code, error.message, error.request_id)
