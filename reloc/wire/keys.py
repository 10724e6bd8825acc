"""Where servers listen, and the keys of a database on the wire. `docs/wire.md` lists them.

`<client>` is the name that the server knows a client by: rules by certificate hold it to its own, so that a
query's key says who asked. Where a server authenticates nobody it says nothing.
"""

import ipaddress
import re
from dataclasses import dataclass

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # Zenoh's own port, this machine only
KEY_ROOT = "featuredb"
# Of databases, clients and live sessions: one chunk of a key.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
NAME_EXPECTED = "expected 1..64 letters, digits, '_', '.', '-', beginning with a letter or digit"
ANONYMOUS = "anonymous"  # a client that has no name
CLIENT_SETTING = "featuredb_client"  # in `metadata` of a Zenoh configuration: the client's name


@dataclass(frozen=True, slots=True, kw_only=True)
class Keys:
    """The keys of one database, or of all with `database="*"`."""

    database: str

    def of(self, leaf: str) -> str:
        """Key of what the server says of itself: status, maps, events."""
        return f"{KEY_ROOT}/{self.database}/{leaf}"

    def localise(self, client: str, server_id: str = "") -> str:
        """Key under which a client asks where a photo was taken: any server, or this one."""
        return self.of(f"localise/{client}" + (f"/{server_id}" if server_id else ""))

    def track(self, client: str, session: str, leaf: str = "") -> str:
        """Key of a client's live session, or of a leaf of it: frames, poses, events, client."""
        return self.of(f"track/{client}/{session}" + (f"/{leaf}" if leaf else ""))

    def server_token(self, server_id: str) -> str:
        """Liveliness token of a server."""
        return self.of(f"servers/{server_id}")

    def tile_token(self, server_id: str, tile: str) -> str:
        """Liveliness token of a tile that a server answers for; the tile's slashes become dashes."""
        return self.of(f"tiles/{tile.replace('/', '-')}/{server_id}")


def is_loopback(host: str) -> bool:
    """Whether a host name or address is reached by this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def client_of(key: str) -> str:
    """The client that a query to `Keys.localise` names; ANONYMOUS where that is a wildcard."""
    name = (*key.split("/"), "", "", "", "")[3]
    return name if is_name(name) else ANONYMOUS


def is_addressed(key: str) -> bool:
    """Whether a query to `Keys.localise` names a server."""
    return key.count("/") == 4


def is_name(text: str) -> bool:
    """Whether a database, a client or a live session may be called so."""
    return _NAME.fullmatch(text) is not None
