"""Do position priors steady focal length and pose? One folder, whole and in random halves less a few photos.

Run: python tools/position_priors.py FOLDER --out DIR [--leave-out 4] [--subsets 4]

Reconstructs all photos and several random subsets under each choice of options, places each by GPS, and
compares cameras that are in both: what differs is what the photos do not determine. Writes
position_priors.csv.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from featuredb.maps.feature_map import FeatureMap
from ingest.colmap_adjust import AdjustOptions
from ingest.executor import PoolExecutor
from ingest.fingerprint import options_fingerprint
from ingest.map_builder import MapIdentity
from ingest.photo import Photo
from ingest.placed_models import make_maps
from ingest.reconstruction import MapMakingOptions
from ingest.scan import ScanOptions, scan_folder
from ingest.sfm import SfmOptions
from ingest.workspace import Workspace

_PLAIN = AdjustOptions(fuller_lens=False, use_positions=False)
CHOICES = {
    "no positions": SfmOptions(adjust=_PLAIN),
    "positions while mapping": SfmOptions(position_priors="bundle", adjust=_PLAIN),
    "positions at the end": SfmOptions(adjust=replace(_PLAIN, use_positions=True)),
    "focal length kept": SfmOptions(refine_focal=False, adjust=_PLAIN),
    "default": SfmOptions(),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One choice: spread over the subsets, and their largest difference from the whole."""

    choice: str
    focal_px_whole: float
    focal_px_lowest: float
    focal_px_highest: float
    points_below_cameras_m_lowest: float
    points_below_cameras_m_highest: float
    gps_rms_m_whole: float
    centers_differ_m_median: float
    centers_differ_m_largest: float
    rotations_differ_deg_median: float
    rotations_differ_deg_largest: float


def main(argv: Sequence[str] | None = None) -> int:
    """Reconstruct, compare, write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--leave-out", type=int, default=4)
    parser.add_argument("--subsets", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args(argv)
    photos = scan_folder(args.folder, ScanOptions()).usable
    rng = np.random.default_rng(0)
    size = len(photos) - args.leave_out
    chosen = [sorted(rng.choice(len(photos), size, replace=False)) for _ in range(args.subsets)]
    subsets = [[photos[i] for i in rows] for rows in chosen]
    rows = []
    for name, sfm in CHOICES.items():
        whole = _map(list(photos), sfm, args.out / "work", args.workers)
        parts = [_map(subset, sfm, args.out / "work", args.workers) for subset in subsets]
        rows.append(_row(name, whole, parts))
        sys.stdout.write(", ".join(f"{k} {v}" for k, v in asdict(rows[-1]).items()) + "\n")
        sys.stdout.flush()
    with (args.out / "position_priors.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)
    return 0


def _map(photos: list[Photo], sfm: SfmOptions, work: Path, workers: int) -> FeatureMap:
    making = MapMakingOptions(sfm=sfm)
    with PoolExecutor(workers) as executor:
        made = make_maps(
            photos,
            Workspace(root=work, job_id=options_fingerprint(sfm)),
            making,
            executor,
            identity=lambda number: MapIdentity(
                map_id=str(number), name="", source="photos", licence="", provenance={}
            ),
        )
    maps = [c.feature_map for c in made if c.feature_map is not None]
    if not maps:
        raise SystemExit(f"no map: {[c.reason for c in made]}")
    return maps[0]


def _row(name: str, whole: FeatureMap, parts: Sequence[FeatureMap]) -> Row:
    centers, angles = [], []
    for part in parts:
        poses = {image.name: image.cam_from_local for image in whole.images}
        move = part.frame.enu_from(whole.frame)  # from the whole's frame into the part's
        for image in part.images:
            if image.name in poses:
                other = poses[image.name] @ move.inverse()
                centers.append(float(np.linalg.norm(image.cam_from_local.center - other.center)))
                angles.append(image.cam_from_local.angle_to_deg(other))
    focal = [part.cameras[0].focal_px for part in parts]
    depths = [_depth(part) for part in parts]
    return Row(
        choice=name,
        focal_px_whole=round(whole.cameras[0].focal_px, 1),
        focal_px_lowest=round(min(focal), 1),
        focal_px_highest=round(max(focal), 1),
        points_below_cameras_m_lowest=round(min(depths), 2),
        points_below_cameras_m_highest=round(max(depths), 2),
        gps_rms_m_whole=round(whole.placement.residual_rms_m, 3),
        centers_differ_m_median=round(float(np.median(centers)), 3),
        centers_differ_m_largest=round(max(centers), 3),
        rotations_differ_deg_median=round(float(np.median(angles)), 3),
        rotations_differ_deg_largest=round(max(angles), 3),
    )


def _depth(feature_map: FeatureMap) -> float:
    """Median height of the cameras above the median of the points."""
    cameras = np.median([image.cam_from_local.center[2] for image in feature_map.images])
    return float(cameras - np.median(feature_map.points_local()[:, 2]))


if __name__ == "__main__":
    sys.exit(main())
