"""Subcommand `keys`: an authority for a server that is reached by other machines, and its clients."""

import argparse
import sys
from pathlib import Path
from typing import Any


def register(subparsers: Any) -> None:
    """Add the subcommand to the parser of `featuredb`."""
    keys = subparsers.add_parser(
        "keys",
        help="certificates and access rules of a server and its clients",
        description="Make an authority, a server's Zenoh configuration, and one of each client, with TLS and "
        "access rules. See docs/keys.md.",
    )
    actions = keys.add_subparsers(title="actions", metavar="ACTION", required=True)
    init = _action(actions, "init", "make an authority and a server's configuration", _init)
    init.add_argument(
        "--host",
        action="append",
        default=[],
        metavar="HOST",
        help="name or address by which clients reach the server, may be repeated; default: this machine only",
    )
    init.add_argument("--port", type=int, default=7447, help="of the server; default 7447")
    client = _action(actions, "client", "make a client's configuration, and let it in", _client)
    client.add_argument("name", metavar="NAME", help="by which the server knows the client")
    revoke = _action(actions, "revoke", "let a client in no more", _revoke)
    revoke.add_argument("name", metavar="NAME", help="of the client")


def _action(actions: Any, name: str, what: str, run: Any) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = actions.add_parser(name, help=what, description=f"{what.capitalize()}.")
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder of the authority")
    parser.set_defaults(run=run)
    return parser


def _init(args: argparse.Namespace) -> int:
    from reloc.authority import Authority

    made = Authority.create(args.folder, tuple(args.host), args.port)
    sys.stdout.write(f"wrote the server's configuration, {made.server_config}; it knows no clients yet\n")
    return 0


def _client(args: argparse.Namespace) -> int:
    from reloc.authority import Authority

    authority = Authority(args.folder)
    path = authority.add_client(args.name)
    sys.stdout.write(
        f"wrote {path}, with the client's private key: for the client's machine alone\n"
        f"wrote the rules in {authority.server_config}; restart the server\n"
    )
    return 0


def _revoke(args: argparse.Namespace) -> int:
    from reloc.authority import Authority

    authority = Authority(args.folder)
    authority.revoke(args.name)
    sys.stdout.write(
        f"wrote the rules in {authority.server_config}; {args.name!r} is out when the server has restarted\n"
    )
    return 0
