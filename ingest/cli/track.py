"""`featuredb track DB VIDEO --out FILE`: arguments in, files and a summary out."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from featuredb.cli.common import add_command, open_database
from reloc.cli.live import add_film_arguments


def register(subparsers: Any) -> None:
    parser = add_command(
        subparsers,
        "track",
        run_track,
        "the pose of every frame of a video",
        description="Follow a video by the active maps, by a LiDAR scan, or by both. Each frame has a pose "
        "with its uncertainty, or is said to be lost. See docs/video.md.",
    )
    parser.add_argument("video", metavar="VIDEO", help="film, folder of pictures, or an address (rtsp://...)")
    parser.add_argument(
        "--out",
        action="append",
        type=Path,
        required=True,
        metavar="FILE",
        help="trajectory: .csv (every frame), .tum, .geojson, .kml or .json (OGC GeoPose series); "
        "may be repeated",
    )
    parser.add_argument(
        "--overlay", type=Path, metavar="MP4", help="write the film with the track drawn over it"
    )
    add_film_arguments(parser)
    parser.add_argument(
        "--map",
        action="append",
        metavar="ID",
        help="track by this map; may be repeated. One without a place is named alone, and the poses are in "
        "its own frame",
    )
    parser.add_argument(
        "--by",
        choices=("map", "scan", "both"),
        default="map",
        help="track against the maps, a scan alone, or the scan where the maps have no points; default: map",
    )
    parser.add_argument(
        "--scan", action="append", metavar="ID", help="with --by scan or both; default: all scans there"
    )
    parser.add_argument(
        "--pose",
        type=Path,
        metavar="FILE",
        help="coarse pose of the first frame, JSON as for `featuredb anchor --pose`; a scan alone needs it",
    )
    parser.add_argument(
        "--max-side", type=int, default=1280, metavar="PX", help="frames are tracked at; default 1280"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run_track(args: argparse.Namespace) -> int:
    """Track and write; 0, 1 where no frame was localised, 2 where a file could not be written, 130 where the
    film was stopped before its end.

    Raises:
        InvalidValueError, VideoError, StoreError, ServiceError, RegistrationError, ScanNotFoundError
    """
    from featuredb.stop_signals import sigterm_as_ctrl_c
    from ingest.api.tracking import track_film
    from ingest.track.finders import FilmGround
    from reloc.answered_view import camera_of, geo_prior
    from reloc.cli.query_arguments import parse_camera, parse_prior
    from reloc.tracking.track_video import TrackVideoOptions
    from reloc.tracking.trajectory.files import exit_code

    camera, prior = parse_camera(args.camera), parse_prior(args.prior)
    with sigterm_as_ctrl_c():
        done = track_film(
            open_database(args),
            args.video,
            out=args.out,
            overlay=args.overlay,
            ground=FilmGround(
                by=args.by,
                maps=tuple(args.map) if args.map else None,
                scans=tuple(args.scan) if args.scan else None,
                pose_file=args.pose,
            ),
            camera=None if camera is None else camera_of(camera),
            prior=None if prior is None else geo_prior(prior),
            options=TrackVideoOptions(
                max_side_px=args.max_side, start_s=args.start, end_s=args.end, fps=args.fps
            ),
        )
    sys.stdout.write(json.dumps(done.summary()) + "\n" if args.json else done.as_text())
    return exit_code(done.outputs, done.video.trajectory, stopped=done.video.stopped)
