"""`featuredb ingest KIND DB ...`: arguments, options, report, and what the terminal is told."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import add_command, place_for_database, storage_options
from ingest.cli.register import add_control_arguments, sigmas_m

if TYPE_CHECKING:
    from ingest.report.films import FilmOutcome

_STAGES = ("scan", "extract", "match", "reconstruct", "build")


def register(subparsers: Any) -> None:
    ingest = subparsers.add_parser("ingest", help="make maps of photos")
    kinds = ingest.add_subparsers(title="what to ingest", metavar="KIND", required=True)
    photos = add_command(
        kinds,
        "photos",
        run_photos,
        "a folder of photos with GPS, or a table of photos",
        description="Reconstruct photos, place them by their GPS and commit the maps. Run the "
        "same command again to resume a killed ingest.",
    )
    photos.add_argument(
        "folder",
        metavar="PATH",
        type=Path,
        help="folder of photos, searched through; or a table (.csv, .parquet, .jsonl) with the columns path "
        "or id, lat, lon, accuracy, time, owner, licence, title; or OpenDroneMap's geo.txt",
    )
    _add_arguments(photos)
    _register_video(kinds)
    _register_model(kinds)


def _register_model(kinds: Any) -> None:
    from ingest.cli.model import add_model_arguments, run_model

    model = add_command(
        kinds,
        "model",
        run_model,
        "a model of COLMAP, OpenSfM or ODM, geo-referenced or of photos with GPS",
        description="Import a model of COLMAP, OpenSfM or OpenDroneMap as a map: as `featuredb export` "
        "wrote it, aligned to a known place, or of photos with GPS.",
    )
    add_model_arguments(model)


def _register_video(kinds: Any) -> None:
    from ingest.cli.video import add_video_arguments, run_video

    video = add_command(
        kinds,
        "video",
        run_video,
        "films and folders of them, with or without telemetry",
        description="Split films into shots, choose keyframes by the picture's motion, reconstruct those of "
        "all films together, place them by the telemetry where there is some, and commit the maps. Run the "
        "same command again to resume a killed ingest.",
    )
    add_video_arguments(video)
    _add_arguments(video)


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("which photos, and whose")
    group.add_argument(
        "--exclude",
        action="append",
        default=[],
        metavar="GLOB",
        help="skip files that match this glob; may be repeated",
    )
    group.add_argument("--name", default="", help="name of the map; default: the folder's name")
    group.add_argument("--owner", default="", help="owner of photos that state none")
    group.add_argument("--licence", default="", help="licence of photos that state none, e.g. CC-BY-4.0")
    group.add_argument(
        "--trust-geotags",
        action="store_true",
        help="positions of a table place active maps, as those of a folder do; by default such maps are "
        "quarantined",
    )
    group = parser.add_argument_group("how maps are made")
    group.add_argument(
        "--cameras",
        choices=("shared", "per-image"),
        default="shared",
        help="whether photos of one make, model, size and focal length share their intrinsics, and photos "
        "that name no camera those of the same owner, day (if known) and size; default: shared",
    )
    group.add_argument("--camera-model", help="COLMAP's name; default: SIMPLE_RADIAL")
    group.add_argument(
        "--keep-focal",
        action="store_true",
        help="hold focal lengths fixed: for nadir flights with a well-known camera, whose photos cannot "
        "separate focal length from height",
    )
    group.add_argument(
        "--max-features", type=int, help="per photo; default: 12000, for films 5000; fewer match faster"
    )
    group.add_argument(
        "--max-side",
        type=int,
        metavar="PX",
        help="longest side at which features are extracted; default: 2400",
    )
    group.add_argument(
        "--min-track-length",
        type=int,
        metavar="N",
        help="points seen by at least N photos carry descriptors; default: 3",
    )
    group.add_argument(
        "--height-datum",
        default="unknown",
        help="of the photos' heights: ellipsoidal, egm96, egm2008, navd88 or unknown (default)",
    )
    group.add_argument(
        "--gps-sigma",
        type=sigmas_m,
        metavar="M[,M]",
        help="standard deviation of the photos' positions in metres, horizontal and vertical, instead of "
        "what EXIF suggests",
    )
    group = parser.add_argument_group("ground control points")
    group.add_argument(
        "--gcp",
        type=Path,
        metavar="FILE",
        help="control points, OpenDroneMap's gcp_list.txt, which place the map instead of the photos' GPS",
    )
    add_control_arguments(group)
    group = parser.add_argument_group("how the job runs")
    group.add_argument("--workers", type=int, help="processes; default: one per core")
    group.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="of a Dask scheduler, e.g. tcp://10.0.0.1:8786, whose workers do the work; they need the work "
        "folder and the photos under the same paths (extra dask)",
    )
    group.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="where unfinished work is kept; default: DB/_work, or a cache folder for object stores",
    )
    group.add_argument("--report", type=Path, metavar="DIR", help="write report.json and report.html there")
    group.add_argument("--stop-after", choices=_STAGES, help="end after that stage; the next run resumes")
    group.add_argument("--quiet", action="store_true", help="no progress bars")


def run_photos(args: argparse.Namespace) -> int:
    return ingest_folder(args, args.folder)


def ingest_folder(args: argparse.Namespace, folder: Path, films: Sequence["FilmOutcome"] = ()) -> int:
    """Ingest, print what happened; 0 if a map is in the database, 1 if none is.

    Args:
        films: whose keyframes the folder holds, a folder for each.
    """
    from featuredb.store import Database
    from ingest.api.ingesting import IngestChoices, ingest, ingest_options, summary
    from ingest.photos.scan import require_photos

    choices = {name: getattr(args, name) for name in IngestChoices.__annotations__}
    options = ingest_options(films=bool(films), **choices)
    place_for_database(args)
    require_photos(folder)
    database = Database.create(args.db, storage_options=storage_options(args))
    report = ingest(database, folder, options, films, report=args.report, quiet=args.quiet)
    sys.stdout.write(summary(report))
    made = any(outcome.status not in ("refused", "retired") for outcome in report.maps)
    return 0 if made or args.stop_after else 1
