"""`featuredb export DB OUT --format FORMAT`: maps for other systems. See docs/export.md."""

import argparse
import re
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from featuredb.cli.common import (
    add_as_of_argument,
    add_database_argument,
    open_database,
    progress_of_maps,
    write_json,
)
from featuredb.errors import ExportError
from featuredb.maps.statuses import MAP_STATUSES, UNPLACED_STATUSES, MapStatus, UnplacedStatus

if TYPE_CHECKING:
    from featuredb.export.job import Exported
    from featuredb.export.selection import Selection

# West of Greenwich a box begins with a minus, which argparse takes for an option unless it looks like this.
_NEGATIVE = re.compile(r"^-[\d.]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """One way to write maps.

    Attributes:
        text: what it is, for --help.
        write: module and function in `featuredb.export`; imported when it is wanted, so that a missing extra
            concerns nobody else. It is given an ExportJob.
        options: arguments of its own, by the parser's names, which the function is given; others refuse them.
        given: what it is given besides.
    """

    text: str
    write: str
    options: tuple[str, ...] = ()
    given: Mapping[str, Any] = field(default_factory=dict)


FORMATS: dict[str, Format] = {
    "dataset": Format(
        text="one folder to publish, GeoParquet and more, which `featuredb import` reads",
        write="dataset.write:write_dataset",
        options=("with_lidar",),
    ),
    "colmap": Format(
        text="a folder for each map, placed or not: model, database, place",
        write="formats.colmap:write_colmap",
        options=("text",),
    ),
    "las": Format(
        text="points, a LAS 1.4 file for each UTM zone and height datum",
        write="formats.las:write_las_files",
        given={"compressed": False},
    ),
    "laz": Format(
        text="the same, compressed", write="formats.las:write_las_files", given={"compressed": True}
    ),
    "ply": Format(
        text="points, a binary PLY file for each UTM zone and datum, or map without a place",
        write="formats.ply:write_ply_files",
    ),
    "geojson": Format(text="positions and angles of photos, one file", write="formats.geojson:write_geojson"),
    "kml": Format(text="photos in space for Google Earth, one file", write="formats.kml:write_kml"),
    "geopose": Format(text="OGC GeoPose, a file for each photo", write="formats.geopose:write_geopose"),
    "opensfm": Format(
        text="a folder for each map as OpenSfM and OpenDroneMap have it",
        write="formats.opensfm:write_opensfm",
    ),
    "kapture": Format(
        text="a folder for each map, placed or not, as kapture 1.1 has it",
        write="formats.kapture:write_kapture",
    ),
    "exif": Format(
        text="copies of the photos with their pose in EXIF and XMP",
        write="formats.exif:write_exif",
        options=("photos",),
    ),
}
_STATUSES = tuple(dict.fromkeys((*MAP_STATUSES, *UNPLACED_STATUSES)))
# Options that belong to some formats only, with what they are when they are not given.
_OWN: dict[str, Any] = {"text": False, "photos": None, "with_lidar": False}


def register(subparsers: Any) -> None:
    """Add `export` to the parser of `featuredb`."""
    text = "write maps for other systems"
    parser = subparsers.add_parser(
        "export",
        help=text,
        description=f"{text}; by default every active map.",
        epilog="formats: " + "; ".join(f"{name}: {entry.text}" for name, entry in FORMATS.items()),
    )
    parser._negative_number_matcher = _NEGATIVE
    add_database_argument(parser)
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
    parser.set_defaults(run=run_export)


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
        type=_bbox,
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


def run_export(args: argparse.Namespace) -> int:
    """Export and say in a line what was written."""
    from featuredb.export.job import ExportJob

    chosen = FORMATS[args.format]
    _check_options(args, chosen)
    database = open_database(args)
    snapshot = database.snapshot(args.as_of)
    job = ExportJob(
        database=database,
        snapshot=snapshot,
        selection=selection_of(args),
        out=args.out,
        told=progress_of_maps(),
    )
    module, function = chosen.write.split(":")
    write = getattr(import_module(f"featuredb.export.{module}"), function)
    done: Exported = write(job, **chosen.given, **{name: getattr(args, name) for name in chosen.options})
    if args.json:
        write_json({"format": args.format, "out": args.out, "version": snapshot.version, **asdict(done)})
        return 0
    sys.stdout.write(
        f"{args.out}: {args.format}, {done.maps} maps, {done.images} images, {done.points} points, "
        f"{done.observations} observations, {done.bytes / 1e6:.1f} MB, of version {snapshot.version}\n"
    )
    return 0


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


def _check_options(args: argparse.Namespace, chosen: Format) -> None:
    """Options of other formats are refused rather than ignored."""
    for name, default in _OWN.items():
        if getattr(args, name) != default and name not in chosen.options:
            wanted = " or ".join(n for n, entry in FORMATS.items() if name in entry.options)
            raise ExportError(
                f"--{name.replace('_', '-')}: expected --format {wanted} beside it, found {args.format}"
            )


def _statuses(text: str) -> tuple[MapStatus | UnplacedStatus, ...]:
    names = _names(text)
    if not names or any(name not in _STATUSES for name in names):
        raise argparse.ArgumentTypeError(f"expected names of {', '.join(_STATUSES)}, found {text!r}")
    return cast("tuple[MapStatus | UnplacedStatus, ...]", names)


def _bbox(text: str) -> tuple[float, float, float, float]:
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"expected four numbers of degrees, west,south,east,north, found {text!r}"
        ) from error
    return west, south, east, north


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
