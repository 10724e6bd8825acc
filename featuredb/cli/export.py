"""`featuredb export DB OUT --format FORMAT`: maps for other systems. See docs/export.md."""

import argparse
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from featuredb.cli.common import (
    add_as_of_argument,
    add_command,
    numbers,
    open_database,
    progress_of_maps,
    write_json,
)
from featuredb.errors import ExportError
from featuredb.export.formats_known import FORMATS, OWN_OPTIONS, export_maps
from featuredb.maps.statuses import MAP_STATUSES, UNPLACED_STATUSES, MapStatus, UnplacedStatus

if TYPE_CHECKING:
    from featuredb.export.selection import Selection

# West of Greenwich a box begins with a minus, which argparse takes for an option unless it looks like this.
_NEGATIVE = re.compile(r"^-[\d.]")


_STATUSES = tuple(dict.fromkeys((*MAP_STATUSES, *UNPLACED_STATUSES)))


def register(subparsers: Any) -> None:
    text = "write maps for other systems"
    parser = add_command(
        subparsers,
        "export",
        run_export,
        text,
        description=f"{text}; by default every active map.",
        epilog="formats: " + "; ".join(f"{name}: {entry.text}" for name, entry in FORMATS.items()),
    )
    parser._negative_number_matcher = _NEGATIVE
    parser.add_argument("out", metavar="OUT", type=Path, help="file or folder to be made")
    parser.add_argument("--format", required=True, choices=tuple(FORMATS), help="see below")
    add_selection_arguments(parser)
    add_as_of_argument(parser)
    parser.add_argument("--text", action="store_true", help="colmap: text files instead of binary ones")
    parser.add_argument(
        "--photos", type=Path, default=None, metavar="FOLDER", help="exif: where the originals are; only read"
    )
    parser.add_argument(
        "--with-lidar",
        action="store_true",
        help="dataset: also the tiles of scans that touch the maps, as LAZ",
    )
    parser.add_argument("--json", action="store_true", help="the summary as JSON")


def add_selection_arguments(parser: argparse.ArgumentParser) -> None:
    """Which maps, and what of them."""
    group = parser.add_argument_group("which maps")
    group.add_argument(
        "--maps", nargs="+", default=[], metavar="ID", help="these, whatever their status and their place"
    )
    group.add_argument(
        "--status",
        type=_statuses,
        default=None,
        metavar="S[,S]",
        help=f"of {', '.join(_STATUSES)}; default: active",
    )
    group.add_argument(
        "--bbox",
        type=lambda text: numbers(text, "four numbers of degrees, west,south,east,north", 4),
        default=None,
        metavar="W,S,E,N",
        help="maps that touch this box, WGS84 degrees; whole maps",
    )
    group.add_argument(
        "--where",
        default="",
        metavar="SQL",
        help="maps whose row fits, e.g. \"method = 'gcp' and images > 20\"",
    )
    group.add_argument(
        "--licence",
        type=_names,
        default=None,
        metavar="A[,B]",
        help="only what photos with these licences have contributed, e.g. cc-by,cc0",
    )


def run_export(args: argparse.Namespace) -> None:
    database = open_database(args)
    done = export_maps(
        database,
        args.out,
        args.format,
        selection_of(args),
        as_of=args.as_of,
        told=progress_of_maps(),
        **{name: getattr(args, name) for name in OWN_OPTIONS},
    )
    if args.json:
        write_json({"format": args.format, "out": args.out, "version": done.version, **asdict(done.written)})
    else:
        sys.stdout.write(done.as_text())


def selection_of(args: argparse.Namespace) -> "Selection":
    """What the arguments select.

    Raises:
        ExportError: a box or licences that cannot be, or both ids and statuses.
    """
    from featuredb.export.selection import Selection

    if args.maps and args.status:
        raise ExportError("--maps names maps whatever their status; leave out --status")
    given = {} if args.status is None else {"statuses": args.status}
    return Selection(maps=tuple(args.maps), bbox=args.bbox, where=args.where, licences=args.licence, **given)


def _statuses(text: str) -> tuple[MapStatus | UnplacedStatus, ...]:
    names = _names(text)
    if not names or any(name not in _STATUSES for name in names):
        raise argparse.ArgumentTypeError(f"expected names of {', '.join(_STATUSES)}, found {text!r}")
    return cast("tuple[MapStatus | UnplacedStatus, ...]", names)


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
