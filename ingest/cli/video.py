"""`featuredb ingest video DB FILM ...`: keyframes of films, ingested as photos in one job."""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from featuredb.cli.common import place_for_database

if TYPE_CHECKING:
    from featuredb.video.telemetry.values import Telemetry
    from ingest.video.films import Films


# Keyframes show each point many times over. Of a film of 1,200 frames (53 keyframes, 1280x720), matching and
# reconstruction take 130 s of a core with these, and had not ended after ten minutes with photos' 12,000.
_FEATURES = 5000
# What only one film can have.
_OF_ONE = ("telemetry", "telemetry_late", "film_start")


def add_video_arguments(parser: argparse.ArgumentParser) -> None:
    """What films need beside what photos do."""
    parser.add_argument(
        "films",
        metavar="FILM",
        nargs="+",
        type=Path,
        help="mp4, mov, mkv, webm, avi or ts, or a folder of them, searched through",
    )
    group = parser.add_argument_group("the films")
    group.add_argument(
        "--telemetry",
        type=Path,
        metavar="FILE",
        help="of one film: a drone's .srt, or a log (GPX, CSV); default: what is in the film (GoPro, DJI) or "
        "beside it under its name",
    )
    group.add_argument(
        "--no-telemetry", action="store_true", help="ignore telemetry in films and beside them"
    )
    group.add_argument(
        "--film-start",
        metavar="WHEN",
        help="when the film begins on the clock of a GPX or CSV log, like 2024-05-31T12:00:00Z; seconds of "
        "the log where it has no clock; default: found by the movements of picture and receiver",
    )
    group.add_argument(
        "--telemetry-late",
        type=float,
        metavar="S",
        help="how much later than the picture the telemetry shows a place; default: estimated from the "
        "speeds of both; of a log with a clock of its own: beside --film-start only",
    )
    group.add_argument(
        "--keyframes", type=int, default=60, metavar="N", help="approximate number per film; default: 60"
    )
    group.add_argument("--start", type=float, metavar="S", help="default: each film's beginning")
    group.add_argument("--end", type=float, metavar="S", help="default: each film's end")


def run_video(args: argparse.Namespace) -> int:
    """Choose keyframes, write them, ingest them; as `ingest_folder`.

    Raises:
        VideoError: no film can be read, or they show too little motion.
        TelemetryError, IngestError, StoreError, InvalidValueError
    """
    from featuredb.geo.heights import HEIGHT_DATUMS
    from ingest.api.progress_bars import progress_bars
    from ingest.cli.ingest import ingest_folder
    from ingest.video.films import find_films, make_films
    from ingest.video.keyframes import KeyframeOptions
    from ingest.video.stills import StillsOptions
    from ingest.workspace import default_root

    paths, notes = find_films(args.films)
    _check_options(args, len(paths))
    options = StillsOptions(
        start_s=args.start,
        end_s=args.end,
        telemetry_late_s=args.telemetry_late,
        film_start_s=_film_start(args, paths[0]),
        positions=args.gcp is None,
        keyframes=KeyframeOptions(most=args.keyframes, least=min(KeyframeOptions().least, args.keyframes)),
    )
    # The database is made when there are photos: films that are refused leave none behind.
    database = place_for_database(args)
    root = args.work or default_root(database.url)
    with progress_bars(args.quiet) as progress:
        films = make_films(paths, partial(_telemetry, args), root, options, progress)
    sys.stdout.write(_text(films, notes))
    if args.height_datum == "unknown" and len(films.heights & set(HEIGHT_DATUMS)) == len(films.heights) == 1:
        (args.height_datum,) = films.heights
    args.name = args.name or _name(args.films, len(paths))
    if args.max_features is None:
        args.max_features = _FEATURES
    return ingest_folder(args, films.folder, films.outcomes)


def _check_options(args: argparse.Namespace, films: int) -> None:
    """What does not go together is refused before anything is made."""
    from featuredb.errors import InvalidValueError

    told = [f"--{name.replace('_', '-')}" for name in _OF_ONE if getattr(args, name) is not None]
    if told and args.no_telemetry:
        raise InvalidValueError(f"--no-telemetry: expected no {told[0]} beside it")
    if told and films > 1:
        raise InvalidValueError(
            f"{told[0]}: expected one film, found {films}; logs beside films and under their names are found"
        )


def _telemetry(args: argparse.Namespace, film: Path) -> "Telemetry | None":
    """A film's telemetry, checked against what was told of it."""
    import numpy as np

    from featuredb.errors import InvalidValueError
    from featuredb.video.telemetry.read import read_telemetry, telemetry_of_video

    if args.no_telemetry:
        return None
    telemetry = telemetry_of_video(film) if args.telemetry is None else read_telemetry(args.telemetry)
    if telemetry is None:
        return None
    if args.height_datum != "unknown" and not np.isfinite(telemetry.height_m).any():
        raise InvalidValueError(
            f"--height-datum {args.height_datum}: the telemetry has heights above the place of take-off only"
        )
    return telemetry


def _film_start(args: argparse.Namespace, film: Path) -> float | None:
    """Where the film begins in a log with a clock of its own, as was told."""
    from featuredb.errors import InvalidValueError
    from ingest.video.film_time import film_start

    if args.film_start is None and args.telemetry_late is None:
        return None
    telemetry = _telemetry(args, film)
    if args.film_start is not None:
        if telemetry is None:
            raise InvalidValueError("--film-start: there is no telemetry; give --telemetry FILE")
        return film_start(args.film_start, telemetry)
    if telemetry is not None and not telemetry.in_video_time:
        raise InvalidValueError(
            f"--telemetry-late: {telemetry.origin or telemetry.source} has a clock of its own; give "
            "--film-start, and this beside it if the log is late against that"
        )
    return None


def _name(named: list[Path], films: int) -> str:
    """Of the map: the film's, or the folder's, or the first one's with the number of the others."""
    first = named[0].absolute()
    if len(named) == 1 and first.is_dir():
        return first.name
    return first.stem if films == 1 else f"{first.stem} and {films - 1} more"


def _text(films: "Films", notes: list[str]) -> str:
    lines = [f"note: {text}" for text in notes]
    for film in films.outcomes:
        if film.status == "refused":
            lines.append(f"{film.path}: not used: {film.reason}")
            continue
        lines.append(
            f"{film.path}: {film.keyframes} keyframes of {film.frames} frames in {len(film.shots)} shots; "
            f"{film.telemetry or 'no telemetry'}"
        )
        lines += [f"note: {film.name}: {text}" for text in film.notes]
    lines.append(f"keyframes are in {films.folder}")
    return "\n".join(lines) + "\n"
