"""The commands for LiDAR scans: lidar add, lidar list, lidar picture."""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import (
    add_command,
    count_bars,
    drawn,
    format_table,
    open_database,
    place_for_database,
    write_json,
)
from featuredb.geo.heights import HEIGHT_DATUMS, HEIGHT_UNITS

if TYPE_CHECKING:
    from featuredb.lidar.add import OnProgress
    from featuredb.store.scans import ScanSummary

_TITLES = {"read": "Reading points", "clean": "Cleaning and ordering", "write": "Writing"}

# ASPRS LAS 1.4 R15, tables 9 and 17.
_CLASS_NAMES = {
    1: "unclassified", 2: "ground", 3: "low vegetation", 4: "medium vegetation", 5: "high vegetation",
    6: "building", 8: "key point", 9: "water", 10: "rail", 11: "road", 12: "overlap", 13: "wire guard",
    14: "wire", 15: "tower", 16: "wire connector", 17: "bridge deck", 19: "overhead structure",
    20: "ignored ground", 21: "snow", 22: "temporal exclusion",
}  # fmt: skip


def register(subparsers: Any) -> None:
    parser = subparsers.add_parser(
        "lidar", help="LiDAR scans: add, list, picture", description="LiDAR scans, see docs/lidar.md."
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _register_add(commands)
    listing = add_command(commands, "list", run_list, "list the scans")
    listing.add_argument("--all", action="store_true", help="retired scans, too")
    listing.add_argument("--json", action="store_true", help="everything that is known, as JSON")
    picture = add_command(commands, "picture", run_picture, "draw a scan from above")
    picture.add_argument("scan_id", metavar="SCAN")
    picture.add_argument("out", metavar="PNG", type=Path)


def run_add(args: argparse.Namespace) -> None:
    from featuredb.lidar.add import AddOptions, add_scan

    database = place_for_database(args)
    options = AddOptions(crs=args.crs, height_unit=args.height_unit, height_datum=args.height_datum)
    if args.keep_outliers:
        options = replace(options, outliers=None)
    with _progress(args.quiet) as on_progress:
        result = add_scan(
            database,
            args.files,
            options,
            name=args.name,
            licence=args.licence,
            source=args.source,
            ortho=args.ortho,
            ortho_crs=args.ortho_crs,
            work=args.work,
            on_progress=on_progress,
        )
    sys.stdout.write(summary(result.scan, "added" if result.created else "was there already, nothing done"))
    if args.picture is not None:
        from featuredb.lidar.picture import write_plan_view

        write_plan_view(database, result.scan, args.picture)
        sys.stdout.write(f"  {'picture':<12}{args.picture}\n")


def run_list(args: argparse.Namespace) -> None:
    from featuredb.store.scans import list_scans

    scans = list_scans(open_database(args), include_retired=args.all)
    if args.json:
        write_json({"scans": [{**scan.row, "created_at": scan.created_at} for scan in scans]})
        return
    header = (
        "scan", "name", "status", "epsg", "heights", "points", "spacing_m", "colour", "intensity",
        "east_m", "north_m", "files", "added",
    )  # fmt: skip
    table = [
        (
            s.scan_id, s.name, s.status, s.epsg, s.height_datum, s.points, round(s.spacing_m, 3),
            s.colour or "none", "yes" if s.has_intensity else "none",
            round(s.box.max_easting - s.box.min_easting, 1),
            round(s.box.max_northing - s.box.min_northing, 1), len(s.row["files"]), s.created_at,
        )
        for s in scans
    ]  # fmt: skip
    sys.stdout.write(format_table(header, table))


def run_picture(args: argparse.Namespace) -> None:
    from featuredb.lidar.picture import write_plan_view
    from featuredb.store.scans import find_scan

    database = open_database(args)
    write_plan_view(database, find_scan(database, args.scan_id), args.out)
    sys.stdout.write(f"{args.out}\n")


def summary(scan: "ScanSummary", outcome: str) -> str:
    """What a surveyor wants to check: counts, CRS, units, datum, bounds, density, classes, losses."""
    row, box = scan.row, scan.box
    area_m2 = scan.points * scan.spacing_m**2
    intensity = "none"
    if scan.has_intensity:
        intensity = f"raw {row['intensity_low']:g} to {row['intensity_high']:g} stretched to 0 to 255"
    lines = [("files", f"{len(row['files'])} with {scan.points_in_files:,} points")]
    of_first = f", from {row['crs_source']}, in {row['horizontal_unit']}"
    for crs, transformation, accuracy in dict.fromkeys(
        (f["crs"], f["transformation"], f["transformation_accuracy_m"]) for f in row["files"]
    ):
        lines.append(("CRS", crs + (of_first if crs == row["files"][0]["crs"] else "")))
        stated = "accuracy not stated" if accuracy is None else f"accuracy {accuracy:g} m"
        lines.append(("stored in", f"EPSG:{scan.epsg}, by: {transformation} ({stated})"))
    unit = f"{row['height_unit']} of {row['height_unit_m']:.12g} m"
    vertical = f"{row['vertical_crs']}; " if row["vertical_crs"] else ""
    lines += [
        ("heights", f"{vertical}{unit}: {row['height_unit_reason']}"),
        ("datum", scan.height_datum + ("" if scan.height_datum != "unknown" else _SAY_DATUM)),
        ("easting", f"{box.min_easting:.2f} to {box.max_easting:.2f} m"),
        ("northing", f"{box.min_northing:.2f} to {box.max_northing:.2f} m"),
        ("height", f"{box.min_height:.2f} to {box.max_height:.2f} m"),
        (
            "density",
            f"{scan.points / area_m2:.3g} points per m2 on {area_m2:,.0f} m2, spacing {scan.spacing_m:.3g} m",
        ),
        (
            "classes",
            ", ".join(f"{c} {_CLASS_NAMES.get(c, 'other')} {n:,}" for c, n in scan.classes.items()),
        ),
        ("colour", {"file": "of the file", "ortho": "from the ortho image"}.get(scan.colour, "none")),
        ("intensity", intensity),
        (
            "dropped",
            f"{row['dropped_noise']:,} classified as noise, {row['dropped_withheld']:,} withheld, "
            f"{row['dropped_outliers']:,} outliers; {scan.points:,} points stored",
        ),
        (
            "levels",
            ", ".join(f"{n:,}" for n in scan.level_points) + " points, 4 m apart and halved each time",
        ),
        *(("note", note) for note in row["notes"]),
    ]
    body = "".join(f"  {name:<12}{text}\n" for name, text in lines)
    return f"scan {scan.scan_id} ({scan.name}): {outcome}\n{body}"


_SAY_DATUM = "; --height-datum states it: " + ", ".join(d for d in HEIGHT_DATUMS if d != "unknown")


def _register_add(commands: Any) -> None:
    parser = add_command(
        commands,
        "add",
        run_add,
        "add the scan that LAS, LAZ or COPC files, or rasters of heights (DSM), make",
        epilog="example: featuredb lidar add DB tile1.laz tile2.laz --height-datum navd88 --picture plan.png",
    )
    parser.add_argument("files", metavar="FILE", nargs="+", type=Path)
    where = parser.add_argument_group("where the points are")
    where.add_argument(
        "--crs", help="in place of the files': an EPSG code such as EPSG:2949 or EPSG:6556+5703, WKT, or PROJ"
    )
    where.add_argument("--height-unit", choices=tuple(HEIGHT_UNITS), help="default: what the CRS says")
    where.add_argument("--height-datum", choices=HEIGHT_DATUMS, help="default: what the CRS says")
    look = parser.add_argument_group("how they look")
    look.add_argument(
        "--ortho", type=Path, metavar="TIF", help="colour what is seen from above by this image"
    )
    look.add_argument("--ortho-crs", metavar="CRS", help="in place of the image's own")
    look.add_argument("--keep-outliers", action="store_true", help="do not remove outliers")
    labels = parser.add_argument_group("what is kept with it")
    labels.add_argument("--name", default="", help="default: the first file's")
    labels.add_argument("--licence", default="")
    labels.add_argument("--source", default="", help="who made it, where it is from")
    job = parser.add_argument_group("how the job runs")
    job.add_argument(
        "--work",
        type=Path,
        default=None,
        metavar="DIR",
        help="where unfinished work is kept; default: DB/_work, or a cache folder for object stores",
    )
    job.add_argument("--picture", type=Path, metavar="PNG", help="draw the scan from above")
    job.add_argument("--quiet", action="store_true", help="no progress bars")


@contextmanager
def _progress(quiet: bool) -> Iterator["OnProgress"]:
    """A callback that draws bars on stderr, if somebody watches."""
    bars = count_bars()
    if quiet or not bars.console.is_terminal:
        yield lambda step, done, total: None
        return
    with bars:
        yield drawn(bars, _TITLES)
