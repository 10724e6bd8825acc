"""`featuredb live VIDEO`: a film or a camera to a server, poses as they come, a trajectory in the end."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from reloc.client.film import OnPose, StreamedFilm
    from reloc.wire.track import TrackPose

_SAID_EVERY_S = 1.0  # of the film's clock, for people
# Python changes threads after so long: a pose that has come need not wait 5 ms for the next frame.
_SWITCH_S = 5e-4


def register(subparsers: Any) -> None:
    """Add `live` to the parser of `featuredb`."""
    from reloc.cli.commands import add_server_arguments

    parser = subparsers.add_parser(
        "live",
        help="follow a camera or a film by a server, live",
        description="Stream a film at its own speed, or a camera, to `featuredb serve`, and print where it "
        "is as the poses come. See docs/video.md.",
    )
    parser.add_argument(
        "video",
        metavar="VIDEO",
        help="film, folder of pictures, camera (/dev/video0) or address (rtsp://...)",
    )
    add_server_arguments(parser)
    parser.add_argument(
        "--out",
        action="append",
        type=Path,
        default=[],
        metavar="FILE",
        help="trajectory of the answered frames: .csv, .tum, .geojson, .kml or .json; may be repeated",
    )
    add_film_arguments(parser)
    parser.add_argument("--max-side", type=int, default=1280, metavar="PX", help="frames are sent at; 1280")
    parser.add_argument("--json", action="store_true", help="print each pose as a line of JSON")
    parser.set_defaults(run=run_live)


def add_film_arguments(parser: argparse.ArgumentParser) -> None:
    """What is known of a film, and how it is read."""
    parser.add_argument(
        "--camera",
        metavar="MODEL,WIDTH,HEIGHT,PARAMS...",
        help="intrinsics of the upright frames by COLMAP's model; default: estimated with the first pose",
    )
    parser.add_argument(
        "--prior", metavar="LAT,LON,SIGMA_M", help="where the film begins, WGS84 degrees and metres"
    )
    parser.add_argument(
        "--fps", type=float, metavar="N", help="frames per second of a folder without a file of times"
    )
    parser.add_argument("--start", type=float, metavar="S", help="of the film; default: its beginning")
    parser.add_argument("--end", type=float, metavar="S", help="of the film; default: its end")


def run_live(args: argparse.Namespace) -> int:
    """Stream, print, write; 0, 1 where no frame was localised, 2 where a file could not be written or the
    session ended before the film, 130 where that was stopped.
    """
    from featuredb.stop_signals import sigterm_as_ctrl_c
    from featuredb.video.film import VideoOptions
    from reloc.cli.query_arguments import parse_camera, parse_prior
    from reloc.client.client import Client
    from reloc.client.film import stream_film
    from reloc.tracking.trajectory.files import check_outputs, exit_code, write_outputs

    sys.setswitchinterval(_SWITCH_S)
    check_outputs(args.out, args.video)
    camera, prior = parse_camera(args.camera), parse_prior(args.prior)
    with sigterm_as_ctrl_c(), Client(args.connect, args.database, config_path=args.config) as client:
        found = stream_film(
            client,
            args.video,
            camera=camera,
            prior=prior,
            options=VideoOptions(max_side_px=args.max_side, start_s=args.start, end_s=args.end, fps=args.fps),
            on_pose=_as_json if args.json else _teller(),
        )
    outputs = write_outputs(args.out, found.trajectory)
    (sys.stderr if args.json else sys.stdout).write(_text(found, outputs.written))
    return exit_code(outputs, found.trajectory, stopped=found.stopped, lost=found.lost)


def _as_json(pose: "TrackPose", latency_ms: float | None) -> None:
    sys.stdout.write(json.dumps({**pose.model_dump(mode="json"), "latency_ms": latency_ms}) + "\n")
    sys.stdout.flush()


def _teller() -> "OnPose":
    """Says where the camera is once a second, and each time when the track is found or lost."""
    said: tuple[str, float] | None = None

    def tell(pose: "TrackPose", latency_ms: float | None) -> None:
        nonlocal said
        known = "lost" if pose.state == "lost" else "known"
        if said is not None and said[0] == known and pose.time_s - said[1] < _SAID_EVERY_S:
            return
        said = (known, pose.time_s)
        sys.stdout.write(_line(pose, latency_ms))
        sys.stdout.flush()

    return tell


def _line(pose: "TrackPose", latency_ms: float | None) -> str:
    head = f"{pose.time_s:9.2f} s  {pose.state:11s}"
    if pose.utm is None or pose.accuracy is None:
        return f"{head}  {pose.detail}\n"
    late = "" if latency_ms is None else f"  {latency_ms:.0f} ms"
    return (
        f"{head}  EPSG:{pose.utm.epsg} E {pose.utm.easting:.2f} N {pose.utm.northing:.2f} "
        f"height {pose.utm.height:.2f} m  68 % {pose.accuracy.horizontal_68_m:.2f} m  "
        f"{pose.inliers} landmarks{late}\n"
    )


def _text(found: "StreamedFilm", written: tuple[str, ...]) -> str:
    import numpy as np

    points = found.trajectory.points
    known = sum(point.pose is not None for point in points)
    lines = [
        f"{found.trajectory.source}: {found.frames} frames, {found.sent} sent, {len(points)} answered, "
        f"{known} with a pose"
    ]
    if len(found.latency_ms):
        p50, p95 = np.percentile(found.latency_ms, [50, 95])
        lines.append(f"  from sending a frame to its pose: median {p50:.0f} ms, 95 % within {p95:.0f} ms")
    lines += [f"  {what}" for what in found.complaints]
    lines += [f"  refused: {what}" for what in found.refusals[-3:]]
    lines += [f"  wrote {file}" for file in written]
    return "\n".join(lines) + "\n"
