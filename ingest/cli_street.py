"""`featuredb street DB MAP --photos FOLDER`: street-level views of an anchored map, as a map of their own."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any


def register(subparsers: Any) -> None:
    """Add `street` to the parser of `featuredb`."""
    from featuredb.cli.common import add_database_argument

    parser = subparsers.add_parser(
        "street",
        help="draw an anchored map's photos as seen from the street, so that photos from there find it",
        description="Draws the map's aerial photos over the LiDAR scan as seen from where people can stand, "
        "and commits what can be recognised there as a new map, quarantined until `featuredb promote`. Needs "
        "a scan with ground class, and photos that show walls; see docs/ground-and-air.md.",
    )
    add_database_argument(parser)
    parser.add_argument("map_id", metavar="MAP", help="id of a map that lies on a scan, or its first letters")
    parser.add_argument("--photos", type=Path, required=True, metavar="FOLDER", help="of the map's photos")
    parser.add_argument("--step", type=float, default=None, metavar="M", help="between places; default: 12")
    parser.set_defaults(run=run_street)


def run_street(args: argparse.Namespace) -> int:
    """Make the street map and commit it.

    Raises:
        RegistrationError: no scan, no ground class, no photos, or nothing that could be recognised.
        MapNotFoundError, ScanNotFoundError, StoreError, MissingExtraError
    """
    from featuredb.cli.common import open_database
    from ingest.street.command import make_street_map
    from ingest.street.stand import StandOptions
    from ingest.street.street_map import StreetOptions

    options = StreetOptions()
    if args.step is not None:
        options = replace(options, stand=replace(StandOptions(), step_m=args.step))
    database = open_database(args)
    made, done = make_street_map(database, args.map_id, args.photos, options)
    sys.stdout.write(
        f"map {made.map_id}: {len(made.points)} points in {len(made.images)} views, quarantined in "
        f"version {done.version}; `featuredb promote {database.url} {made.map_id} --reason ...` takes it "
        "into service\n"
    )
    return 0
