"""Zenoh sessions of the service."""

import json
import logging
import re
import socket
from pathlib import Path
from typing import Any

import zenoh
from pydantic import BaseModel

from featuredb.errors import FeatureDbError
from reloc.configuration import first_sentence, read_configuration
from reloc.service.logs import fields
from reloc.wire.keys import DEFAULT_ENDPOINT, is_loopback
from reloc.wire.query import encode

logger = logging.getLogger(__name__)

JSON = zenoh.Encoding.APPLICATION_JSON

_THIS_MACHINE = ("unixsock-stream", "unixpipe")


class ServiceStartError(FeatureDbError):
    """The server cannot start: port taken, bad endpoint, bad configuration."""


def server_config(
    listen: tuple[str, ...], connect: tuple[str, ...], config_path: Path | None, max_message_bytes: int
) -> zenoh.Config:
    """The Zenoh configuration of a server; one that connects listens only where `listen` says so.

    Raises:
        InvalidValueError: the file cannot be read.
    """
    config = zenoh.Config() if config_path is None else read_configuration(config_path)
    if config_path is None:
        config.insert_json5("mode", '"peer"')
        # Without a configuration file the server is where it says it is and searches for nobody.
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        # Over loopback shared memory saves 0.3 ms of a 500 kB query and leaves files behind a kill -9.
        config.insert_json5("transport/shared_memory/enabled", "false")
        # A fragmented message is gathered in memory before anybody sees its length.
        config.insert_json5("transport/link/rx/max_message_size", str(max_message_bytes))
    if connect:
        config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    if listen or connect:
        config.insert_json5("listen/endpoints", json.dumps(list(listen)))
    return config


def open_server_session(config: zenoh.Config, where: str) -> zenoh.Session:
    """A Zenoh session that listens.

    Raises:
        ServiceStartError: an endpoint cannot be listened on, or the configuration is none.
    """
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        hint = "is another server running there? Choose another port with --listen tcp/HOST:PORT"
        if "in use" not in str(error):
            hint = f"expected endpoints like {DEFAULT_ENDPOINT}"
        raise ServiceStartError(f"cannot listen on {where}: {first_sentence(error)}; {hint}") from error


def publish(
    session: zenoh.Session, key: str, message: BaseModel, congestion: zenoh.CongestionControl
) -> None:
    """Publish a message; one that cannot be is logged, since nobody's answer hangs on it."""
    try:
        session.put(key, encode(message), encoding=JSON, congestion_control=congestion, express=True)
    except zenoh.ZError:
        logger.warning("not published", exc_info=True, extra=fields("publish_failed", key=key))


def bind_free_port(endpoint: str) -> str:
    """`endpoint` with port 0 replaced by a free one, so that the server can say where it is."""
    match = re.fullmatch(r"((?:tcp|tls)/(.+)):0", endpoint)
    if match is None:
        return endpoint
    host = match[2].strip("[]")
    try:
        with socket.create_server(
            (host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        ) as probe:
            return f"{match[1]}:{probe.getsockname()[1]}"
    except OSError as error:
        raise ServiceStartError(
            f"cannot listen on {endpoint}: {error}; expected endpoints like {DEFAULT_ENDPOINT}"
        ) from error


def check_exposure(config: zenoh.Config) -> None:
    """Refuse what lets strangers in.

    Raises:
        ServiceStartError: the server can be reached from beyond this machine, and not only by clients that
            are authenticated over TLS and bound by rules.
    """
    guarded, mode = authenticates(config), _get(config, "mode") or "peer"
    exposed = [
        e for e in _endpoints(config, "listen", mode) if not (guarded and _is_tls(e)) and not _is_local(e)
    ]
    # Where the server only connects, the rules are those of the router there.
    exposed += [e for e in _endpoints(config, "connect", mode) if not _is_tls(e) and not _is_local(e)]
    if not guarded and _get(config, "scouting/multicast/enabled") is not False and _connects(config, mode):
        exposed.append("scouting/multicast, which is on where it is not set to false,")
    if exposed:
        raise ServiceStartError(
            f"{exposed[0]} reaches beyond this machine, and whoever is there could answer in the server's "
            "place and see its clients' pictures; make certificates and rules by `featuredb keys init DIR` "
            "and start with --config DIR/server.json5, or say --insecure"
        )


def _connects(config: zenoh.Config, mode: str) -> bool:
    """Whether it connects to whom it finds by multicast: routers only where they are told to."""
    found = _get(config, "scouting/multicast/autoconnect")
    if isinstance(found, dict):
        found = found.get(mode)
    return mode != "router" if found is None else bool(found)


def authenticates(config: zenoh.Config) -> bool:
    """Whether clients prove who they are, and may do only what rules allow."""
    known = bool(_get(config, "transport/link/tls/enable_mtls")) or bool(
        _get(config, "transport/auth/usrpwd/dictionary_file")
    )
    rules = _get(config, "access_control")
    return known and bool(rules["enabled"]) and rules["default_permission"] == "deny"


def _endpoints(config: zenoh.Config, side: str, mode: str) -> list[str]:
    found = _get(config, f"{side}/endpoints")
    if isinstance(found, dict):
        found = found.get(mode) or []
    return [] if (side, mode) == ("listen", "client") else list(found)


def _is_tls(endpoint: str) -> bool:
    return endpoint.startswith(("tls/", "quic/"))


def _is_local(endpoint: str) -> bool:
    kind, _, address = endpoint.partition("/")
    host = address.split("?")[0].split("#")[0].rpartition(":")[0].strip("[]")
    return kind in _THIS_MACHINE or is_loopback(host)


def _get(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))
