"""How many verified matches mean that two photos show one place? Related against unrelated pairs.

Run: python tools/pair_inliers.py FOLDER OTHER_FOLDER --out DIR [--photos 12]

Pairs inside each folder are candidates for one place; pairs across the folders cannot be. Writes
pair_inliers.csv and pair_inliers.png: the share of pairs with at least so many verified matches. The gate
(`MatchOptions.min_inliers`) belongs where no pair across the folders comes.
"""

import argparse
import csv
import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from ingest.executor import PoolExecutor
from ingest.extract import extract_photos, features_key
from ingest.matching import MatchOptions, PhotoView, match_pairs
from ingest.photo import Photo
from ingest.reconstruction import MapMakingOptions, photo_cameras
from ingest.scan import ScanOptions, scan_folder
from ingest.workspace import Workspace

mpl.use("Agg")  # no display is needed


def main(argv: Sequence[str] | None = None) -> int:
    """Match, count, write the table and the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--photos", type=int, default=12, help="of each folder")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args(argv)
    groups = [list(scan_folder(f, ScanOptions()).usable[: args.photos]) for f in (args.folder, args.other)]
    counts = _inliers(groups, args.out, args.workers)
    _write(counts, args.out)
    return 0


def _inliers(groups: list[list[Photo]], out: Path, workers: int) -> list[tuple[bool, int, int]]:
    """(in one folder, matches before verification, verified matches) of every pair."""
    photos = [p for group in groups for p in group]
    group_of = [g for g, group in enumerate(groups) for _ in group]
    making = MapMakingOptions(matching=replace(MatchOptions(), min_inliers=0))
    workspace = Workspace(root=out / "work", job_id="pairs")
    cameras, rows = photo_cameras(photos, making)
    key = features_key(making.extractor)
    views = [
        PhotoView(
            sha256=photo.sha256,
            features=workspace.features(key, photo.sha256),
            camera=cameras[row][0],
            focal_known=cameras[row][1],
        )
        for photo, row in zip(photos, rows, strict=True)
    ]
    pairs = list(itertools.combinations(range(len(photos)), 2))
    with PoolExecutor(workers) as executor:
        extract_photos(photos, workspace, making.extractor, executor)
        matched = match_pairs(views, pairs, workspace, making.matching, executor)
    counts = []
    for i, j in matched.inliers:
        view = matched.geometry((i, j))
        counts.append((group_of[i] == group_of[j], int(view.candidates), len(view.inliers)))
    return counts


def _write(counts: list[tuple[bool, int, int]], out: Path) -> None:
    with (out / "pair_inliers.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["one_folder", "matches", "verified"])
        writer.writerows(counts)
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    gate = MatchOptions().min_inliers
    for same, label in ((True, "one folder"), (False, "different places")):
        values = np.sort([v for one, _, v in counts if one == same])
        shares = 1.0 - np.arange(len(values)) / max(len(values), 1)
        axes.step(np.maximum(values, 1), shares, where="post", label=label)
        sys.stdout.write(
            f"{label}: {len(values)} pairs, verified matches: median {np.median(values):.0f}, "
            f"99 % {np.percentile(values, 99):.0f}, largest {values[-1]}, "
            f"at least {gate}: {(values >= gate).mean():.1%}\n"
        )
    axes.axvline(gate, color="black", linestyle=":", label=f"gate {gate}")
    axes.set(xscale="log", xlabel="verified matches", ylabel="share of pairs with at least so many")
    axes.legend()
    figure.savefig(out / "pair_inliers.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    sys.exit(main())
