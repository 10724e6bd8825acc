"""Zenoh sessions of the service."""

import json
import re
import socket
from pathlib import Path

import zenoh

from featuredb.errors import FeatureDbError
from reloc.wire.endpoints import DEFAULT_ENDPOINT


class ServiceStartError(FeatureDbError):
    """The server cannot start: port taken, bad endpoint, bad configuration."""


def server_config(
    listen: tuple[str, ...], connect: tuple[str, ...], config_path: Path | None, max_message_bytes: int
) -> zenoh.Config:
    """The Zenoh configuration of a server; one that connects listens only where `listen` says so.

    Raises:
        ServiceStartError: the file cannot be read.
    """
    config = _base_config(config_path)
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
        raise ServiceStartError(f"cannot listen on {where}: {_first_sentence(error)}; {hint}") from error


def bind_free_port(endpoint: str) -> str:
    """`endpoint` with port 0 replaced by a free one, so that the server can say where it is."""
    match = re.fullmatch(r"(tcp|tls|quic)/(.+):0(\?.*|#.*)?", endpoint)
    if match is None:
        return endpoint
    host = match[2].strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    kind = socket.SOCK_DGRAM if match[1] == "quic" else socket.SOCK_STREAM
    try:
        with socket.socket(family, kind) as probe:
            probe.bind((host, 0))
            port = int(probe.getsockname()[1])
    except OSError as error:
        raise ServiceStartError(
            f"cannot listen on {endpoint}: {error}; expected endpoints like {DEFAULT_ENDPOINT}"
        ) from error
    return f"{match[1]}/{match[2]}:{port}{match[3] or ''}"


def _base_config(config_path: Path | None) -> zenoh.Config:
    if config_path is None:
        return zenoh.Config()
    try:
        return zenoh.Config.from_file(str(config_path))
    except zenoh.ZError as error:
        raise ServiceStartError(
            f"cannot read the Zenoh configuration {config_path}: {_first_sentence(error)}"
        ) from error


def _first_sentence(error: Exception) -> str:
    """Zenoh's message without the source lines that it appends."""
    return str(error).split(" at /")[0].strip()
