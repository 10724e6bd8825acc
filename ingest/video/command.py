"""`featuredb ingest video DB FILE`: keyframes of a film, ingested as photos."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from featuredb.video.telemetry.values import Telemetry
    from ingest.video.stills import Stills


def add_video_arguments(parser: argparse.ArgumentParser) -> None:
    """What a film needs beside what photos do."""
    group = parser.add_argument_group("the film")
    group.add_argument(
        "--telemetry",
        type=Path,
        default=None,
        metavar="FILE",
        help="a drone's .srt; default: what is in the film (GoPro, DJI) or beside it under its name",
    )
    group.add_argument(
        "--telemetry-late",
        type=float,
        default=None,
        metavar="S",
        help="how much later than the picture the telemetry shows a place; default: estimated from the "
        "speeds of both",
    )
    group.add_argument(
        "--keyframes", type=int, default=60, metavar="N", help="about so many at most; default: 60"
    )
    group.add_argument("--start", type=float, default=None, metavar="S", help="default: the film's beginning")
    group.add_argument("--end", type=float, default=None, metavar="S", help="default: the film's end")


def run_video(args: argparse.Namespace) -> int:
    """Choose keyframes, write them, ingest them; as `ingest.cli.run_photos`.

    Raises:
        VideoError: the film cannot be read, or shows too little motion.
        TelemetryError, IngestError, StoreError, InvalidValueError
    """
    from featuredb.cli.common import storage_options
    from featuredb.geo.datum import HEIGHT_DATUMS
    from featuredb.store import Database
    from ingest.cli import run_photos
    from ingest.progress_bars import progress_bars
    from ingest.video.keyframes import KeyframeOptions
    from ingest.video.stills import StillsOptions, make_stills
    from ingest.workspace import default_root

    options = StillsOptions(
        start_s=args.start,
        end_s=args.end,
        telemetry_late_s=args.telemetry_late,
        keyframes=KeyframeOptions(most=args.keyframes),
    )
    telemetry = _telemetry(args)
    if telemetry is not None:
        _check(telemetry, args)
    database = Database.create(args.db, storage_options=storage_options(args))
    root = args.work or default_root(database.url)
    with progress_bars(args.quiet) as progress:
        stills = make_stills(args.folder, telemetry, root, options, progress)
    sys.stdout.write(_text(args.folder, stills, telemetry))
    if args.height_datum == "unknown" and stills.heights in HEIGHT_DATUMS:
        args.height_datum = stills.heights
    args.folder, args.name = stills.folder, args.name or args.folder.stem
    return run_photos(args)


def _check(telemetry: "Telemetry", args: argparse.Namespace) -> None:
    """Telemetry that cannot place the film is refused before anything is made."""
    import numpy as np

    from featuredb.errors import InvalidValueError, TelemetryError

    if not telemetry.in_video_time and args.gcp is None:
        raise TelemetryError(
            f"{telemetry.origin or telemetry.source}: its times are on a clock of its own and cannot be laid "
            "on the film's yet; give the drone's .srt, a film with its telemetry inside, or --gcp"
        )
    if args.height_datum != "unknown" and not np.isfinite(telemetry.height_m).any():
        raise InvalidValueError(
            f"--height-datum {args.height_datum}: the telemetry has heights above the place of take-off only"
        )


def _telemetry(args: argparse.Namespace) -> "Telemetry | None":
    from featuredb.video.telemetry.read import read_telemetry, telemetry_of_video

    if args.telemetry is not None:
        return read_telemetry(args.telemetry)
    return telemetry_of_video(args.folder)


def _text(film: Path, stills: "Stills", telemetry: "Telemetry | None") -> str:
    lines = [
        f"{film.name}: {stills.photos} keyframes of {stills.frames} frames, a step is {stills.step:.0%} of "
        f"the picture, {stills.breaks} breaks; in {stills.folder}"
    ]
    if telemetry is None:
        lines.append("no telemetry: the map needs a scan, control points or other maps for its place")
    else:
        lines.append(
            f"telemetry of {telemetry.origin or telemetry.source}: {stills.positions} keyframes have a "
            f"position, heights {stills.heights}"
        )
    lines += [f"note: {text}" for text in stills.notes]
    return "\n".join(lines) + "\n"
