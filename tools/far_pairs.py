"""Which verified pairs an ingest leaves out because their photos are too far apart by their positions.

Photos are matched as `featuredb ingest photos --max-features 3000` does (`ingest/sfm/far_pairs.py`). Nobody
knows which pairs of real photos are right: what is left out is counted, and its largest number of matches.
`tools.bulk_ingest` does the same for a simulated flight, whose truth says it.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.arrays import FloatArray
from ingest.executor import open_executor
from ingest.photos.photo import Photo
from ingest.photos.scan import ScanOptions, require_usable, scan_folder
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.sfm.far_pairs import far_pairs
from ingest.sfm.pairs import Pair
from ingest.workspace import Workspace
from tools.figures import study_parser, write_figures

FEATURES = 3000
_OFF_M, _SEED = 300.0, 1
_METRES_A_DEGREE = 111_000.0


def main() -> None:
    args = study_parser(__doc__, "folders", "--work").parse_args()
    figures: dict[str, dict[str, float]] = {}
    for folder in args.folders:
        name = folder.parent.name if folder.name == "images" else folder.name
        photos, inliers = verified_pairs(folder, args.work / name)
        far = far_pairs(photos, inliers)
        figures[name] = {
            "pairs": len(inliers),
            "left_out": len(far),
            "most_matches": max((inliers[pair] for pair in far), default=0),
        }
    total = {key: sum(of[key] for of in figures.values()) for key in ("pairs", "left_out")}
    write_figures(args.json, figures | total | {"left_out_share": total["left_out"] / total["pairs"]})


def verified_pairs(folder: Path, work: Path) -> tuple[Sequence[Photo], dict[Pair, int]]:
    """The usable photos of a folder, and verified matches of all their pairs; `work`: where they are kept."""
    options = MapMakingOptions(extractor=ExtractorOptions(max_features=FEATURES))
    photos = require_usable(scan_folder(folder, ScanOptions()), folder, least=2)
    with open_executor(2, None, (work, folder)) as executor:
        done = reconstruct_photos(photos, Workspace(root=work), options, executor, stop_after="match")
    counts = {pair: len(done.matched.geometry(pair).inliers) for pair in done.matched.files}
    least = options.matching.min_inliers
    return done.usable, {pair: count for pair, count in counts.items() if count >= least}


def against_truth(
    photos: Sequence[Photo], inliers: dict[Pair, int], centers: FloatArray, apart_m: float
) -> dict[str, float]:
    """Right and wrong pairs, and how many of each are left out: as positions are, and with some of them off.

    Args:
        centers: (n, 2) true places on the ground plan; what is farther apart than `apart_m` shares nothing.
    """
    wrong = {p for p in inliers if float(np.linalg.norm(centers[p[0]] - centers[p[1]])) > apart_m}
    figures: dict[str, float] = {"pairs": len(inliers), "wrong_pairs": len(wrong)}
    for percent in (0, 5, 20, 30):
        far = far_pairs(_some_off(photos, percent / 100.0), inliers)
        figures[f"off_{percent}_wrong_left_out"] = len(far & wrong)
        figures[f"off_{percent}_right_left_out"] = len(far - wrong)
    return figures


def _some_off(photos: Sequence[Photo], share: float) -> list[Photo]:
    """Photos of which a share has a position that is off by 300 m (standard deviation, each axis)."""
    rng = np.random.default_rng(_SEED)
    moved = []
    for photo in photos:
        off, way = rng.random() < share, rng.normal(0.0, _OFF_M / _METRES_A_DEGREE, 2)
        if off and (gps := photo.gps) is not None:
            longitude = gps.longitude_deg + way[0] / np.cos(np.radians(gps.latitude_deg))
            gps = replace(gps, latitude_deg=gps.latitude_deg + way[1], longitude_deg=float(longitude))
            photo = replace(photo, gps=gps)
        moved.append(photo)
    return moved


if __name__ == "__main__":
    main()
