"""How many overlapping pairs of photos retrieval finds, against all pairs matched.

    uv run python tools/retrieval_recall.py brighton/images lewis/images copr/images sacre_coeur/mapping \\
        --work DIR

All pairs within each folder are matched and verified. Then every photo asks for its k most similar ones
among the photos of all folders, without any position or time, as photos without geotags do. Printed for each
k: the pairs tried for each photo, and the share of verified pairs among them; then the same after
`more_pairs`, which tries photos that overlap the same others; and the share of photos that the found pairs
connect, of those that all pairs connect. Matching everything takes minutes; it is kept in the work folder.
"""

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions
from featuredb.index.codebook import use_threads
from featuredb.index.photo_index import most_similar
from featuredb.index.vocabulary import read_vocabulary, shipped_vocabulary
from ingest.clusters.graph import Graph
from ingest.executor import Executor, InProcessExecutor, PoolExecutor
from ingest.extract import extract_photos, features_key
from ingest.matching import PhotoView, match_pairs
from ingest.pairs import Pair, PairOptions, more_pairs
from ingest.photo import Photo
from ingest.reconstruction import MapMakingOptions, photo_cameras
from ingest.retrieval.aggregate import aggregate_photos
from ingest.scan import ScanOptions, scan_folder
from ingest.workspace import Workspace


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """One folder: its rows among all photos, and all its verified pairs."""

    name: str
    rows: range
    inliers: dict[Pair, int]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--vocabulary", type=Path, default=None, help="default: the one of featuredb")
    parser.add_argument("--max-features", type=int, default=3000)
    parser.add_argument("--neighbours", type=int, nargs="+", default=[4, 8, 12, 16, 20])
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args(argv)
    use_threads(1)
    if args.workers == 1:
        truths, vectors = _measure(args, InProcessExecutor())
    else:
        with PoolExecutor(args.workers) as pool:
            truths, vectors = _measure(args, pool)
    sys.stdout.write(
        f"{'folder':<24}{'photos':>7}{'pairs':>7}{'k':>4}{'tried':>7}{'found':>7}{'joined':>8}"
        f"{'tried+':>8}{'found+':>8}{'joined+':>9}\n"
    )
    for truth, k in itertools.product(truths, args.neighbours):
        sys.stdout.write(_line(truth, vectors, k) + "\n")
    return 0


def _measure(args: argparse.Namespace, executor: Executor) -> tuple[list[Truth], NDArray[np.float16]]:
    """Verified pairs of every folder, and the vectors of all photos."""
    making = MapMakingOptions(extractor=ExtractorOptions(max_features=args.max_features))
    workspace = Workspace(root=args.work, job_id="recall")
    vocabulary = read_vocabulary(args.vocabulary) if args.vocabulary else shipped_vocabulary()
    truths: list[Truth] = []
    files: list[Path] = []
    for folder in args.folders:
        photos = list(scan_folder(folder, ScanOptions()).usable)
        extract_photos(photos, workspace, making.extractor, executor)
        views = _views(photos, workspace, making)
        pairs = list(itertools.combinations(range(len(photos)), 2))
        inliers = match_pairs(views, pairs, workspace, making.matching, executor).inliers
        start = len(files)
        truths.append(
            Truth(
                name="/".join(folder.parts[-2:]),
                rows=range(start, start + len(photos)),
                inliers={(start + i, start + j): count for (i, j), count in inliers.items()},
            )
        )
        files += [view.features for view in views]
    most = PairOptions().features_per_photo
    return truths, aggregate_photos(files, vocabulary, most, workspace, executor)


def _views(photos: list[Photo], workspace: Workspace, making: MapMakingOptions) -> list[PhotoView]:
    cameras, rows = photo_cameras(photos, making)
    key = features_key(making.extractor)
    return [
        PhotoView(
            sha256=photo.sha256,
            features=workspace.features(key, photo.sha256),
            camera=cameras[row][0],
            focal_known=cameras[row][1],
        )
        for photo, row in zip(photos, rows, strict=True)
    ]


def _line(truth: Truth, vectors: NDArray[np.float16], k: int) -> str:
    """One folder with one number of neighbours."""
    near, _ = most_similar(vectors, np.array(truth.rows, dtype=np.int64), k)
    tried = {
        (min(i, j), max(i, j))
        for i, row in zip(truth.rows, near.tolist(), strict=True)
        for j in row
        if j >= 0
    }
    verified = {pair: count for pair, count in truth.inliers.items() if pair in tried}
    options = replace(PairOptions(), exhaustive_max_photos=0)
    more = set(more_pairs(len(vectors), verified, tried, options))
    then = {pair: count for pair, count in truth.inliers.items() if pair in tried | more}
    return (
        f"{truth.name:<24}{len(truth.rows):>7}{len(truth.inliers):>7}{k:>4}"
        + _shares(truth, tried, verified, len(vectors))
        + _shares(truth, tried | more, then, len(vectors), wide=1)
    )


def _shares(truth: Truth, tried: set[Pair], verified: Mapping[Pair, int], photos: int, wide: int = 0) -> str:
    found = len(verified) / max(len(truth.inliers), 1)
    joined = _largest(truth, verified, photos) / _largest(truth, truth.inliers, photos)
    return f"{len(tried) / len(truth.rows):>{7 + wide}.1f}{found:>{7 + wide}.2f}{joined:>{8 + wide}.2f}"


def _largest(truth: Truth, inliers: Mapping[Pair, int], photos: int) -> int:
    """Photos of the largest connected part."""
    return len(Graph.of(photos, inliers).components(np.array(truth.rows))[0])


if __name__ == "__main__":
    sys.exit(main())
