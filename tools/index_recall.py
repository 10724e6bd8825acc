"""How many inverted lists must a search visit? Recall of the true nearest map point against probes, and time.

uv run python tools/index_recall.py DB IMAGE...
"""

import argparse
import time
from pathlib import Path

import numpy as np

from featuredb.features.decode import decode_gray
from featuredb.features.extractor import extract
from featuredb.index.descriptor_index import IndexOptions, build_index
from featuredb.index.nearest import nearest
from featuredb.store import Database
from reloc.localiser import Localiser
from reloc.options import LocaliseOptions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("db")
    parser.add_argument("image", nargs="+", type=Path)
    parser.add_argument("--probes", type=int, nargs="+", default=[1, 2, 4, 8, 16, 32, 64])
    args = parser.parse_args()
    options = LocaliseOptions()
    votes = options.candidates.vote_features
    area = max((a.area for a in Localiser.open(Database.open(args.db)).areas), key=lambda a: len(a.points))
    query = np.concatenate(
        [extract(decode_gray(p), options.extractor).descriptors[:votes] for p in args.image]
    )
    squared, true = nearest(query, area.descriptors, 2)
    # Only features that the ratio test would keep have a true neighbour worth finding.
    clear = np.sqrt(squared[:, 0]) < options.matching.ratio * np.sqrt(squared[:, 1])
    print(f"{len(area.descriptors)} points, {len(query)} features, {clear.sum()} with a clear neighbour")
    print(f"{'probes':>8}{'recall':>9}{'ms per photo':>14}")
    for probes in args.probes:
        index = build_index(area.descriptors, IndexOptions(probes=probes))
        index.search(query[:votes], 1)
        start = time.perf_counter()
        _, found = index.search(query, 1)
        each_ms = 1000.0 * (time.perf_counter() - start) / len(args.image)
        print(f"{probes:>8}{float((found[clear, 0] == true[clear, 0]).mean()):>9.4f}{each_ms:>14.1f}")


if __name__ == "__main__":
    main()
