"""Which points shall carry descriptors? Recall of held-out photos against the size of the map.

Run: python tools/min_track_length.py FOLDER --hold-out GLOB [--hold-out GLOB ...] --out DIR

The photos of FOLDER but the held-out ones are ingested once; then maps with min_track_length 2 to 6 are made
of the same reconstruction, and the held-out photos are localised in each. Writes min_track_length.csv and
min_track_length.png. `correct` counts answers within --max-error-m of where the photo lies in a
reconstruction of all photos.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from featuredb.features.decode import decode_gray
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.maps.feature_map import FeatureMap, MapObservations
from ingest.executor import PoolExecutor
from ingest.map_builder import MapIdentity, MapOptions
from ingest.photo import Photo
from ingest.placed_models import make_maps
from ingest.reconstruction import MapMakingOptions
from ingest.scan import ScanOptions, scan_folder
from ingest.workspace import Workspace
from reloc.candidates import IndexedArea
from reloc.localise import localise
from reloc.result import LocaliseRequest

mpl.use("Agg")  # no display is needed

LENGTHS = (2, 3, 4, 5, 6)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One map: its size, and what it is good for."""

    min_track_length: int
    points: int
    points_with_descriptors: int
    descriptors: int
    descriptor_megabytes: float
    queries: int
    localised: int
    correct: int
    median_inliers: float
    median_error_m: float


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, write the table and the picture."""
    args = _arguments(argv)
    photos = scan_folder(args.folder, ScanOptions()).usable
    held = [p for p in photos if any(fnmatch(p.name, pattern) for pattern in args.hold_out)]
    kept = [p for p in photos if p not in held]
    if not held or len(kept) < 3:
        sys.stderr.write("nothing is held out, or too little is left\n")
        return 2
    args.out.mkdir(parents=True, exist_ok=True)
    everything = _largest(photos, args.work or args.out / "work", args.workers)
    feature_map = _largest(kept, args.work or args.out / "work", args.workers)
    rows = [_measure(feature_map, n, held, everything, args.max_error_m) for n in LENGTHS]
    _write(rows, args.out)
    return 0


def _largest(photos: Sequence[Photo], work: Path, workers: int) -> FeatureMap:
    """The largest map of the photos, with descriptors on all points."""
    options = MapMakingOptions(maps=MapOptions(min_track_length=2))
    job = f"tracks-{len(photos)}"
    with PoolExecutor(workers) as executor:
        made = make_maps(
            photos,
            Workspace(root=work, job_id=job),
            options,
            executor,
            identity=lambda number: MapIdentity(
                map_id=f"{job}-{number}", name=job, source="photos", licence="", provenance={}
            ),
        )
    maps = [c.feature_map for c in made if c.feature_map is not None]
    if not maps:
        raise SystemExit(f"no map of {len(photos)} photos: {[c.reason for c in made]}")
    return maps[0]


def with_min_track_length(feature_map: FeatureMap, length: int) -> FeatureMap:
    """The map with descriptors on points seen by at least that many photos."""
    seen = feature_map.observations
    long = feature_map.points.track_length[seen.point_index] >= length
    fields = {name: getattr(seen, name) for name in ("point_index", "image_id", "xy", "scale", "angle")}
    return replace(
        feature_map,
        observations=MapObservations(
            **fields, has_descriptor=long, descriptors=np.where(long[:, None], seen.descriptors, 0)
        ),
    )


def _measure(
    feature_map: FeatureMap, length: int, held: Sequence[Photo], truth: FeatureMap, max_error_m: float
) -> Row:
    thinned = with_min_track_length(feature_map, length)
    area = build_area([thinned])
    indexed = [IndexedArea(area=area, index=build_index(area.descriptors))]
    where = {image.name: image.cam_from_local.center for image in truth.images}
    errors, inliers = [], []
    for photo in held:
        request = LocaliseRequest(camera_key=photo.camera_key or None, exif_focal_px=photo.focal_px)
        result = localise(decode_gray(photo.path), request, indexed)
        inliers.append(result.inliers)
        if result.pose is not None and photo.name in where:
            found = truth.frame.enu_from_utm(result.pose.utm, result.pose.epsg)
            errors.append(float(np.linalg.norm(found - where[photo.name])))
    described = thinned.observations.has_descriptor
    return Row(
        min_track_length=length,
        points=len(thinned.points),
        points_with_descriptors=int((thinned.points.track_length >= length).sum()),
        descriptors=int(described.sum()),
        descriptor_megabytes=round(float(described.sum()) * 128 / 1e6, 3),
        queries=len(held),
        localised=len(errors),
        correct=int((np.array(errors) <= max_error_m).sum()),
        median_inliers=float(np.median(inliers)),
        median_error_m=round(float(np.median(errors)), 3) if errors else float("nan"),
    )


def _write(rows: Sequence[Row], folder: Path) -> None:
    with (folder / "min_track_length.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)

    figure, left = plt.subplots(figsize=(7, 4), layout="constrained")
    lengths = [row.min_track_length for row in rows]
    left.plot(lengths, [row.correct / row.queries for row in rows], "o-", color="C0", label="recall")
    most = max(row.median_inliers for row in rows) or 1.0
    left.plot(
        lengths, [row.median_inliers / most for row in rows], "s--", color="C1", label="inliers, relative"
    )
    left.set(xlabel="min_track_length", ylabel="share", ylim=(0, 1.05), xticks=lengths)
    right = left.twinx()
    right.bar(lengths, [row.descriptor_megabytes for row in rows], alpha=0.25, color="C2")
    right.set_ylabel("descriptors, MB")
    left.legend(loc="lower left")
    figure.savefig(folder / "min_track_length.png", dpi=110)
    plt.close(figure)
    for row in rows:
        sys.stdout.write(", ".join(f"{k} {v}" for k, v in asdict(row).items()) + "\n")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hold-out", action="append", required=True, metavar="GLOB")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--work", type=Path, default=None, help="work folder; default: OUT/work")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--max-error-m", type=float, default=1.0)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
