"""`featuredb ingest model DB FOLDER`: a model of another program as a map, with its place or without one."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from featuredb.cli.common import numbers, place_for_database, storage_options
from ingest.cli.register import sigmas_m

if TYPE_CHECKING:
    from ingest.models_in.place import Stated


def add_model_arguments(parser: argparse.ArgumentParser) -> None:
    """What of the model is where."""
    parser.add_argument(
        "folder",
        metavar="FOLDER",
        type=Path,
        help="with a COLMAP model (itself, or in sparse/ or sparse/0), or OpenSfM's reconstruction.json "
        "(itself, or in opensfm/)",
    )
    parser.add_argument(
        "--photos",
        type=Path,
        metavar="FOLDER",
        help="the model's photos under its names; needed unless georeference.json names them; "
        "default: images/ of OpenSfM",
    )
    parser.add_argument("--database", type=Path, metavar="FILE", help="COLMAP's; default: FOLDER/database.db")
    parser.add_argument(
        "--descriptors",
        choices=("stored", "photos"),
        help="those of COLMAP's database (default), or made anew of the photos at the model's keypoints (the "
        "only way for OpenSfM)",
    )
    parser.add_argument("--reconstruction", type=int, metavar="N", help="which of several of OpenSfM, from 0")
    place = parser.add_argument_group(
        "where it lies; without these as georeference.json says, or by the GPS of its photos"
    )
    place.add_argument("--epsg", type=int, help="UTM zone, 326zz or 327zz")
    place.add_argument(
        "--origin",
        type=lambda text: numbers(text, "easting,northing,height in metres", 3),
        metavar="E,N,H",
        help="of the model's coordinates in that zone, metres",
    )
    place.add_argument(
        "--axes",
        choices=("enu", "utm", "ecef"),
        default="enu",
        help="of the model: true east, north, up at the origin (default); UTM less the origin; geocentric",
    )
    place.add_argument(
        "--sigma",
        type=sigmas_m,
        metavar="M[,M]",
        help="how well that is known, horizontally and vertically: one standard deviation in metres; alone: "
        "how well OpenSfM's own reference is",
    )
    place.add_argument(
        "--height-datum", default="unknown", help="ellipsoidal, egm96, egm2008, navd88 or unknown (default)"
    )
    parser.add_argument("--min-track-length", type=int, default=2, metavar="N", help="default: 2")
    parser.add_argument("--name", default="", help="of the map; default: as it was called, or the folder's")
    parser.add_argument("--owner", default="", help="of photos that do not name their own")
    parser.add_argument("--licence", default="", help="of the photos, e.g. CC-BY-4.0")


def run_model(args: argparse.Namespace) -> int:
    """Import, commit, and say in a line what came of it."""
    from featuredb.maps.unplaced_map import UnplacedMap
    from featuredb.store import Database
    from ingest.models_in.model_map import ModelOptions, map_of_model

    stated = _stated(args)
    options = ModelOptions(
        stated=stated,
        sigma_m=args.sigma if stated is None else None,
        colmap_database=args.database,
        photos=args.photos,
        reconstruction=args.reconstruction,
        descriptors=args.descriptors,
        height_datum=args.height_datum,
        min_track_length=args.min_track_length,
        name=args.name,
        owner=args.owner,
        licence=args.licence,
    )
    place_for_database(args)
    made = map_of_model(args.folder, options)
    database = Database.create(args.db, storage_options=storage_options(args))
    result = database.commit_map(made)
    state = "committed" if result.created else "there already"
    if isinstance(made, UnplacedMap):
        sys.stdout.write(
            f"map {made.map_id} ({made.name}): {state}, without a place, {len(made.images)} photos, "
            f"{len(made.points)} points; {made.no_place.reason_code}: {made.no_place.reason}\n"
            "  `featuredb maps` says what would give it one; named by --map it answers in its own frame\n"
        )
        return 0
    if made.status != "active":
        by_maps = "it was placed by maps that this database may not have"
        too_few = "too few positions are left to check its place by; named by --map it answers"
        state += f", {made.status}: {too_few if made.placement.method == 'gps' else by_maps}"
    sys.stdout.write(
        f"map {made.map_id} ({made.name}): {state}, {len(made.images)} photos, {len(made.points)} points, "
        f"{int(made.observations.has_descriptor.sum())} descriptors, EPSG:{made.epsg}, placed by "
        f"{made.placement.method}, residual {made.placement.residual_rms_m:.2f} m\n"
    )
    return 0


def _stated(args: argparse.Namespace) -> "Stated | None":
    from featuredb.errors import InvalidValueError
    from ingest.models_in.place import Stated

    if args.epsg is None and args.origin is None and args.axes == "enu":
        return None  # and --sigma, if given, belongs to the model's own reference
    origin = args.origin
    if args.axes == "ecef":
        if origin is not None:
            raise InvalidValueError("--origin: geocentric coordinates (--axes ecef) have none; leave it out")
        origin = (0.0, 0.0, 0.0)
    missing = [
        name
        for name, value in (("--epsg", args.epsg), ("--origin", origin), ("--sigma", args.sigma))
        if value is None
    ]
    if missing:
        raise InvalidValueError(
            f"expected --epsg, --origin and --sigma together, found no {' and no '.join(missing)}: a place "
            "without its accuracy is no place for a map"
        )
    return Stated(axes=args.axes, epsg=args.epsg, origin=origin, sigma_m=args.sigma)
