"""Subcommand `view`; what it needs is imported when it runs."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from featuredb.cli.common import add_as_of_argument, add_command, open_database, progress_of_maps
from featuredb.errors import ExportError
from featuredb.extras import require


def register(subparsers: Any) -> None:
    """Add the subcommand to the parser of `featuredb`."""
    from featuredb.cli.export import add_selection_arguments

    view = add_command(
        subparsers,
        "view",
        _run,
        "look at a database in a browser",
        description="Open a page on this machine: maps, photos, scans, lineage, tracks of films, and where a "
        "photo that is dropped on it was taken. Nothing is loaded from the network.",
    )
    view.add_argument(
        "--photos",
        type=Path,
        metavar="FOLDER",
        help="where the photos are; only read, found by name or bytes",
    )
    view.add_argument(
        "--trajectory",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a track, as CSV of `featuredb track`; may be repeated",
    )
    view.add_argument(
        "--points",
        type=int,
        metavar="N",
        help="at most so many points in each place; default 1000000, with --static 250000",
    )
    view.add_argument(
        "--static", type=Path, metavar="OUT.html", help="write one file that can be sent, instead of serving"
    )
    view.add_argument("--port", type=int, default=0, help="default: a free one")
    view.add_argument("--no-browser", action="store_true", help="print the address only")
    add_selection_arguments(view)
    add_as_of_argument(view)


def _run(args: argparse.Namespace) -> int:
    from featuredb.cli.export import selection_of
    from reloc.tracking.trajectory.files import read_trajectory_csv
    from reloc.viewer.page import DEFAULT_POINTS as STATIC_POINTS
    from reloc.viewer.page import write_static_page
    from reloc.viewer.photos import Pictures, Queries
    from reloc.viewer.scene import DEFAULT_POINTS, ViewerSceneOptions, build_scene

    if args.static is None:
        require("http", "The viewer (but not `--static OUT.html`)", "fastapi", "uvicorn")
        from reloc.listening import listen
        from reloc.viewer.server import HOST

        listen(HOST, args.port).close()  # building the scene takes long, and the port may be taken
    elif args.static.exists():
        raise ExportError(f"{args.static}: expected a name that is free; nothing is overwritten")
    tracks = [read_trajectory_csv(path) for path in args.trajectory]
    pictures = Pictures(args.photos)
    chosen = selection_of(args)
    if not args.status:
        chosen = replace(chosen, statuses=ViewerSceneOptions().selection.statuses)
    usual = DEFAULT_POINTS if args.static is None else STATIC_POINTS
    options = ViewerSceneOptions(
        selection=chosen,
        points=usual if args.points is None else args.points,
        photos=None if args.photos is None else args.photos.absolute(),
        told=progress_of_maps(),
    )
    database = open_database(args)
    scene = build_scene(database, database.snapshot(args.as_of), tracks, options)
    if args.static is not None:
        size = write_static_page(args.static, scene, pictures)
        sys.stdout.write(f"{args.static}: {size / 1e6:.1f} MB, of version {scene.document['snapshot']}\n")
        return 0
    from reloc.viewer.server import create_app, serve

    serve(create_app(scene, pictures, Queries(database, scene)), args.port, browser=not args.no_browser)
    return 0
