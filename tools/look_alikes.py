"""How many verified pairs of an album show different places: what look-alikes a simulated town has.

    python -m tools.look_alikes --world ALBUM --work DB/_work [--max-features 8000]

ALBUM is a folder of `featuredb.simworld` albums (tools/growth_community.py makes one), DB the database that
has matched its photos. Of each pair with a verified two-view geometry, matches are intersected with the true
cameras: right if more than 70 % of them fit within 4 pixels (at 1600), wrong below 30 %. Prints both by the
number of matches, without re-uploads, which show no parallax. Real photos of different places have no such
pair (tools/pair_inliers.py).
"""

import argparse
import hashlib
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from featuredb.features.features import Features
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.truth import TrueImage
from ingest.extract import features_key, read_features
from ingest.growth.groups import intersections
from ingest.matching import read_two_view
from ingest.workspace import Workspace
from tools.growth_common import Album, making_options, open_album, table

_BINS = (20, 30, 40, 60, 80, 120, 200, 10**9)
_TOLERANCE_PX, _REFERENCE_SIDE_PX = 4.0, 1600.0
_RIGHT, _WRONG = 0.7, 0.3


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    found = list(fitting(open_album(args.world), args.work, args.max_features))
    if not found:
        raise SystemExit(f"{args.work}: expected matches of photos of {args.world}, found none")
    count, fit = (np.array(column) for column in zip(*found, strict=True))
    rows = []
    for low, high in pairwise(_BINS):
        here = (count >= low) & (count < high)
        rows.append((f"{low} and more", *_split(fit[here])))
    rows.append(("all", *_split(fit)))
    sys.stdout.write(table(rows, ("matches", "right", "wrong", "neither")) + "\n")
    return 0


def _split(fit: FloatArray) -> tuple[int, int, int]:
    right, wrong = int((fit > _RIGHT).sum()), int((fit < _WRONG).sum())
    return right, wrong, len(fit) - right - wrong


def fitting(album: Album, work: Path, max_features: int) -> Iterator[tuple[int, float]]:
    """Verified matches of each pair of the town's photos, and the share that fits the true cameras."""
    names = {
        hashlib.sha256((album.folder / fact.name).read_bytes()).hexdigest(): fact.name
        for fact in album.of("street", "drone")
        if fact.name in album.truth.images
    }
    key = features_key(making_options(max_features).extractor)
    workspace = Workspace(root=work, job_id="-")
    cache: dict[str, Features] = {}
    for file in sorted(work.glob("matches/*/*/*.npz")):
        pair = file.stem.split("_")
        if not all(digest in names for digest in pair):
            continue
        matches = read_two_view(file).inliers
        if len(matches) < _BINS[0]:
            continue
        for digest in pair:
            if digest not in cache:
                cache[digest] = read_features(workspace.features(key, digest)).features
        true = [album.truth.images[names[digest]] for digest in pair]
        yield len(matches), _share(true, [cache[d] for d in pair], matches)


def _share(true: Sequence[TrueImage], features: Sequence[Features], matches: np.ndarray) -> float:
    """Share of the matches (m, 2) whose rays by the true cameras meet where both photos have them."""
    pixels = [f.xy[matches[:, i]].astype(np.float64) for i, f in enumerate(features)]
    points, _ = intersections(
        true[0].camera, true[0].cam_from_local, pixels[0], true[1].camera, true[1].cam_from_local, pixels[1]
    )
    fits = np.ones(len(points), dtype=np.bool_)
    for image, seen in zip(true, pixels, strict=True):
        error = np.linalg.norm(image.camera.project(image.cam_from_local.act(points)) - seen, axis=1)
        side = max(image.camera.width, image.camera.height)
        fits &= error < _TOLERANCE_PX * max(1.0, side / _REFERENCE_SIDE_PX)
    return float(fits.mean())


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, required=True, metavar="ALBUM")
    parser.add_argument("--work", type=Path, required=True, help="the database's work folder")
    parser.add_argument("--max-features", type=int, default=8000, help="as the photos were matched")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
