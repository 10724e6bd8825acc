"""Photos and a scan end to end: a map placed by GPS is anchored on the scan; held-out photos judge it.

1. `featuredb ingest photos` makes a map of all photos but the held-out ones.
2. `featuredb lidar add` adds the scan; `featuredb anchor --auto` places the map by it.
3. A server answers for each held-out photo, as `featuredb query` asks: nothing but the file.
4. The answers are compared with poses that tools/scan_poses.py finds by registering each photo to the scan
   directly (kept in the file of --poses). Before anchoring, too, to show what it changed. Beside the errors
   (medians): the 68 % radii that the answers state, and how many times the errors these are.
5. Of the map as GPS placed it: its focal length beside the scan's, with the standard deviation that the map
   stores, and how far its cameras are from the scan's poses after a similarity (median).

With --pixels, in place of 3 to 5: what is at pixels at random of the held-out photos, located on the scan,
and on the map's own points. The truth of a pixel: the points of the scan file that it shows from the pose,
and with the lens, of tools/scan_poses.py. That pose comes of the photo and the scan alone, by code that
shares nothing with map, anchoring, localisation and renderer. Pixels whose nearest points lie at several
depths have no truth.
"""

import argparse
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.lens_uncertainty import LensUncertainty
from featuredb.store import Database
from reloc.localiser import Localiser
from reloc.overlay import map_points_in_view
from reloc.pixels.locate import locate
from reloc.pixels.surfaces import MapSurface, scan_surface
from tools.anchor_simworld import Miss, miss_figures, misses, view_of
from tools.commands import anchor, featuredb, first_map
from tools.figures import laid_apart, median, poses_in, write_figures
from tools.picked import Scan, read_scan, visible
from tools.real_photos import HeldOutRow, ask_poses, error_figures, ingest
from tools.scan_poses import ScanTruth, scan_parser, scan_truth

_SEED, _PIXELS = 1, 300  # of each photo
_NEAR, _REACH_PX = 12, 12.0  # points of the scan around a pixel, and how far they may be
_ONE_SURFACE_M = 0.3  # between the depths of nine tenths of them


def main() -> None:
    parser = scan_parser(__doc__, "--work", "--held-out")
    parser.add_argument("--pixels", action="store_true", help="locate pixels of the held-out photos")
    args = parser.parse_args()
    truth = scan_truth(args)
    ingest(args.work / "db", args.photos, args.held_out)
    database = Database.open(args.work / "db")
    figures: dict[str, float] = {}
    if not args.pixels:
        before = ask_poses(database, args.photos, args.held_out, truth.frame, truth.poses)
        figures = by_gps(database, truth) | {f"before_{k}": v for k, v in error_figures(before).items()}
    featuredb("lidar", "add", database.url, str(args.scan))
    out = args.work / "anchor"
    if not anchor(args.work / "db", first_map(database).map_id, args.photos, out):
        raise SystemExit(f"the map was not placed on its scan; its report is in {out}")
    if args.pixels:
        figures = located(args, Database.open(database.url), truth)
    else:
        after = ask_poses(Database.open(database.url), args.photos, args.held_out, truth.frame, truth.poses)
        figures |= error_figures(after) | stated(after)
    write_figures(args.json, figures)


def stated(rows: Sequence[HeldOutRow]) -> dict[str, float]:
    """The radii that answers state (68 %), and over their errors; medians."""
    found = [(row, row.error) for row in rows if row.error is not None]
    return {
        "stated_m": median([row.position_68_m for row, _ in found]),
        "stated_deg": median([row.orientation_68_deg for row, _ in found]),
        "stated_over_m": median([row.position_68_m / error.position_m for row, error in found]),
        "stated_over_deg": median([row.orientation_68_deg / error.angle_deg for row, error in found]),
    }


def by_gps(database: Database, truth: ScanTruth) -> dict[str, float]:
    """What the map's own lens and shape are worth against the scan's, whatever its place."""
    feature_map = first_map(database)
    first = feature_map.images[0]
    focal_px, scan_px = feature_map.cameras[first.camera_id].focal_px, truth.cameras[first.name].focal_px
    own = {name: pose.center for name, pose in poses_in(truth.frame, feature_map).items()}
    shape = laid_apart(own, {name: truth.poses[name].center for name in own})
    sigma = LensUncertainty.of_provenance(feature_map.provenance).focal_rel
    return {
        "gps_focal_px": focal_px,
        "scan_focal_px": scan_px,
        "gps_focal_sigma": sigma,
        "gps_focal_off": abs(focal_px / scan_px - 1.0) / max(sigma, 0.01),
        "gps_shape_m": median(shape),
    }


def located(args: argparse.Namespace, database: Database, truth: ScanTruth) -> dict[str, float]:
    """Places of pixels of the held-out photos, on the scan and by the map, against the scan's points."""
    scan, rng = read_scan(args.scan, truth.frame, truth.epsg), np.random.default_rng(_SEED)
    found: dict[str, list[Miss]] = {"scan": [], "map": []}
    asked = photos = 0
    localiser = Localiser.open(database)
    for name in args.held_out:
        view = view_of(localiser, (args.photos / name).read_bytes())
        if view is None:
            continue
        pixels, places = _truth(scan, truth.cameras[name], truth.poses[name], rng)
        true = view.frame.enu_from(truth.frame).act(places)
        asked, photos = asked + len(pixels), photos + 1
        utm = map_points_in_view(localiser.areas_of(view.map_ids[:1]), view)
        by_map = MapSurface(points=view.frame.enu_from_utm(utm, view.epsg))
        for kind, surface in (("scan", scan_surface(database, view)), ("map", by_map)):
            found[kind] += misses(view, true, locate(view, surface, pixels))
    figures: dict[str, float] = {"photos": photos, "asked": asked}
    for kind, those in found.items():
        figures |= {f"{kind}_located": len(those)} | miss_figures(kind, those)
    return figures


def _truth(
    scan: Scan, camera: Camera, pose: Rigid3, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) that show one surface of the scan, and their places (n, 3) in the scan's local frame."""
    rows, shown = visible(scan, camera, pose)
    depth = pose.act(scan.local[rows])[:, 2]
    pixels = rng.uniform([0.0, 0.0], [camera.width, camera.height], (_PIXELS, 2))
    apart, near = cKDTree(shown).query(pixels, k=_NEAR)
    around = depth[near]
    low, middle, high = np.quantile(around, [0.05, 0.5, 0.95], axis=1)
    known: NDArray[np.bool_] = (apart[:, -1] < _REACH_PX) & (high - low < _ONE_SURFACE_M)
    rays = np.column_stack([camera.unproject(pixels), np.ones(_PIXELS)])
    return pixels[known], pose.inverse().act(rays * middle[:, None])[known]


if __name__ == "__main__":
    main()
