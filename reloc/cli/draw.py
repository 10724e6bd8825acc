"""Subcommand `draw`; what it needs is imported when it runs."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.atomic import atomic_file, check_output
from featuredb.cli.common import open_database
from featuredb.errors import InvalidValueError

if TYPE_CHECKING:
    from reloc.pixels.layer import Shape

_NO_POSE = 1  # exit code: everything worked, and there is no pose
_REACH_M = 150.0  # beyond the track of a film, of the scan that is loaded


def register(subparsers: Any) -> None:
    """Add `draw` to the parser of `featuredb`."""
    from reloc.cli.commands import add_request_arguments
    from reloc.cli.locate import add_view_arguments

    draw = subparsers.add_parser(
        "draw",
        help="draw a GIS layer over a photo or a film",
        description="Draw points, lines and polygons of a GeoJSON file where a photo's answered pose, or the "
        "track of a film, sees them; what the scan hides is left out.",
    )
    draw.add_argument("image", metavar="IMAGE|FILM", help="image file, or a film with --track")
    draw.add_argument(
        "layer", type=Path, metavar="GEOJSON", help="longitude, latitude of WGS84, or its own crs"
    )
    add_view_arguments(draw)
    draw.add_argument("--out", type=Path, required=True, metavar="FILE", help="picture, or .mp4 of a film")
    draw.add_argument(
        "--track",
        type=Path,
        metavar="CSV",
        help="where a film's frames were: `featuredb track --out NAME.csv`",
    )
    add_request_arguments(draw)
    draw.set_defaults(run=_draw)


def _draw(args: argparse.Namespace) -> int:
    from reloc.pixels.layer import read_layer

    check_output("--out", args.out, args.image, args.layer, args.answer, args.track)
    layer = read_layer(args.layer)
    if args.track is not None:
        return _draw_film(args, layer)
    import cv2
    import numpy as np

    from featuredb.features.decode import decode_rgb
    from reloc.cli.commands import require_an_image
    from reloc.cli.locate import answered_view
    from reloc.pixels.layer import draw_layer, laid_on
    from reloc.pixels.surfaces import scan_surface

    require_an_image([args.image])
    suffix = args.out.suffix or ".png"
    if not cv2.haveImageWriter(f"picture{suffix}"):
        raise InvalidValueError(f"--out: expected a picture such as drawn.png or drawn.jpg, found {args.out}")
    rgb = decode_rgb(Path(args.image).read_bytes())
    database = open_database(args)
    view, _ = answered_view(args, database)
    if view is None:
        return _NO_POSE
    camera, (height, width) = view.camera, rgb.shape[:2]
    try:
        camera.scaled_to(width, height)
    except InvalidValueError as error:
        raise InvalidValueError(
            f"draw: expected the picture that the answer is about, or a reduced one, of the shape of "
            f"{camera.width}x{camera.height} pixels, found {width}x{height}"
        ) from error
    surface = scan_surface(database, view)
    cloud = None if surface is None else surface.cloud
    picture = draw_layer(rgb, view, laid_on(layer, view.frame, cloud), cloud)
    try:
        done, data = cv2.imencode(suffix, np.ascontiguousarray(picture[:, :, ::-1]))
    except cv2.error:
        done = False
    if not done:
        raise InvalidValueError(f"--out: {suffix} cannot hold {width}x{height} pixels; try .png")
    with atomic_file(args.out) as part:
        part.write_bytes(data.tobytes())
    sys.stderr.write(f"wrote {args.out}\n")
    return 0


def _draw_film(args: argparse.Namespace, layer: "list[Shape]") -> int:
    import numpy as np

    from featuredb.video.frames import open_video
    from featuredb.video.writer import VideoWriter
    from reloc.answered_view import AnsweredView, camera_of
    from reloc.cli.query_arguments import parse_camera
    from reloc.pixels.layer import draw_layer, laid_on
    from reloc.pixels.surfaces import scan_surface
    from reloc.tracking.trajectory.files import read_trajectory_csv

    asked = parse_camera(args.camera)
    if asked is None:
        raise InvalidValueError(
            "draw: expected --camera, the lens of the film, which its track does not tell"
        )
    lens = camera_of(asked)
    poses = {point.index: point.pose for point in read_trajectory_csv(args.track).points if point.pose}
    if not poses:
        sys.stderr.write(f"featuredb: {args.track}: no frame has a pose on Earth\n")
        return _NO_POSE
    with open_video(args.image) as video:
        camera = lens.scaled_to(video.info.width, video.info.height)
        views = {}
        for index, pose in poses.items():
            known = {"camera": camera, "covariance": pose.covariance, "height_datum": pose.height_datum}
            views[index] = AnsweredView.at(pose.utm, pose.epsg, pose.cam_from_utm_xyzw, **known)
        first = next(iter(views.values()))
        # The scan along the track, in the frame of its first view.
        places = np.array([view.seen_in(first.frame).cam_from_local.center[:2] for view in views.values()])
        (e0, n0), (e1, n1) = places.min(axis=0) - _REACH_M, places.max(axis=0) + _REACH_M
        surface = scan_surface(open_database(args), first, (float(e0), float(n0), float(e1), float(n1)))
        cloud = None if surface is None else surface.cloud
        shapes = laid_on(layer, first.frame, cloud)
        width, height = video.info.width // 2 * 2, video.info.height // 2 * 2
        with VideoWriter(args.out, width=width, height=height, fps=None) as film:
            for frame in video:
                rgb = frame.rgb()
                view = views.get(frame.index)
                if view is not None:
                    rgb = draw_layer(rgb, view.seen_in(first.frame), shapes, cloud)
                film.write(np.ascontiguousarray(rgb[:height, :width]), frame.time_s)
    sys.stderr.write(f"wrote {args.out}: {len(views)} frames with a pose\n")
    return 0
