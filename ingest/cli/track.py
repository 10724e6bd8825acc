"""`featuredb track DB VIDEO --out FILE`: arguments in, files and a summary out."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from featuredb.geometry.camera import Camera
    from featuredb.maps.feature_map import GeoPrior
    from reloc.tracking.track_video import TrackedVideo


def register(subparsers: Any) -> None:
    """Add `track` to the parser of `featuredb`."""
    from featuredb.cli.common import add_database_argument

    parser = subparsers.add_parser(
        "track",
        help="the pose of every frame of a video",
        description="Follow a video by the active maps, by a LiDAR scan, or by both. Each frame has a pose "
        "with its uncertainty, or is said to be lost. See docs/video.md.",
    )
    add_database_argument(parser)
    parser.add_argument("video", metavar="VIDEO", help="film, folder of pictures, or an address (rtsp://...)")
    parser.add_argument(
        "--out",
        action="append",
        type=Path,
        required=True,
        metavar="FILE",
        help="trajectory: .csv (every frame), .tum, .geojson, .kml, .json (OGC GeoPose series), .srt, or "
        "drawn: .png; may be repeated",
    )
    parser.add_argument(
        "--overlay", type=Path, metavar="MP4", help="write the film with the track drawn over it"
    )
    parser.add_argument(
        "--camera",
        metavar="MODEL,WIDTH,HEIGHT,PARAMS...",
        help="intrinsics of the upright frames by COLMAP's model; default: estimated with the first pose",
    )
    parser.add_argument(
        "--prior", metavar="LAT,LON,SIGMA_M", help="where the film begins, WGS84 degrees and metres"
    )
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
        help="what the film is followed by: the maps, a scan alone, or the scan where the maps know nothing; "
        "default: map",
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
    parser.add_argument("--start", type=float, metavar="S", help="of the film; default: its beginning")
    parser.add_argument("--end", type=float, metavar="S", help="of the film; default: its end")
    parser.add_argument(
        "--max-side", type=int, default=1280, metavar="PX", help="frames are tracked at; default 1280"
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=run_track)


def run_track(args: argparse.Namespace) -> int:
    """Track and write; 0, 1 where no frame was localised, 2 where a file could not be written.

    Raises:
        InvalidValueError, VideoError, StoreError, ServiceError, RegistrationError, ScanNotFoundError
    """
    from dataclasses import replace

    from featuredb.cli.common import open_database
    from featuredb.errors import InvalidValueError
    from ingest.track.finders import FilmGround, finder_for
    from reloc.localise.result import LocaliseRequest
    from reloc.tracking.map_ground import MapFinder
    from reloc.tracking.track_video import TrackVideoOptions, track_video
    from reloc.tracking.trajectory.outputs import (
        check_outputs,
        check_outputs_in_map,
        exit_code,
        write_outputs,
    )

    check_outputs(args.out)
    options = TrackVideoOptions(max_side_px=args.max_side, start_s=args.start, end_s=args.end)
    camera = _camera(args.camera)
    database = open_database(args)
    asked = FilmGround(
        by=args.by,
        maps=tuple(args.map) if args.map else None,
        scans=tuple(args.scan) if args.scan else None,
        pose_file=args.pose,
    )
    finder, version = finder_for(database, asked, camera, options.track)
    prior = _prior(args.prior)
    if isinstance(finder, MapFinder) and finder.own_map is not None:
        check_outputs_in_map(args.out, finder.own_map)
        if prior is not None:
            raise InvalidValueError(
                f"--prior is a place on Earth, and map {finder.own_map} has none; leave it out"
            )
    found = track_video(
        args.video,
        finder,
        camera=camera,
        request=LocaliseRequest(prior=prior),
        overlay=args.overlay,
        options=options,
    )
    trajectory = replace(found.trajectory, database=args.db, version=version)
    found = replace(found, trajectory=trajectory)
    outputs = write_outputs(args.out, trajectory)
    summary = _summary(found, [*outputs.written, *([str(args.overlay)] if args.overlay else [])])
    sys.stdout.write(json.dumps(summary) + "\n" if args.json else _text(summary))
    return exit_code(outputs, trajectory)


def _camera(text: str | None) -> "Camera | None":
    from featuredb.geometry.camera import Camera
    from reloc.cli.query_arguments import parse_camera

    asked = parse_camera(text)
    if asked is None:
        return None
    return Camera(model=asked.model, width=asked.width, height=asked.height, params=asked.params)


def _prior(text: str | None) -> "GeoPrior | None":
    from featuredb.maps.feature_map import GeoPrior
    from reloc.cli.query_arguments import parse_prior

    asked = parse_prior(text)
    if asked is None:
        return None
    return GeoPrior(
        latitude_deg=asked.lat,
        longitude_deg=asked.lon,
        height_m=None,
        sigma_horizontal_m=asked.sigma_m,
        sigma_vertical_m=asked.sigma_vertical_m,
    )


def _summary(found: "TrackedVideo", written: list[str]) -> dict[str, Any]:
    points = found.trajectory.points
    states = {state: sum(p.state == state for p in points) for state in ("tracking", "relocalised", "lost")}
    seconds = found.seconds
    lost = [p for p in points if p.state == "lost"]
    return {
        "video": found.trajectory.source,
        "frames": len(points),
        **states,
        "stretches": [list(times) for times in found.trajectory.times_found()],
        "frame": "own" if found.trajectory.is_in_map else "earth",
        "last_reason": lost[-1].detail if lost else "",
        "frames_per_s": round(len(points) / max(seconds.total, 1e-9), 1),
        "seconds": {
            name: round(getattr(seconds, name), 3)
            for name in ("total", "decoding", "tracking", "drawing", "longest_gap")
        },
        "camera": None
        if found.camera is None
        else {
            "model": found.camera.model,
            "width": found.camera.width,
            "height": found.camera.height,
            "params": list(found.camera.params),
        },
        "complaints": list(found.complaints),
        "written": written,
    }


def _text(summary: dict[str, Any]) -> str:
    lines = [
        f"{summary['video']}: {summary['frames']} frames, {summary['tracking']} tracked, "
        f"{summary['relocalised']} relocalised, {summary['lost']} lost",
    ]
    lines += [f"  from {a:.2f} s to {b:.2f} s" for a, b in summary["stretches"]]
    if summary["last_reason"]:
        lines.append(f"  lost at the end or before: {summary['last_reason']}")
    seconds = summary["seconds"]
    lines.append(
        f"  {summary['frames_per_s']} frames a second: {seconds['decoding']:.1f} s decoding, "
        f"{seconds['tracking']:.1f} s tracking, {seconds['drawing']:.1f} s drawing; longest gap "
        f"{1000 * seconds['longest_gap']:.0f} ms"
    )
    if summary["frame"] == "own":
        lines.append("  poses are in the map's own frame, and say nothing of where on Earth that is")
    lines += [f"  the film: {what}" for what in summary["complaints"]]
    lines += [f"  wrote {file}" for file in summary["written"]]
    return "\n".join(lines) + "\n"
