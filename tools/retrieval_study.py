"""Does a photo's true place reach the pose solver? Right, wrong and no answers by how places are chosen.

    python -m tools.retrieval_study DB WORLD --kind canary --kind late [--quarantined] [--every 1] [--each]

Photos of an album of the simulated world (`featuredb simworld`, `tools/growth_*.py` keep theirs) are asked of
a database as a client would ask that knows nothing but the file, with the features extracted before. Columns:
places on the shortlist, places tried, answers within 2 m of the truth, others, none, processor seconds.
--each prints, instead, a line for each photo as it is answered by default, with the evidence.
"""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from featuredb.features.decode import decode_gray
from featuredb.features.extractor import extract
from featuredb.features.features import Features
from featuredb.store import Database
from reloc.candidates import IndexedArea
from reloc.localise import localise_features
from reloc.localiser import Localiser
from reloc.options import LocaliseOptions
from reloc.result import LocaliseRequest, LocaliseResult
from reloc.service.handler import localise_request
from reloc.wire import LocaliseWireRequest
from tools.growth_common import WRONG_M, Album, open_album, table

# Shortlist and places tried: votes alone, the default, votes alone with more, all of the shortlist.
_WAYS = ((3, 3), (10, 3), (5, 5), (10, 10))


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    database, album = Database.open(args.db), open_album(args.world)
    held = [m.map_id for m in database.snapshot().maps() if m.status == "quarantined"]
    areas = Localiser.open(database, also=held if args.quarantined else ()).areas
    options = LocaliseOptions()
    names = [fact.name for fact in album.of(*args.kind)][:: args.every]
    asked = {name: _query(album.folder / name, options) for name in names}
    if args.each:
        sys.stdout.write(_evidence_of_each(album, asked, areas, options) + "\n")
        return 0
    rows = []
    for shortlist, tried in _WAYS:
        ways = replace(options.candidates, shortlist=shortlist, max_clusters=tried)
        start = time.process_time()
        counts = {"right": 0, "wrong": 0, "none": 0}
        for name, (features, request) in asked.items():
            found = localise_features(features, request, areas, replace(options, candidates=ways))
            counts[_verdict(album, name, found.result)] += 1
        rows.append((shortlist, tried, *counts.values(), round(time.process_time() - start, 1)))
    sys.stdout.write(f"{len(asked)} photos\n")
    sys.stdout.write(table(rows, ("shortlist", "tried", "right", "wrong", "none", "cpu s")) + "\n")
    return 0


def _evidence_of_each(
    album: Album,
    asked: Mapping[str, tuple[Features, LocaliseRequest]],
    areas: Sequence[IndexedArea],
    options: LocaliseOptions,
) -> str:
    rows = []
    for name, (features, request) in asked.items():
        result = localise_features(features, request, areas, options).result
        e = result.evidence
        if e is None:
            continue
        rows.append(
            (
                *(_verdict(album, name, result), album.facts[name].kind, name, result.reason or ""),
                *(e.inliers, e.log_nfa, e.coverage, e.agreement, e.spread),
            )
        )
    head = ("answer", "kind", "photo", "reason", "inliers", "log nfa", "coverage", "agreement", "spread")
    return table(sorted(rows, key=lambda row: (row[0], row[-1])), head)


def _query(path: Path, options: LocaliseOptions) -> tuple[Features, LocaliseRequest]:
    data = path.read_bytes()
    gray = decode_gray(data)
    return extract(gray, options.extractor), localise_request(LocaliseWireRequest(), data, gray)


def _verdict(album: Album, name: str, result: LocaliseResult) -> str:
    if result.pose is None:
        return "none"
    true = album.truth.images.get(name)
    if true is None:
        return "wrong"
    center = album.truth.frame.enu_from(result.pose.frame).act(result.pose.cam_from_local.center[None])[0]
    return "right" if np.linalg.norm(center - true.cam_from_local.center) <= WRONG_M else "wrong"


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("db", type=Path)
    parser.add_argument("world", type=Path, help="folder of the album")
    parser.add_argument("--kind", action="append", required=True, help="of photos; may be repeated")
    parser.add_argument("--every", type=int, default=1, help="only every n-th photo; default: 1")
    parser.add_argument("--each", action="store_true", help="the evidence of each photo's answer")
    parser.add_argument("--quarantined", action="store_true", help="quarantined maps answer, too")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
