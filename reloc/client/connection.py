"""How a client finds the servers of a database."""

import json
import time

import zenoh

from featuredb.errors import ServiceError
from reloc.client.replies import NO_SERVER
from reloc.wire.keys import ANONYMOUS, CLIENT_SETTING, Keys

_ASK_AGAIN_S = 0.05  # while no server is there yet


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
