"""How a client finds the servers of a database, and what they send, read."""

import json
import time
from typing import Any, TypeVar

import zenoh
from pydantic import BaseModel, ValidationError

from featuredb.errors import ServiceError
from reloc.wire.keys import ANONYMOUS, CLIENT_SETTING, Keys
from reloc.wire.query import ErrorReply

_ASK_AGAIN_S = 0.05  # while no server is there yet
_Message = TypeVar("_Message", bound=BaseModel)
# Codes that no server sends; the client raises them itself.
NO_SERVER = "NO_SERVER"
TIMEOUT = "TIMEOUT"
BAD_REPLY = "BAD_REPLY"


def client_config(endpoint: str, timeout_s: float) -> zenoh.Config:
    """The Zenoh configuration of a client of this endpoint alone; raises ZError where it is none."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/timeout_ms", json.dumps(int(timeout_s * 1e3)))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    return config


def name_in(config: zenoh.Config) -> str:
    """What a configuration calls its client."""
    metadata = json.loads(config.get_json("metadata"))
    return str(metadata.get(CLIENT_SETTING, ANONYMOUS)) if isinstance(metadata, dict) else ANONYMOUS


def wait_for_database(session: zenoh.Session, database: str | None, where: str, timeout_s: float) -> str:
    """The database's name, once the liveliness token of one of its servers is there.

    Asks again and again instead of subscribing: a Zenoh 1.10 session that had a liveliness subscriber and
    gave it up gets incomplete answers to later liveliness queries now and then.
    """
    pattern = Keys(database=database or "*").server_token("*")
    end = time.perf_counter() + timeout_s
    while True:
        left_s = max(0.1, end - time.perf_counter())
        replies = session.liveliness().get(pattern, timeout=left_s)
        found = {str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None}
        if found or time.perf_counter() >= end:
            break
        time.sleep(_ASK_AGAIN_S)
    if not found:
        named = "" if database is None else f" of database {database!r}"
        raise ServiceError(
            NO_SERVER,
            f"no server{named} answers at {where} within {timeout_s:g} s, or none that lets this client in",
        )
    if len(found) > 1:
        raise ServiceError(NO_SERVER, f"{where} serves {', '.join(sorted(found))}; name the database to ask")
    return found.pop()


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
    """A message of the server. Raises ServiceError: BAD_REPLY, it is none."""
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
