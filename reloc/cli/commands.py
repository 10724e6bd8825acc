"""Subcommands `query` and `localise`; `serve` and `live` have modules of their own."""

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.atomic import check_output
from featuredb.cli.common import add_command, open_database
from featuredb.errors import FeatureDbError, InvalidValueError, ServiceError
from reloc.wire.keys import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from featuredb.geometry.arrays import FloatArray
    from featuredb.store import Database
    from reloc.asking import PhotoAsker
    from reloc.wire.query import CameraRequest, LocaliseReply

    # A photo's bytes, its lens where it is known, and whether it is asked for the first time of two; the
    # answer, and further points of the map that the photo should show (easting, northing, height).
    Ask = Callable[[bytes, CameraRequest | None, bool], tuple[LocaliseReply, FloatArray | None]]


_NOT_LOCALISED = 1  # exit code: everything worked, and the answer is no


def register(subparsers: Any) -> None:
    """Add the subcommands to the parser of `featuredb`."""
    from reloc.cli.live import register as register_live
    from reloc.cli.serve import register as register_serve

    register_serve(subparsers)

    query = subparsers.add_parser(
        "query", help="ask a server where photos were taken", description="Ask a server over Zenoh."
    )
    query.add_argument("image", nargs="+", metavar="IMAGE", help="image file")
    add_server_arguments(query)
    query.add_argument("--timeout", type=float, default=10.0, metavar="SECONDS", help="per image; default 10")
    query.add_argument(
        "--contribute",
        action="store_true",
        help="give the photos to the database, so that its maps can grow; needs --credit and --licence",
    )
    query.add_argument("--credit", metavar="NAME", help="whom to name with them")
    query.add_argument("--licence", metavar="TERMS", help="under what terms they are given, e.g. CC-BY-4.0")
    _add_query_arguments(query)
    query.set_defaults(run=_query)

    register_live(subparsers)

    localise = add_command(
        subparsers,
        "localise",
        _localise,
        "localise photos without a server",
        description="The same as `query`, with the database opened here.",
    )
    localise.add_argument("image", nargs="+", metavar="IMAGE", help="image file")
    _add_query_arguments(localise)


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Which server is asked, and for which database."""
    parser.add_argument(
        "--connect",
        default=os.environ.get("FEATUREDB_CONNECT") or DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help="Zenoh endpoint of the server; default: FEATUREDB_CONNECT of the environment, or "
        + DEFAULT_ENDPOINT,
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="Zenoh configuration instead of --connect"
    )
    parser.add_argument(
        "--database",
        default=os.environ.get("FEATUREDB_DATABASE") or None,
        metavar="NAME",
        help="default: FEATUREDB_DATABASE of the environment, or the only one that is served",
    )


def add_request_arguments(parser: argparse.ArgumentParser) -> None:
    """What is known of a photo besides its pixels, and where to look."""
    parser.add_argument(
        "--prior",
        metavar="LAT,LON,SIGMA_M",
        help="prior of the position, WGS84 degrees and metres; with an equals sign if the latitude is "
        "negative: --prior=-33.86,151.21,25",
    )
    parser.add_argument(
        "--no-exif-prior",
        action="store_true",
        help="do not use the position in the photo's EXIF, which resolves ambiguity if there is no --prior",
    )
    parser.add_argument(
        "--camera",
        metavar="MODEL,WIDTH,HEIGHT,PARAMS...",
        help="intrinsics by COLMAP's model, e.g. PINHOLE,4000,3000,3200,3200,2000,1500",
    )
    parser.add_argument(
        "--camera-sigmas",
        metavar="SIGMAS...",
        help="one standard deviation of each of --camera's parameters, OPENCV's or SIMPLE_RADIAL's; without "
        "it they are exact",
    )
    parser.add_argument("--map", action="append", metavar="ID", help="search only this map; may be repeated")


def _add_query_arguments(parser: argparse.ArgumentParser) -> None:
    add_request_arguments(parser)
    parser.add_argument(
        "--shared-lens",
        action="store_true",
        help="photos of one camera, by EXIF and size, have one lens: it is estimated from all of them, three "
        "or more, and each is then answered with it; one photo hardly separates focal length from "
        "height. Not for zoom lenses without EXIF, nor for cropped pictures",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON reply per line")
    parser.add_argument(
        "--overlay",
        type=Path,
        metavar="PNG",
        help="write the photo with the projected map; with several images their names are appended",
    )


def _query(args: argparse.Namespace) -> int:
    from reloc.client import Client

    camera, told = _told(args)
    if args.contribute and not (args.credit and args.licence):
        raise InvalidValueError(
            "--contribute: expected --credit and --licence, too: whom to name with them, and the terms"
        )
    require_an_image(args.image)
    _check_overlays(args)
    with Client(args.connect, args.database, config_path=args.config) as client:

        def ask(data: bytes, lens: "CameraRequest | None", first: bool) -> "tuple[LocaliseReply, None]":
            reply = client.localise(
                data,
                camera=lens or camera,
                timeout_s=args.timeout,
                inliers=first or args.overlay is not None,
                contribute=args.contribute and not first,
                credit=args.credit,
                licence=args.licence,
                **told,
            )
            return reply, None

        return _answer_all(args, ask, client.database)


def _localise(args: argparse.Namespace) -> int:
    require_an_image(args.image)
    _check_overlays(args)
    asker, ask = asking_here(args, lambda: open_database(args), inliers=args.overlay is not None)
    return _answer_all(args, ask, asker.name)


def asking_here(
    args: argparse.Namespace, database: "Callable[[], Database]", inliers: bool = False
) -> "tuple[PhotoAsker, Ask]":
    """What answers in this process, to what `add_request_arguments` was told; that is checked first.

    Raises:
        InvalidValueError: the prior or the camera is none.
    """
    from reloc.asking import PhotoAsker

    camera, told = _told(args)
    asker = PhotoAsker(database())

    def ask(
        data: bytes, lens: "CameraRequest | None", first: bool
    ) -> "tuple[LocaliseReply, FloatArray | None]":
        answer = asker.ask(data, camera=lens or camera, inliers=first or inliers, **told)
        return answer.reply, answer.other_points_utm

    return asker, ask


def _told(args: argparse.Namespace) -> "tuple[CameraRequest | None, dict[str, Any]]":
    """What `add_request_arguments` was told: the camera, and what else `ask` and `localise` take alike."""
    from reloc.cli.query_arguments import parse_camera, parse_prior

    maps, exif_prior = tuple(args.map) if args.map else None, not args.no_exif_prior
    told = {"prior": parse_prior(args.prior), "exif_prior": exif_prior, "maps": maps}
    return parse_camera(args.camera, args.camera_sigmas), told


def require_an_image(paths: list[str]) -> None:
    """Before maps are loaded, or a server is waited for.

    Raises:
        InvalidValueError: none of the paths is a file.
    """
    if not any(Path(path).is_file() for path in paths):
        raise InvalidValueError(f"{', '.join(paths)}: expected a photo, found no such file; check the path")


def _overlay_of(args: argparse.Namespace, image: Path) -> Path:
    target: Path = args.overlay
    if len(args.image) == 1:
        return target
    return target.with_name(f"{target.stem}-{image.stem}{target.suffix or '.png'}")


def _check_overlays(args: argparse.Namespace) -> None:
    for image in args.image if args.overlay is not None else ():
        check_output("--overlay", _overlay_of(args, Path(image)), *args.image)


def _answer_all(args: argparse.Namespace, ask: "Ask", database: str) -> int:
    """Ask for each image, print the answers; 0 if all were localised, 1 if some were not, 2 on errors."""
    from reloc.wording import describe

    codes = {0}
    lenses = _shared_lenses(args, ask) if args.shared_lens else {}
    for path in map(Path, args.image):
        try:
            data = path.read_bytes()
            reply, other_points = ask(data, lenses.get(path), False)
            told = {"image": str(path), "database": database, **reply.model_dump(mode="json")}
            text = json.dumps(told) + "\n" if args.json else describe(str(path), reply, database)
            sys.stdout.write(text)
            sys.stdout.flush()
            if reply.status == "not_localised":
                codes.add(_NOT_LOCALISED)
            if args.overlay is not None and reply.status != "localised":
                why = " of a map without a place" if reply.in_map else ", as it was not localised"
                sys.stderr.write(f"featuredb: {path}: no overlay{why}\n")
            elif args.overlay is not None:
                from reloc.overlay import write_overlay

                target = _overlay_of(args, path)
                write_overlay(target, data, reply, other_points)
                sys.stderr.write(f"wrote {target}\n")
        except (OSError, FeatureDbError) as error:
            sys.stderr.write(f"featuredb: {path}: {getattr(error, 'strerror', None) or error}\n")
            codes.add(2)
            if isinstance(error, ServiceError) and error.code == "NO_SERVER":
                break
    return max(codes)


def _shared_lenses(args: argparse.Namespace, ask: "Ask") -> "dict[Path, CameraRequest]":
    """Ask for each image once, and find the lens that all photos of a camera agree on; says it on stderr."""
    from featuredb.features.exif.read import read_exif
    from reloc.cli.query_arguments import as_arguments
    from reloc.shared_lens import lenses_of_cameras, views_of

    if args.camera is not None:
        raise InvalidValueError(
            "--shared-lens: expected no --camera, which is the lens of all photos already"
        )
    paths: list[Path] = []
    keys: list[str] = []
    replies: list[LocaliseReply] = []
    for path in map(Path, args.image):
        try:
            data = path.read_bytes()
            reply, _ = ask(data, None, True)
        except (OSError, FeatureDbError) as error:
            if isinstance(error, ServiceError) and error.code == "NO_SERVER":
                break
            continue  # said when it is asked for again
        if reply.camera is not None:
            exif = read_exif(data)
            paths.append(path)
            keys.append(exif.camera_key or f"no EXIF, {reply.camera.width}x{reply.camera.height}")
            replies.append(reply)
    lenses, asked_with = lenses_of_cameras(keys, views_of(replies))
    for key in dict.fromkeys(keys):
        lens = lenses.get(key)
        if lens is None:
            sys.stderr.write(f"{key}: no lens that three photos or more agree on\n")
        else:
            said = as_arguments(lens.as_request())
            sys.stderr.write(f"{key}: lens of {lens.agree.sum()} of {len(lens.agree)} photos: {said}\n")
    return {p: lens for p, lens in zip(paths, asked_with, strict=True) if lens is not None}
