"""`featuredb ingest video DB FILE`: keyframes of a film, ingested as photos."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from featuredb.video.telemetry.values import Telemetry
    from ingest.video.stills import Stills


# Keyframes show each point many times over. Of a film of 1,200 frames (53 keyframes, 1280x720), matching and
# reconstruction take 130 s of a core with these, and had not ended after ten minutes with photos' 12,000.
_FEATURES = 5000


def add_video_arguments(parser: argparse.ArgumentParser) -> None:
    """What a film needs beside what photos do."""
    group = parser.add_argument_group("the film")
    group.add_argument(
        "--telemetry",
        type=Path,
        default=None,
        metavar="FILE",
        help="a drone's .srt, or a log (GPX, CSV); default: what is in the film (GoPro, DJI) or beside it "
        "under its name",
    )
    group.add_argument(
        "--no-telemetry", action="store_true", help="take no notice of telemetry in the film or beside it"
    )
    group.add_argument(
        "--film-start",
        default=None,
        metavar="WHEN",
        help="when the film begins on the clock of a GPX or CSV log, like 2024-05-31T12:00:00Z; seconds of "
        "the log where it has no clock; default: found by the movements of picture and receiver",
    )
    group.add_argument(
        "--telemetry-late",
        type=float,
        default=None,
        metavar="S",
        help="how much later than the picture the telemetry shows a place; default: estimated from the "
        "speeds of both; of a log with a clock of its own: beside --film-start only",
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

    telemetry = _telemetry(args)
    options = StillsOptions(
        start_s=args.start,
        end_s=args.end,
        telemetry_late_s=args.telemetry_late,
        film_start_s=_film_start(telemetry, args),
        positions=args.gcp is None,
        keyframes=KeyframeOptions(most=args.keyframes, least=min(KeyframeOptions().least, args.keyframes)),
    )
    if telemetry is not None:
        _check(telemetry, args)
    # Made by `run_photos`: a film that is refused leaves no database behind.
    database = Database(str(args.db), storage_options(args))
    root = args.work or default_root(database.url)
    with progress_bars(args.quiet) as progress:
        stills = make_stills(args.folder, telemetry, root, options, progress)
    sys.stdout.write(_text(args.folder, stills, telemetry))
    if args.height_datum == "unknown" and stills.heights in HEIGHT_DATUMS:
        args.height_datum = stills.heights
    args.folder, args.name = stills.folder, args.name or args.folder.stem
    if args.max_features is None:
        args.max_features = _FEATURES
    return run_photos(args)


def _check(telemetry: "Telemetry", args: argparse.Namespace) -> None:
    """Telemetry that cannot place the film is refused before anything is made."""
    import numpy as np

    from featuredb.errors import InvalidValueError

    if args.height_datum != "unknown" and not np.isfinite(telemetry.height_m).any():
        raise InvalidValueError(
            f"--height-datum {args.height_datum}: the telemetry has heights above the place of take-off only"
        )


def _telemetry(args: argparse.Namespace) -> "Telemetry | None":
    from featuredb.errors import InvalidValueError
    from featuredb.video.telemetry.read import read_telemetry, telemetry_of_video

    if args.no_telemetry:
        told = [
            name for name in ("telemetry", "telemetry_late", "film_start") if getattr(args, name) is not None
        ]
        if told:
            raise InvalidValueError(f"--no-telemetry: expected no --{told[0].replace('_', '-')} beside it")
        return None
    if args.telemetry is not None:
        return read_telemetry(args.telemetry)
    return telemetry_of_video(args.folder)


def _film_start(telemetry: "Telemetry | None", args: argparse.Namespace) -> float | None:
    """Where the film begins in a log with a clock of its own, as was told."""
    from featuredb.errors import InvalidValueError
    from ingest.video.film_time import film_start

    if args.film_start is not None:
        if telemetry is None:
            raise InvalidValueError("--film-start: there is no telemetry; give --telemetry FILE")
        return film_start(args.film_start, telemetry)
    if args.telemetry_late is not None and telemetry is not None and not telemetry.in_video_time:
        raise InvalidValueError(
            f"--telemetry-late: {telemetry.origin or telemetry.source} has a clock of its own; give "
            "--film-start, and this beside it if the log is late against that"
        )
    return None


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
