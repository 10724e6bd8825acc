"""Subcommand `locate`; what it needs is imported when it runs."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.atomic import atomic_file, check_output
from featuredb.cli.common import numbers, open_database
from featuredb.errors import InvalidValueError

if TYPE_CHECKING:
    from featuredb.store import Database
    from reloc.answered_view import AnsweredView
    from reloc.localiser import Localiser
    from reloc.pixels.locate import MarkedPixel, PixelPlace
    from reloc.pixels.surfaces import RaySurface
    from reloc.wire.query import LocaliseReply

_NO_PLACE = 1  # exit code: everything worked, and a pixel or the photo has no place


def register(subparsers: Any) -> None:
    """Add `locate` to the parser of `featuredb`."""
    from reloc.cli.commands import add_request_arguments

    locate = subparsers.add_parser(
        "locate",
        help="say where on Earth what a photo shows at a pixel is",
        description="Where on Earth the ray of a pixel meets the scan of the database, or its map. The photo "
        "is localised first, unless --answer has its pose.",
    )
    locate.add_argument("image", metavar="IMAGE", help="image file")
    add_view_arguments(locate)
    locate.add_argument(
        "--pixel",
        action="append",
        type=lambda text: numbers(text, "U,V such as 812.5,640", 2),
        default=[],
        metavar="U,V",
        help="pixel of the stored picture, the centre of the top-left one being 0.5,0.5; may be repeated",
    )
    locate.add_argument("--boxes", type=Path, metavar="JSON", help="boxes of a detector, in COCO's JSON")
    locate.add_argument(
        "--foot",
        choices=("bottom", "centre"),
        default="bottom",
        help="which point of a box is located: the middle of its lower side, or its centre; default bottom",
    )
    locate.add_argument(
        "--surface",
        choices=("auto", "scan", "map"),
        default="auto",
        help="what rays are to meet; default: the scan where there is one, else the map",
    )
    locate.add_argument(
        "--pixel-sigma", type=float, default=0.0, metavar="PX", help="how exact the pixels are; default 0"
    )
    locate.add_argument(
        "--scan-sigma",
        type=float,
        metavar="M",
        help="what neighbouring points of the scan are off by together, one standard deviation along the "
        "surface's normal; default: half of how far they scatter",
    )
    locate.add_argument("--geojson", type=Path, metavar="FILE", help="write the places as GeoJSON")
    locate.add_argument("--json", action="store_true", help="print one JSON object per pixel")
    add_request_arguments(locate)
    locate.set_defaults(run=_locate)


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """The database and where the photo's pose comes from."""
    parser.add_argument("--database", dest="db", required=True, metavar="DB", help="folder or URL")
    parser.add_argument(
        "--storage-option", metavar="KEY=VALUE", action="append", default=[], help="of the object store"
    )
    parser.add_argument(
        "--answer",
        type=Path,
        metavar="JSON",
        help="the photo's answer, as `localise --json` or `query --json` prints it, instead of localising it",
    )


def _locate(args: argparse.Namespace) -> int:
    import json

    from reloc.cli.commands import require_an_image
    from reloc.pixels.locate import MarkedPixel, as_json, geojson, locate

    if args.answer is None:
        require_an_image([args.image])
    if args.geojson is not None:
        check_output("--geojson", args.geojson, args.image, args.answer, args.boxes)
    marks = [MarkedPixel(pixel=pixel) for pixel in args.pixel]
    if args.boxes is not None:
        marks += _boxes(args)
    if not marks:
        raise InvalidValueError("locate: expected --pixel U,V or --boxes JSON, found neither")
    for name in ("pixel_sigma", "scan_sigma"):
        value = getattr(args, name)
        if value is not None and not 0.0 <= value < float("inf"):
            raise InvalidValueError(
                f"--{name.replace('_', '-')}: expected a number, 0 or more, found {value}"
            )
    database = open_database(args)
    view, localiser = answered_view(args, database)
    if view is None:
        return _NO_PLACE
    surface = _surface(args, database, view, localiser)
    places = locate(view, surface, [mark.pixel for mark in marks], args.pixel_sigma)
    for place in places:
        sys.stdout.write(json.dumps(as_json(place)) + "\n" if args.json else _describe(place))
    if args.geojson is not None:
        with atomic_file(args.geojson) as part:
            part.write_text(json.dumps(geojson(places, marks, Path(args.image).name), indent=1) + "\n")
        sys.stderr.write(f"wrote {args.geojson}\n")
    return _NO_PLACE if any(place.utm is None for place in places) else 0


def _boxes(args: argparse.Namespace) -> "list[MarkedPixel]":
    """The foot points of boxes; says on stderr where they may be those of a turned picture."""
    from featuredb.features.exif.read import read_exif
    from featuredb.features.image_header import read_header
    from reloc.answered_view import AnsweredView
    from reloc.pixels.locate import read_coco

    photo = Path(args.image)
    data = photo.read_bytes() if photo.is_file() else b""
    picture = (
        read_header(data)
        if args.answer is None
        else AnsweredView.of_reply(_read_answer(args.answer, photo)).camera
    )
    marks, says_size = read_coco(args.boxes, args.image, args.foot, (picture.width, picture.height))
    orientation = read_exif(data).orientation if data else 1
    if orientation != 1 and not (says_size and orientation > 4):  # up to 4 both have the same size
        sys.stderr.write(
            f"featuredb: {photo}: EXIF turns the picture (orientation {orientation}), and {args.boxes} does "
            "not say which its boxes are of; they are taken as those of the stored one, unturned\n"
        )
    return marks


def answered_view(
    args: argparse.Namespace, database: "Database"
) -> "tuple[AnsweredView | None, Localiser | None]":
    """The camera of the answer, and what has localised it here; no camera where there is no pose on Earth."""
    from reloc.answered_view import AnsweredView

    if args.answer is not None:
        return AnsweredView.of_reply(_read_answer(args.answer, Path(args.image))), None
    from reloc.cli.commands import asking_here
    from reloc.wording import describe

    data = Path(args.image).read_bytes()
    asker, ask = asking_here(args, lambda: database)
    reply, _ = ask(data, None, False)
    if reply.status != "localised":
        sys.stderr.write(describe(args.image, reply, asker.name))
        return None, asker.localiser()
    return AnsweredView.of_reply(reply), asker.localiser()


def _read_answer(path: Path, image: Path) -> "LocaliseReply":
    """The answer about a photo: the one of its file name, or the only one where that has none."""
    import json

    from reloc.wire.query import LocaliseReply

    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        names = [Path(line.get("image") or (image if len(lines) == 1 else "")).name for line in lines]
        if names.count(image.name) != 1:
            raise ValueError(f"{names.count(image.name)} among answers about {', '.join(names) or 'nothing'}")
        answer = lines[names.index(image.name)]
        return LocaliseReply.model_validate_json(json.dumps(answer))
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InvalidValueError(
            f"--answer: expected one answer about {image.name} in {path}, a line of JSON as "
            f"`localise --json` prints it, found {type(error).__name__}: {error!s:.200}"
        ) from error


def _surface(
    args: argparse.Namespace, database: "Database", view: "AnsweredView", localiser: "Localiser | None"
) -> "RaySurface":
    from dataclasses import replace

    from reloc.localiser import Localiser
    from reloc.overlay import map_points_in_view
    from reloc.pixels.surfaces import MapSurface, scan_surface

    scan = None if args.surface == "map" else scan_surface(database, view)
    if scan is not None:
        return replace(scan, common_m=args.scan_sigma)
    if args.surface == "scan":
        raise InvalidValueError(
            f"--surface scan: expected a scan around the camera with heights of {view.height_datum}, as "
            "the answer's are, found none; `featuredb lidar list` shows what there is"
        )
    areas = (localiser or Localiser.open(database)).areas_of(view.map_ids[:1])
    points_utm = map_points_in_view(areas, view)
    return MapSurface(points=view.frame.enu_from_utm(points_utm, view.epsg))


def _describe(place: "PixelPlace") -> str:
    u, v = place.pixel
    name = f"pixel {u:g},{v:g}"
    if place.utm is None:
        return f"{name}: no place: {place.reason} ({place.detail})\n"
    assert place.lat_lon_h is not None
    easting, northing, height = place.utm
    latitude, longitude, _ = place.lat_lon_h
    doubt = f"\n  but       {place.detail}" if place.detail else ""
    return (
        f"{name}: {place.distance_m:.1f} m away, on the {place.surface}\n"
        f"  UTM       EPSG:{place.epsg}  E {easting:.3f}  N {northing:.3f}  "
        f"height {height:.3f} m ({place.height_datum})\n"
        f"  WGS84     {latitude:.8f}, {longitude:.8f}\n"
        f"  68 %      {place.horizontal_68_m:.3f} m horizontally, {place.vertical_68_m:.3f} m vertically"
        f"{doubt}\n"
    )
