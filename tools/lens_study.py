"""Which lens does a map need: the same photos with SIMPLE_RADIAL and with the ladder to OPENCV.

EXIF's focal length counts as much as --focal-weights says; the program's default otherwise.

Judged by something the reconstruction never saw: the truth of a simulated world, or a laser scan of the same
place, to which the map's points are fitted by a similarity (trimmed iterative closest points).

uv run python tools/lens_study.py --world featuredb-demo/world --gps-sigma 1
uv run --extra lidar python tools/lens_study.py --photos PHOTOS --scan SCAN.laz
"""

import argparse
import logging
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial import cKDTree

from featuredb.geometry.arrays import FloatArray
from featuredb.maps.feature_map import FeatureMap
from featuredb.simworld.truth import read_truth
from featuredb.store import Database
from ingest.focal_prior import FocalPriorOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions

_WARM_ROUNDS, _ROUNDS = 50, 60
_KEPT_PERCENT = 70.0  # of the points; holes of the scan and moving things are among the others


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--photos", type=Path, help="folder of photos with GPS")
    parser.add_argument("--world", type=Path, help="folder of a simulated world")
    parser.add_argument("--scan", type=Path, help="LAS/LAZ file in a UTM zone, metres")
    parser.add_argument("--gps-sigma", type=float, default=None, help="of the photos' positions, metres")
    parser.add_argument(
        "--focal-weights",
        type=float,
        nargs="+",
        default=[FocalPriorOptions().weight],
        help="0: EXIF is ignored",
    )
    parser.add_argument("--work", type=Path, default=None, help="keep unfinished work here")
    args = parser.parse_args()
    photos = args.world / "drone" if args.world else args.photos
    if photos is None:
        parser.error("give --photos or --world")
    logging.basicConfig(format="%(message)s")
    logging.getLogger("ingest.colmap_adjust").setLevel(logging.INFO)  # tells the gain of each step
    with tempfile.TemporaryDirectory() as scratch:
        print(
            f"{'lens':<16}{'weight':>7}{'focal px':>10}{'residual px':>13}"
            f"{'photos':>7}{'points':>8}{'GPS RMS m':>11}  against the independent truth"
        )
        for fuller, weight in [(False, args.focal_weights[0]), *((True, w) for w in args.focal_weights)]:
            folder = Path(scratch) / f"{fuller}-{weight:g}"
            feature_map = make_map(photos, folder, fuller, weight, args.gps_sigma, args.work)
            name = feature_map.cameras[0].model
            judged = []
            if args.world:
                judged.append(f"camera centres RMS {center_rms_m(feature_map, args.world):.3f} m")
            if args.scan:
                median, p80 = distance_to_scan_m(feature_map, args.scan)
                judged.append(f"points to scan median {median:.3f} m, 80 % within {p80:.3f} m")
            print(
                f"{name:<16}{weight:>7g}{feature_map.cameras[0].focal_px:>10.1f}"
                f"{feature_map.provenance['residual_sigma_px']:>13.3f}{len(feature_map.images):>7}{len(feature_map.points):>8}"
                f"{feature_map.placement.residual_rms_m:>11.3f}  {'; '.join(judged)}"
            )


def make_map(
    photos: Path,
    folder: Path,
    fuller_lens: bool,
    focal_weight: float,
    gps_sigma_m: float | None,
    work: Path | None,
) -> FeatureMap:
    """Ingest the photos with or without the fuller lens, with that weight of EXIF; the largest map."""
    making = MapMakingOptions()
    prior = FocalPriorOptions(weight=focal_weight)
    adjust = replace(making.sfm.adjust, fuller_lens=fuller_lens, focal_prior=prior)
    options = IngestOptions(
        making=replace(making, sfm=replace(making.sfm, adjust=adjust)),
        gps_sigma_m=(gps_sigma_m, gps_sigma_m) if gps_sigma_m else None,
        work=work,
    )
    database = Database.create(folder)
    report = ingest_photos(database, photos, options)
    snapshot = database.snapshot()
    if not snapshot.maps():
        raise SystemExit("no map: " + "; ".join(outcome.reason for outcome in report.maps))
    largest = max(snapshot.maps(), key=lambda m: m.images)
    return snapshot.load_map(largest.map_id)


def center_rms_m(feature_map: FeatureMap, world: Path) -> float:
    """RMS distance of camera centres from the truth after the best similarity: what is bent."""
    truth = read_truth(world)
    to_truth = truth.frame.enu_from(feature_map.frame)
    centers = np.array([to_truth.act(image.cam_from_local.center) for image in feature_map.images])
    true = np.array([truth.images[f"drone/{i.name}"].cam_from_local.center for i in feature_map.images])
    return float(np.sqrt(((_fitted(centers, true, centers) - true) ** 2).sum(axis=1).mean()))


def distance_to_scan_m(feature_map: FeatureMap, scan: Path) -> tuple[float, float]:
    """Median and 80th percentile distance of well-seen points to the scan after the best similarity."""
    import laspy

    file = laspy.read(scan)
    cloud = np.stack([file.x, file.y, file.z], axis=1).astype(np.float64)
    cloud = feature_map.frame.enu_from_utm(cloud, feature_map.epsg)
    tree = cKDTree(cloud)
    points = feature_map.points_local()[feature_map.points.track_length >= 3]
    points[:, 2] += np.median(cloud[:, 2]) - np.median(points[:, 2])
    for round_number in range(_ROUNDS):
        distance, row = tree.query(points)
        # Wide at first, so that a metre of offset is still caught.
        least = 0.3 if round_number < _WARM_ROUNDS else 0.0
        near = distance <= max(float(np.percentile(distance, _KEPT_PERCENT)), least)
        points = _fitted(points[near], cloud[row[near]], points)
    distance, _ = tree.query(points)
    return float(np.median(distance)), float(np.percentile(distance, 80))


def _fitted(source: FloatArray, target: FloatArray, points: FloatArray) -> FloatArray:
    """Points moved by the least-squares similarity from source to target."""
    fit = pycolmap.estimate_sim3d(source, target)
    if fit is None:
        raise SystemExit("no similarity fits: too few points")
    matrix = np.asarray(fit.rotation.matrix())
    return np.asarray(fit.scale * points @ matrix.T + fit.translation, dtype=np.float64)


if __name__ == "__main__":
    main()
