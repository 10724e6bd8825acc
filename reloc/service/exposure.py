"""Who can reach a server: what its Zenoh configuration says of endpoints, identities and rules."""

import json
from typing import Any

import zenoh

from reloc.service.session import ServiceStartError
from reloc.wire.endpoints import is_loopback

_THIS_MACHINE = ("unixsock-stream", "unixpipe")


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
