"""Train, once, visual words for retrieval of similar photos, the centres of inverted lists, or short codes.

    featuredb simworld world --size full
    uv run python tools/train_vocabulary.py world/drone world/street world/negatives/other_town --every 4 \\
        --out featuredb/index/data/vocabulary.npz

made the one that comes with featuredb: of photos that everybody can make again, by fixed seeds and on one
thread.

    uv run python tools/train_vocabulary.py brighton/images lewis/images seneca/images copr/images \\
        reichstag/images sacre_coeur/mapping --lists 2048 --out featuredb/index/data/list_centers.npz

made the centres of the inverted lists (`featuredb.index.descriptor_index`), of real photos of many kinds; and
of the same photos `--codes --out featuredb/index/data/code_centers.npz` the centres of the codes.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import faiss
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions
from featuredb.features.features import DESCRIPTOR_SIZE
from featuredb.index.descriptor_index import CODE_PARTS, use_threads
from featuredb.index.vocabulary import Vocabulary
from ingest.executor import InProcessExecutor
from ingest.photos.scan import ScanOptions, scan_folder
from ingest.sfm.extract import extract_photos, features_key
from ingest.workspace import Workspace, read_array

_FEATURES = 3000  # the strongest of a photo, those that PairOptions aggregates
_PER_PHOTO = 1500  # of these, what the centres are trained on


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="of each folder's photos, each Nth")
    parser.add_argument("--lists", type=int, default=None, metavar="K", help="centres of K inverted lists")
    parser.add_argument("--codes", action="store_true", help="centres of the parts of a product code")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    use_threads(1)
    photos = [p for f in args.folders for p in scan_folder(f, ScanOptions()).usable[:: args.every]]
    options = ExtractorOptions(max_features=_FEATURES)
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace(root=Path(scratch))
        extract_photos(photos, workspace, options, InProcessExecutor())
        key = features_key(options)
        descriptors = [read_array(workspace.features(key, p.sha256), "descriptors") for p in photos]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.lists is not None:
        np.savez_compressed(args.out, centers=train_lists(descriptors, args.lists))
    elif args.codes:
        np.savez_compressed(args.out, centers=train_codes(descriptors))
    else:
        vocabulary = train_vocabulary(descriptors)
        np.savez(args.out, **{name: getattr(vocabulary, name) for name in ("mean", "projection", "words")})
    sys.stdout.write(f"{args.out}: of {len(photos)} photos\n")


def train_vocabulary(
    descriptors: Sequence[NDArray[np.uint8]], *, words: int = 128, dimensions: int = 32, seed: int = 0
) -> Vocabulary:
    """Principal components and k-means of some descriptors (n, 128) of each photo, with fixed random choices.

    Raises:
        InvalidValueError: fewer descriptors than 40 a word, which k-means wants at least.
    """
    samples = _samples(descriptors, words, seed)
    mean = samples.mean(axis=0, dtype=np.float64)
    _, vectors = np.linalg.eigh(np.cov((samples - mean).T))
    projection = vectors[:, ::-1][:, :dimensions]
    projection = projection * np.sign(projection[np.abs(projection).argmax(axis=0), np.arange(dimensions)])
    projected = ((samples - mean) @ projection).astype(np.float32)
    return Vocabulary(
        mean=mean.astype(np.float32),
        projection=projection.astype(np.float32),
        words=_kmeans(projected, words, seed, iterations=25).astype(np.float32),
    )


def train_lists(descriptors: Sequence[NDArray[np.uint8]], lists: int) -> NDArray[np.uint8]:
    """Centres (lists, 128) of inverted lists, rounded as descriptors are; arguments as there."""
    centers = _kmeans(_samples(descriptors, lists, 0), lists, 0, iterations=10)
    return np.asarray(np.clip(np.rint(centers), 0, 255), dtype=np.uint8)


def train_codes(descriptors: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Centres (parts, 16, 128 / parts) of a product code of 4 bits a part; see `train_vocabulary`."""
    samples = _samples(descriptors, CODE_PARTS * 16, 0)
    parts = np.split(samples, CODE_PARTS, axis=1)
    return np.array([_kmeans(part, 16, 0, iterations=25) for part in parts], dtype=np.float32)


def _samples(descriptors: Sequence[NDArray[np.uint8]], clusters: int, seed: int) -> NDArray[np.float32]:
    generator = np.random.default_rng(seed)
    parts = [np.zeros((0, DESCRIPTOR_SIZE), np.float32)]
    for photo in descriptors:
        rows = generator.choice(len(photo), min(_PER_PHOTO, len(photo)), replace=False)
        parts.append(photo[np.sort(rows)].astype(np.float32))
    samples = np.concatenate(parts)
    if len(samples) < 40 * clusters:
        raise InvalidValueError(
            f"train_vocabulary: expected at least {40 * clusters} descriptors for {clusters} words or lists, "
            f"found {len(samples)}; give more photos"
        )
    return samples


def _kmeans(samples: NDArray[np.float32], clusters: int, seed: int, iterations: int) -> NDArray[np.float64]:
    """Cluster centres (clusters, d) of samples (n, d) by Lloyd's algorithm with a fixed seed."""
    trainer = faiss.Kmeans(
        samples.shape[1],
        clusters,
        niter=iterations,
        seed=seed,
        min_points_per_centroid=1,
        max_points_per_centroid=1_000_000,
        verbose=False,
    )
    trainer.train(np.ascontiguousarray(samples, dtype=np.float32))
    return np.asarray(trainer.centroids, dtype=np.float64).reshape(clusters, -1)


if __name__ == "__main__":
    main()
