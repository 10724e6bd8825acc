"""The command that thins a map: fewer descriptors, every image still covered."""

import argparse
import sys
from typing import TYPE_CHECKING, Any, cast

from featuredb.cli.common import add_command, open_database
from featuredb.errors import StoreError

if TYPE_CHECKING:
    from featuredb.maps.feature_map import FeatureMap
    from featuredb.maps.unplaced_map import AnyMap
    from featuredb.store import MapSummary, Snapshot, UnplacedSummary

# From here on the simulated town gains hardly any answer within its limits (docs/measurements/growth.md).
_COVER = 400


def register(subparsers: Any) -> None:
    text = "keep only as many descriptors as answers need; the earlier state stays, see rollback"
    parser = add_command(subparsers, "thin", run_thin, text)
    parser.add_argument(
        "map_id", metavar="MAP", help="id of a map that is active or has no place, or its first letters"
    )
    parser.add_argument(
        "--cover",
        type=int,
        default=_COVER,
        metavar="K",
        help="described points that every image keeps seeing (default: %(default)s)",
    )
    parser.add_argument("--dry-run", action="store_true", help="only say what would become of the map")


def run_thin(args: argparse.Namespace) -> None:
    """Thin the map and commit it as a new state of itself."""
    from featuredb.maps.thin import thin_map

    database = open_database(args)
    snapshot = database.snapshot()
    summary = _thinnable(snapshot, args.map_id)
    before = snapshot.load_any(summary.map_id)
    after: AnyMap = thin_map(cast("FeatureMap", before), args.cover)  # either kind comes out as it goes in
    sys.stdout.write(f"map {summary.map_id}: {_figures(before)} -> {_figures(after)}\n")
    if args.dry_run:
        return
    if after is before:
        sys.stdout.write("thinned so before; nothing to do\n")
        return
    done = database.commit_map(after, replaces=summary.map_id, based_on=summary.write_id, moves=False)
    sys.stdout.write(
        f"version {done.version}; `featuredb rollback {database.url} {snapshot.version}` brings back the "
        "state before\n"
    )


def _thinnable(snapshot: "Snapshot", map_id: str) -> "MapSummary | UnplacedSummary":
    found = snapshot.find(map_id)
    if found.status not in ("active", "unplaced"):
        raise StoreError(
            f"map {found.map_id} is {found.status}; active maps are thinned, and those without a place"
        )
    return found


def _figures(feature_map: "AnyMap") -> str:
    import numpy as np

    from featuredb.maps.thin import described_points_of_images

    seen = feature_map.observations
    described = len(np.unique(seen.point_index[seen.has_descriptor]))
    cover = described_points_of_images(feature_map)
    least = int(cover.min()) if len(cover) else 0
    return (
        f"{described} described points of {len(feature_map.points)}, {int(seen.has_descriptor.sum())} "
        f"descriptors, at least {least} points in an image"
    )
