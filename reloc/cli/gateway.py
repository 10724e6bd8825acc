"""Subcommand `gateway`; what it needs is imported when it runs."""

import argparse
import sys
from typing import Any

from featuredb.extras import require


def register(subparsers: Any) -> None:
    """Add the subcommand to the parser of `featuredb`."""
    from reloc.cli.commands import add_server_arguments

    gateway = subparsers.add_parser(
        "gateway",
        help="answer HTTP by asking a server over Zenoh",
        description="OSCP GeoPoseProtocol v2 and plain multipart over HTTP, answered by `featuredb serve`.",
    )
    add_server_arguments(gateway)
    gateway.add_argument("--host", default="127.0.0.1", help="address to listen on; default 127.0.0.1")
    gateway.add_argument(
        "--insecure",
        action="store_true",
        help="listen on an address that other machines reach; the gateway has no TLS and no authentication",
    )
    gateway.add_argument("--port", type=int, default=8080, help="default 8080; 0 takes a free one")
    gateway.add_argument(
        "--prefix", default="", metavar="/PATH", help="stands before every path, such as /vps"
    )
    gateway.add_argument(
        "--timeout", type=float, default=10.0, metavar="SECONDS", help="per photo; default 10"
    )
    gateway.add_argument(
        "--max-in-flight", type=int, default=16, metavar="N", help="photos in hand at a time; default 16"
    )
    gateway.add_argument(
        "--cors-origin",
        action="append",
        default=[],
        metavar="ORIGIN",
        help="web pages of this origin may ask; may be repeated; * is all",
    )
    gateway.set_defaults(run=_run)


def _run(args: argparse.Namespace) -> int:
    require("http", "The HTTP gateway", "fastapi", "uvicorn", "python_multipart")
    from reloc.gateway.options import GatewayOptions
    from reloc.gateway.serve import serve
    from reloc.service.logs import log_to

    same = ("connect", "database", "host", "insecure", "port", "prefix", "max_in_flight")
    options = GatewayOptions(
        config_path=args.config,
        timeout_s=args.timeout,
        cors_origins=tuple(args.cors_origin),
        **{name: getattr(args, name) for name in same},
    )
    log_to(sys.stderr)

    def announce(url: str) -> None:
        sys.stdout.write(f"listening on {url}, asking {args.config or args.connect}; stop with Ctrl-C\n")
        sys.stdout.flush()

    serve(options, on_ready=announce)
    return 0
