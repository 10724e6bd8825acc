"""The same wire twice: a server as `featuredb keys` ships it, and one that nothing guards."""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from featuredb.cli.main import main
from reloc.client import Client
from reloc.service.contributions.inbox import Inbox
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from tests.support.live import localiser
from tests.support.service import MemoryInbox, MemorySource, area_of

DATABASE = "town"


@dataclass(frozen=True, slots=True, kw_only=True)
class Wire:
    """A running server and how to come to it.

    Attributes:
        keys: folder of the authority; None: nothing guards the server.
        contributions: what clients have given.
    """

    server: Server
    keys: Path | None
    contributions: MemoryInbox

    def client(self, name: str) -> Client:
        """The stock client, as the documentation has it."""
        if self.keys is None:
            made = Client(self.server.endpoints[0])
            made.name = name
            return made
        return Client(config_path=self.keys / "clients" / f"{name}.json5")

    @contextmanager
    def attacker(self, name: str, mode: str = "client") -> Iterator[zenoh.Session]:
        """A session that does what it likes, with the certificate of a client where there are some."""
        if self.keys is None:
            config = zenoh.Config.from_json5('{"scouting": {"multicast": {"enabled": false}}}')
            config.insert_json5("connect/endpoints", f'["{self.server.endpoints[0]}"]')
        else:
            config = zenoh.Config.from_file(str(self.keys / "clients" / f"{name}.json5"))
        config.insert_json5("mode", f'"{mode}"')
        config.insert_json5("listen/endpoints", "[]")
        with zenoh.open(config) as session:
            yield session


@contextmanager
def open_wire() -> Iterator[Wire]:
    """A server on loopback that nothing guards."""
    with _serving(ServeOptions(listen=("tcp/127.0.0.1:0",)), None) as wire:
        yield wire


@contextmanager
def guarded_wire(folder: Path, *clients: str) -> Iterator[Wire]:
    """A server with the configuration that `featuredb keys` writes, and clients with theirs."""
    keys("init", folder, "--port", str(free_port()))
    for name in clients:
        keys("client", folder, name)
    with restarted(folder) as wire:
        yield wire


@contextmanager
def restarted(folder: Path, config: str = "server.json5", database: str = DATABASE) -> Iterator[Wire]:
    """A server of an authority that is there already."""
    with _serving(ServeOptions(listen=(), config_path=folder / config), folder, database) as wire:
        yield wire


def keys(action: str, folder: Path, *arguments: str) -> None:
    """`featuredb keys`."""
    assert main(["keys", action, str(folder), *arguments]) == 0


def config_of(path: Path) -> dict[str, dict[str, Any]]:
    """A Zenoh configuration that `featuredb keys` has written."""
    lines = path.read_text().splitlines()
    found: dict[str, dict[str, Any]] = json.loads("\n".join(x for x in lines if not x.startswith("//")))
    return found


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def _serving(options: ServeOptions, folder: Path | None, database: str = DATABASE) -> Iterator[Wire]:
    given = MemoryInbox()
    source = MemorySource(area_of(localiser()))
    with Server.start(source, options, database, Inbox(given.write, given.counts)) as server:
        yield Wire(server=server, keys=folder, contributions=given)
