"""Photos and a scan end to end: a map placed by GPS is anchored on the scan; held-out photos judge it.

    python -m tools.anchor_brighton --photos FOLDER --scan SCAN.laz --poses poses.json \\
        --work FOLDER --held-out A.JPG ...

1. `featuredb ingest photos` makes a map of all photos but the held-out ones.
2. `featuredb lidar add` adds the scan; `featuredb anchor --auto` places the map by it.
3. A server answers for each held-out photo, as `featuredb query` asks: nothing but the file.
4. The answers are compared with poses that tools/scan_poses.py finds by registering each photo to the scan
   directly (kept in the file of --poses). Before anchoring, too, to show what it changed. Beside the errors
   (medians): the 68 % radii that the answers state, and how many times the errors these are.
5. Of the map as GPS placed it: its focal length beside the scan's, with the standard deviation that the map
   stores, and how far its cameras are from the scan's poses after a similarity (median).

"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.sim3 import similarity_closed_form
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.store import Database
from tools.commands import anchor, featuredb
from tools.figures import write_figures
from tools.real_photos import HeldOutRow, ask_poses, error_figures, ingest
from tools.scan_poses import ScanTruth, scan_parser, scan_truth


def main() -> None:
    args = scan_parser(__doc__, "--work", "--held-out").parse_args()
    truth = scan_truth(args)
    work: Path = args.work
    database = work / "anchored"
    ingest(database, args.photos, args.held_out)
    shape = by_gps(Database.open(database), truth)
    before = ask_poses(Database.open(database), args.photos, args.held_out, truth.frame, truth.poses)
    anchored = anchored_on(database, args.scan, args.photos, work / "anchor")
    after = ask_poses(anchored, args.photos, args.held_out, truth.frame, truth.poses)
    figures = error_figures(after) | {f"before_{k}": v for k, v in error_figures(before).items()}
    write_figures(args.json, figures | stated(after) | shape)


def stated(rows: Sequence[HeldOutRow]) -> dict[str, float]:
    """The radii that answers state (68 %), and over their errors; medians."""
    answered = [(row, row.error) for row in rows if row.error is not None]
    if not answered:
        return {}
    figures = {
        "stated_m": [row.position_68_m for row, _ in answered],
        "stated_deg": [row.orientation_68_deg for row, _ in answered],
        "stated_over_m": [row.position_68_m / error.position_m for row, error in answered],
        "stated_over_deg": [row.orientation_68_deg / error.angle_deg for row, error in answered],
    }
    return {name: float(np.median(values)) for name, values in figures.items()}


def anchored_on(database: Path, scan: Path, photos: Path, out: Path) -> Database:
    """The database, after its oldest map is placed on the scan, which is added to it; `out`: the report."""
    featuredb("lidar", "add", str(database), str(scan))
    map_id = Database.open(database).snapshot().maps()[0].map_id
    if not anchor(database, map_id, photos, out):
        raise SystemExit(f"the map was not placed on its scan; its report is in {out}")
    return Database.open(database)


def by_gps(database: Database, truth: ScanTruth) -> dict[str, float]:
    """What the map's own lens and shape are worth against the scan's, whatever its place."""
    snapshot = database.snapshot()
    feature_map = snapshot.load_map(snapshot.maps()[0].map_id)
    first = feature_map.images[0]
    focal_px, scan_px = feature_map.cameras[first.camera_id].focal_px, truth.cameras[first.name].focal_px
    own = np.array([image.cam_from_local.center for image in feature_map.images])
    wanted = np.array([truth.poses[image.name].center for image in feature_map.images])
    fit = similarity_closed_form(truth.frame.enu_from(feature_map.frame).act(own), wanted)
    uncertainty = LensUncertainty.of_provenance(feature_map.provenance)
    if fit is None or uncertainty is None:
        raise SystemExit("the map has no lens uncertainty, or its cameras lie on one point")
    rest = fit.act(truth.frame.enu_from(feature_map.frame).act(own)) - wanted
    return {
        "gps_focal_px": focal_px,
        "scan_focal_px": scan_px,
        "gps_focal_sigma": uncertainty.focal_rel,
        "gps_focal_off": abs(focal_px / scan_px - 1.0) / max(uncertainty.focal_rel, 0.01),
        "gps_shape_m": float(np.median(np.linalg.norm(rest, axis=1))),
    }


if __name__ == "__main__":
    main()
