"""HAProxy with `deploy/haproxy.cfg` before a server: connections that break off keep no client out."""

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from featuredb.errors import ServiceError
from reloc.client import Client
from tests.support.service import photo
from tests.support.strangers import config_of, free_port, guarded_wire
from tools.attacks import STRANGER, client_hello, connected
from tools.service_world import proxied

_CONNECTIONS = 120  # Zenoh's listener is behind for 12 s
_CLIENT = "alice"

pytestmark = pytest.mark.skipif(
    shutil.which("haproxy") is None or not Path("/etc/resolv.conf").exists(),
    reason="haproxy is not installed, or there is no /etc/resolv.conf",
)


@pytest.fixture
def keys(tmp_path: Path) -> Iterator[Path]:
    """Folder of the authority; its server runs."""
    with guarded_wire(tmp_path / "keys", _CLIENT):
        yield tmp_path / "keys"


def test_connections_that_break_off_keep_no_client_out(keys: Path) -> None:
    port = free_port()
    with proxied(port, port_of(keys)):
        break_off(port)
        with Client(config_path=client_config(keys, port)) as client:
            assert client.localise(photo()).status == "localised"


def test_without_the_proxy_they_do(keys: Path) -> None:
    break_off(port_of(keys))
    with pytest.raises(ServiceError), Client(config_path=client_config(keys, port_of(keys))) as client:
        client.localise(photo())


def break_off(port: int) -> None:
    """Many connections of a stranger, every second of which begins to speak TLS."""
    held = [connected("127.0.0.1", port, STRANGER) for _ in range(_CONNECTIONS)]
    for connection in held[::2]:
        with suppress(OSError):
            connection.sendall(client_hello())
    for connection in held:
        connection.close()


def port_of(keys: Path) -> int:
    (endpoint,) = config_of(keys / "server.json5")["listen"]["endpoints"]
    return int(endpoint.rpartition(":")[2])


def client_config(keys: Path, port: int) -> Path:
    """A client's configuration that connects to `port`."""
    written = keys / "clients" / f"{_CLIENT}.json5"
    made = written.with_name(f"{port}.json5")
    made.write_text(written.read_text().replace(f":{port_of(keys)}", f":{port}"))
    return made
