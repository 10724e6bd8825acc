"""`featuredb anchor DB MAP`: arguments in; proposals, pictures, a report, a placed map out."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from featuredb.cli.common import add_command, open_database

if TYPE_CHECKING:
    from featuredb.store import Database
    from ingest.anchoring import AnchorRequest

_EPILOG = """\
Without --auto and --confirm nothing is changed: the frames that register best are shown, with the command
that confirms them. A rough pose is JSON: {"image": "A.JPG", "easting": ..., "northing": ..., "height": ...,
"yaw_deg": ..., "pitch_deg": -90} or "look_at": [e, n, h] for the angles. Picks are CSV lines of
x, y, easting, northing, height: full-size pixels and metres. See docs/anchoring.md."""


def register(subparsers: Any) -> None:
    anchor = add_command(
        subparsers,
        "anchor",
        run_anchor,
        "place a map by a LiDAR scan",
        description="Register frames of a map to a scan of the database, and place the map by them. The old "
        "placement stays reachable: `featuredb rollback`.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    anchor.add_argument("map_id", metavar="MAP", help="id of the map; its first letters are enough")
    anchor.add_argument(
        "--photos", type=Path, required=True, metavar="FOLDER", help="the photos that the map was made of"
    )
    anchor.add_argument(
        "--scan",
        action="append",
        default=[],
        metavar="ID",
        help="id of a scan, or its first letters; default: all scans around the map",
    )
    anchor.add_argument("--out", type=Path, metavar="DIR", help="pictures and report; default: ./anchor-MAP")
    anchor.add_argument("--frames", type=int, metavar="N", help="to register; default: 3")
    deciding = anchor.add_argument_group("who decides")
    deciding.add_argument(
        "--auto", action="store_true", help="place the map without a person if every gate is passed"
    )
    deciding.add_argument(
        "--confirm",
        action="append",
        default=[],
        metavar="IMAGE",
        help="place the map by this frame as it was proposed; may be repeated",
    )
    helping = anchor.add_argument_group("where a registration starts, instead of the map's placement")
    helping.add_argument("--pose", type=Path, metavar="FILE", help="a rough pose, JSON")
    helping.add_argument("--picks", type=Path, metavar="FILE", help="picked points, CSV")
    helping.add_argument(
        "--near",
        metavar="LAT,LON[,RADIUS_M]",
        help="look for a map without a place there, its heading and size unknown; with an equals "
        "sign where the latitude is negative: --near=-33.86,151.21; default radius: 250 m",
    )
    helping.add_argument("--image", metavar="NAME", help="photo of --pose or --picks")
    page = anchor.add_argument_group("picking in a page")
    page.add_argument(
        "--page",
        action="store_true",
        help="open a page on this machine: click the same spots in photo and scan",
    )
    page.add_argument("--port", type=int, default=0, help="of the page; default: a free one")
    page.add_argument("--no-browser", action="store_true", help="print the address only")
    anchor.add_argument("--quiet", action="store_true", help="no progress bars")


def run_anchor(args: argparse.Namespace) -> int:
    """Anchor; 0 if the map was placed or frames were proposed, 1 if not, with the reason."""
    from ingest.anchoring import anchor
    from ingest.api.anchor_words import anchoring_text
    from ingest.api.progress_bars import progress_bars

    request = _request(args)
    database = open_database(args)
    if args.page:
        return _page(database, request, args)
    with progress_bars(args.quiet) as progress:
        done = anchor(database, request, progress)
    sys.stdout.write(anchoring_text(done, args.db))
    return 0 if done.placed or done.proposed else 1


def _page(database: "Database", request: "AnchorRequest", args: argparse.Namespace) -> int:
    """Serve the page of picks until it is stopped; 0."""
    from featuredb.extras import require
    from ingest.register.picks_page.server import create_app, new_token
    from ingest.register.picks_page.session import PickSession
    from reloc.viewer.server import serve

    require("http", "The page of picks", "fastapi", "uvicorn")
    snapshot = database.snapshot()
    loaded = snapshot.load_any(snapshot.find(request.map_id).map_id)
    token = new_token()
    serve(
        create_app(PickSession(database, request, loaded), token),
        args.port,
        browser=not args.no_browser,
        path=f"{token}/",
    )
    return 0


def _request(args: argparse.Namespace) -> "AnchorRequest":
    from featuredb.errors import InvalidValueError
    from ingest.anchoring import AnchorRequest
    from ingest.register.anchor.start.first_place import Circle, StartFiles

    if args.page and (args.auto or args.confirm or args.pose or args.picks or args.near):
        raise InvalidValueError("--page asks a person for everything; expected it alone")
    if args.auto and args.confirm:
        raise InvalidValueError("expected --auto or --confirm, found both")
    if args.image and not (args.pose or args.picks):
        raise InvalidValueError("--image names the photo of --pose or --picks; give one of them")
    if args.frames is not None and args.frames < 1:
        raise InvalidValueError(f"--frames: expected a number > 0, found {args.frames}")
    near = None if args.near is None else Circle.parse(args.near)
    return AnchorRequest(
        map_id=args.map_id,
        photos=args.photos,
        scan_ids=tuple(args.scan),
        out=args.out,
        frames=args.frames,
        auto=args.auto,
        confirm=tuple(args.confirm),
        start=StartFiles(pose=args.pose, picks=args.picks, image=args.image, near=near),
        storage_options=tuple(args.storage_option),
    )
