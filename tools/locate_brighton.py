"""What is at a pixel of a real photo: places on the scan, and by the map alone, against the scan's own poses.

    python -m tools.locate_brighton --photos FOLDER --scan SCAN.laz --poses poses.json \\
        --work FOLDER --held-out A.JPG ...

1. A map of all photos but the held-out ones is anchored on the scan (tools/anchor_brighton.py).
2. Each held-out photo is localised; pixels at random are located on the scan, and on the map's own points.
3. The truth of a pixel: the points of the scan file that it shows from the pose, and with the lens, of
   tools/scan_poses.py. That pose comes of the photo and the scan alone, by code that shares nothing with map,
   anchoring, localisation and renderer. Pixels whose nearest points lie at several depths have no truth.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.localiser import Localiser
from reloc.overlay import map_points_in_view
from reloc.pixels.locate import locate
from reloc.pixels.surfaces import MapSurface, scan_surface
from tools.anchor_brighton import anchored_on
from tools.figures import write_figures
from tools.locate_pixels import Miss, miss_figures, misses, view_of
from tools.picked import Scan, read_scan, visible
from tools.real_photos import ingest
from tools.scan_poses import scan_parser, scan_truth

_SEED, _PIXELS = 1, 300  # of each photo
_NEAR, _REACH_PX = 12, 12.0  # points of the scan around a pixel, and how far they may be
_ONE_SURFACE_M = 0.3  # between the depths of nine tenths of them


def main() -> None:
    args = scan_parser(__doc__, "--work", "--held-out").parse_args()
    truth = scan_truth(args)
    scan = read_scan(args.scan, truth.frame, truth.epsg)
    rng = np.random.default_rng(_SEED)
    found: dict[str, list[Miss]] = {"scan": [], "map": []}
    asked = photos = 0
    made = args.work / "db"
    ingest(made, args.photos, args.held_out)
    database = anchored_on(made, args.scan, args.photos, args.work / "anchor")
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
    figures = {"photos": photos, "asked": asked}
    for kind, those in found.items():
        figures |= {f"{kind}_located": len(those)} | miss_figures(kind, those)
    write_figures(args.json, figures)


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
