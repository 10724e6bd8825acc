"""Subcommand `serve`; what it needs is imported when it runs."""

import argparse
import logging
import sys
from pathlib import Path
from typing import Any

from featuredb.cli.common import add_command, numbers, open_database
from reloc.wire.keys import DEFAULT_ENDPOINT

logger = logging.getLogger(__name__)


def register(subparsers: Any) -> None:
    """Add the subcommand to the parser of `featuredb`."""
    serve = add_command(
        subparsers,
        "serve",
        _serve,
        "answer queries over Zenoh",
        description="Answer queries over Zenoh until stopped.",
    )
    serve.add_argument(
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help=f"Zenoh endpoint, may be repeated; default {DEFAULT_ENDPOINT} where no --config is given",
    )
    serve.add_argument(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="Zenoh endpoint of a router that clients connect to, may be repeated; with --config the server "
        "then listens only where --listen says so",
    )
    serve.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration (JSON5), such as `featuredb keys` makes",
    )
    serve.add_argument(
        "--insecure",
        action="store_true",
        help="start even if unauthenticated machines can reach the server",
    )
    serve.add_argument("--name", default="", help="database name on the wire; default: the folder's name")
    serve.add_argument(
        "--bbox",
        type=_bbox,
        metavar="W,S,E,N",
        help="answer only from maps that touch this box in degrees, --bbox=W,S,E,N; others have the rest",
    )
    serve.add_argument("--workers", type=int, help="queries localised at a time; default 2")
    serve.add_argument("--max-queue", type=int, help="queries that may wait; default 32")
    serve.add_argument(
        "--deadline", type=float, dest="deadline_s", metavar="SECONDS", help="per query; default 8"
    )
    serve.add_argument(
        "--contributions",
        choices=("on", "off"),
        default="on",
        help="take photos that clients contribute, with credit and licence, into a bounded inbox; default on",
    )
    serve.add_argument(
        "--live-sessions",
        type=int,
        dest="max_sessions",
        metavar="N",
        help="streams followed at a time; default 2",
    )
    serve.add_argument(
        "--live-idle",
        type=float,
        dest="idle_timeout_s",
        metavar="SECONDS",
        help="a live session without a usable frame for so long ends; default 5",
    )
    serve.add_argument(
        "--metrics-port", type=int, metavar="PORT", help="serve http://127.0.0.1:PORT/metrics for Prometheus"
    )


def _bbox(text: str) -> tuple[float, float, float, float]:
    what = "west,south,east,north in degrees"
    west, south, east, north = numbers(text, what, 4)
    if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
        raise argparse.ArgumentTypeError(f"expected {what}, found {text!r}")
    return west, south, east, north


def _serve(args: argparse.Namespace) -> int:
    from reloc.service.logs import fields, log_to

    database = open_database(args)
    log_to(sys.stderr)
    # Before the imports, which take seconds, too.
    logger.info('loads %s; wait for "serving" before you ask', database.name, extra=fields("loading"))
    import cv2

    from featuredb.stop_signals import end_process
    from reloc.service.options import LiveOptions, ServeOptions
    from reloc.service.serve import serve
    from reloc.service.server import Server

    def given(*names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(args, name, None)) is not None}

    listen = tuple(args.listen or (() if args.config else (DEFAULT_ENDPOINT,)))
    options = ServeOptions(
        listen=listen,
        connect=tuple(args.connect or ()),
        config_path=args.config,
        contributions=args.contributions == "on",
        live=LiveOptions(**given("max_sessions", "idle_timeout_s")),
        **given("insecure", "name", "bbox", "metrics_port", "workers", "max_queue", "deadline_s"),
    )
    # Its decoders tell stderr about each hostile file; the refusal in our log says it once.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

    def announce(server: Server) -> None:
        where = ", ".join(server.endpoints) or str(args.config)
        sys.stdout.write(
            f"serving {server.database!r} (snapshot {server.status().snapshot}, {server.status().maps} maps) "
            f"on {where}; stop with Ctrl-C\n"
        )
        sys.stdout.flush()

    serve(database, options, on_ready=announce)
    end_process(0)
