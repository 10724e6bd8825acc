"""`featuredb adjust DB MAP [MAP ...]`: arguments in, report out."""

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.growth.graph.joint.adjust import JointAdjustment


def register(subparsers: Any) -> None:
    """Add `adjust` to the parser of `featuredb`."""
    from featuredb.cli.common import add_database_argument

    parser = subparsers.add_parser(
        "adjust",
        help="adjust maps that overlap, all together",
        description="One bundle adjustment of active maps that overlap, with all that hangs on them. Growth "
        "holds fixed what it stands on; this does not. Anchors by LiDAR or control points stay as they are, "
        "others keep their place as a whole. All or nothing, in one commit; `featuredb rollback` undoes it. "
        "See docs/growth.md.",
    )
    add_database_argument(parser)
    parser.add_argument(
        "maps", nargs="+", metavar="MAP", help="ids, or their first letters; one brings what hangs on it"
    )
    parser.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="MAP",
        help="this anchor may move although LiDAR or control points placed it, or further than its placement "
        "explains; may be repeated",
    )
    parser.add_argument("--dry-run", action="store_true", help="say what would move, commit nothing")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.set_defaults(run=run_adjust)


def run_adjust(args: argparse.Namespace) -> int:
    """Adjust; 0, or 1 where it is refused.

    Raises:
        InvalidValueError, ConflictError, MapNotFoundError, StoreError
    """
    from featuredb.cli.common import open_database
    from ingest.growth.graph.joint.adjust import adjust_maps

    found = adjust_maps(open_database(args), args.maps, free=args.free, dry_run=args.dry_run)
    sys.stdout.write(json.dumps(found.as_json()) + "\n" if args.json else _text(found))
    return 0 if found.reason is None else 1


def _text(found: "JointAdjustment") -> str:
    from featuredb.cli.common import format_table

    rows = [
        (
            r.map_id, "held" if r.held else "", r.photos, round(r.move_m, 3), round(r.shape_m, 3),
            round(r.sigma_before_px, 2), round(r.sigma_px, 2),
        )
        for r in found.reports
    ]  # fmt: skip
    head = ("map", "", "photos", "move_m", "shape_m", "px_before", "px")
    lines = [format_table(head, rows)] if rows else []
    if found.descendants:
        lines.append(f"with what hangs on the named maps: {', '.join(found.descendants)}\n")
    if found.flagged:
        lines.append(
            f"quarantined, they hang on a moved map and could not join: {', '.join(found.flagged)}\n"
        )
    if found.elsewhere:
        lines.append(f"not heard, other maps have them elsewhere: {', '.join(found.elsewhere)}\n")
    lines.append(f"{found.shared_points} points in several maps\n")
    if found.reason is not None:
        lines.append(f"refused, {found.reason}: {found.message}\n")
    elif found.version < 0:
        lines.append(f"{found.message}; nothing is committed\n")
    else:
        lines.append(f"{found.message}, version {found.version}\n")
    return "".join(lines)
