"""What cutting a set of photos into blocks and joining them costs in accuracy.

    uv run python tools/block_joining.py lewis/images --block 20 --work DIR

Reconstructs the photos at once and in blocks, from the same matches, and prints the photos of each model
and how far the camera centres are apart after the best similarity, over the mean distance of the cameras from
their middle.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.features.extractor import ExtractorOptions
from ingest.clusters.graph import ClusterOptions
from ingest.colmap_bridge import Model
from ingest.executor import PoolExecutor
from ingest.photo import Photo
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.register.structure.similarity import similarities
from ingest.scan import ScanOptions, scan_folder
from ingest.workspace import Workspace


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--block", type=int, default=20, help="photos of a block")
    parser.add_argument("--max-features", type=int, default=3000)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args(argv)
    photos = list(scan_folder(args.folder, ScanOptions()).usable)
    making = MapMakingOptions(extractor=ExtractorOptions(max_features=args.max_features))
    whole = _models(photos, making, args)
    cut = ClusterOptions(max_block_photos=args.block)
    parts = _models(photos, replace(making, clusters=cut), args)
    for name, models in (("at once", whole), (f"blocks of {args.block}", parts)):
        sys.stdout.write(f"{name}: models of {', '.join(str(len(m.rows)) for m in models)} photos\n")
    for part in parts:
        sys.stdout.write(_difference(whole[0], part) + "\n")
    return 0


def _models(photos: list[Photo], making: MapMakingOptions, args: argparse.Namespace) -> list[Model]:
    with PoolExecutor(args.workers) as executor:
        done = reconstruct_photos(photos, Workspace(root=args.work, job_id="blocks"), making, executor)
    return list(done.reconstruction.models())


def _difference(whole: Model, part: Model) -> str:
    both, in_whole, in_part = np.intersect1d(whole.rows, part.rows, return_indices=True)
    if len(both) < 4:
        return f"{len(part.rows)} photos: {len(both)} of them in the largest model of all"
    target, source = whole.centers()[in_whole], part.centers()[in_part]
    scale, rotation, translation, _ = similarities(source[None], target[None])
    apart = np.linalg.norm(scale[0] * source @ rotation[0].T + translation[0] - target, axis=1)
    extent = float(np.linalg.norm(target - target.mean(axis=0), axis=1).mean())
    return (
        f"{len(part.rows)} photos: centres differ by {np.median(apart) / extent:.1e} at the median, "
        f"{apart.max() / extent:.1e} at most"
    )


if __name__ == "__main__":
    sys.exit(main())
