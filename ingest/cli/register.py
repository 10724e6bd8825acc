"""`featuredb register DB MAP --gcp FILE`: a map that is there gets a better place, or its first one."""

import argparse
import sys
from pathlib import Path
from typing import Any

from featuredb.cli.common import add_command, numbers, open_database


def register(subparsers: Any) -> None:
    parser = add_command(
        subparsers,
        "register",
        run_register,
        "place a map by ground control points",
        description="Place a map by ground control points, one without a place, too: similarity, "
        "adjustment with the points as control, residuals, wrong marks named. The new placement is a new "
        "commit; `featuredb rollback` and --as-of reach the map as it was.",
    )
    parser.add_argument("map_id", metavar="MAP", help="id of the map; its first letters are enough")
    parser.add_argument(
        "--gcp", type=Path, required=True, metavar="FILE", help="control points, OpenDroneMap's gcp_list.txt"
    )
    add_control_arguments(parser)
    parser.add_argument(
        "--height-datum",
        default="unknown",
        help="of the surveyed heights, where their reference system does not say it: ellipsoidal, egm96, "
        "egm2008, navd88 or unknown (default)",
    )
    parser.add_argument("--report", type=Path, metavar="DIR", help="write control.html and .json there")
    parser.add_argument("--dry-run", action="store_true", help="show the residuals and commit nothing")


def add_control_arguments(parser: Any) -> None:
    """What belongs to a control point file."""
    parser.add_argument("--gcp-crs", metavar="CRS", help="reference system, instead of the file's first line")
    parser.add_argument(
        "--gcp-sigma",
        type=sigmas_m,
        metavar="M[,M]",
        help="standard deviation of surveyed coordinates in metres, horizontal and vertical; default: from "
        "the residuals",
    )
    parser.add_argument(
        "--ground-height",
        type=_height,
        metavar="M[,SIGMA]",
        help="height of the control points in metres where the file has none, and its standard deviation "
        "(default 10); without it such a map is put at height 0",
    )


def run_register(args: argparse.Namespace) -> int:
    """Place, print the residuals, commit; 0 if the map has its new place, 1 if it was refused."""
    from ingest.api.registering import place_by_control
    from ingest.register.control.placement import GcpOptions

    done = place_by_control(
        open_database(args),
        args.map_id,
        args.gcp,
        crs=args.gcp_crs,
        options=GcpOptions(sigma_m=args.gcp_sigma, ground_m=args.ground_height),
        height_datum=args.height_datum,
        report=args.report,
        dry_run=args.dry_run,
    )
    sys.stdout.write(done.as_text())
    return 1 if done.result.feature_map is None else 0


def sigmas_m(text: str) -> tuple[float, float]:
    """One or two lengths in metres: horizontal and vertical, or both."""
    values = numbers(text, "metres such as 3 or 3,5", 1, 2)
    if not all(0 < v < 1e6 for v in values):
        raise argparse.ArgumentTypeError(f"expected one or two lengths > 0 m, found {text!r}")
    return values[0], values[-1]


def _height(text: str) -> tuple[float, float]:
    values = numbers(text, "metres such as 3 or 3,5", 1, 2)
    sigma = values[1] if len(values) == 2 else 10.0
    if not -500 < values[0] < 9000 or not 0 < sigma < 1e4:
        raise argparse.ArgumentTypeError(f"expected a height in metres, and a sigma > 0, found {text!r}")
    return values[0], sigma
