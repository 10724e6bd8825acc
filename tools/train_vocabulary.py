"""Train a vocabulary of visual words, once, for retrieval of similar photos.

    featuredb simworld world --size full
    uv run python tools/train_vocabulary.py world/drone world/street world/negatives/other_town --every 4 \\
        --out featuredb/index/data/vocabulary.npz

made the one that comes with featuredb: of photos that everybody can make again, by fixed seeds and on one
thread. Others are used with `featuredb ingest photos --vocabulary FILE`. tools/retrieval_recall.py compares
them.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from featuredb.features.extractor import ExtractorOptions
from featuredb.index.codebook import use_threads
from featuredb.index.vocabulary import train_vocabulary
from ingest.executor import InProcessExecutor, PoolExecutor
from ingest.extract import extract_photos, features_key
from ingest.scan import ScanOptions, scan_folder
from ingest.workspace import Workspace, read_array

_FEATURES = 3000  # the strongest of a photo, those that PairOptions aggregates


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="of each folder's photos, each Nth")
    parser.add_argument("--words", type=int, default=128)
    parser.add_argument("--dimensions", type=int, default=32)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(argv)
    use_threads(1)
    photos = [p for f in args.folders for p in scan_folder(f, ScanOptions()).usable[:: args.every]]
    options = ExtractorOptions(max_features=_FEATURES)
    with tempfile.TemporaryDirectory() as scratch:
        workspace = Workspace(root=Path(scratch), job_id="vocabulary")
        if args.workers == 1:
            extract_photos(photos, workspace, options, InProcessExecutor())
        else:
            with PoolExecutor(args.workers) as pool:
                extract_photos(photos, workspace, options, pool)
        key = features_key(options)
        descriptors = [read_array(workspace.features(key, p.sha256), "descriptors") for p in photos]
    vocabulary = train_vocabulary(descriptors, words=args.words, dimensions=args.dimensions)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_bytes(vocabulary.to_bytes())
    sys.stdout.write(
        f"{args.out}: {args.words} words of {args.dimensions} dimensions from {len(photos)} photos, "
        f"digest {vocabulary.digest}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
