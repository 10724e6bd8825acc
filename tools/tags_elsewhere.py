"""How far off are groups of photos whose positions agree on another place, right ones and wrong ones?

    python -m tools.tags_elsewhere --world WORLD --photos FOLDER --work WORK

WORLD is an album of `featuredb.simworld` (tools/growth_scale.py writes one), FOLDER its photos or some of
them, WORK the work folder of an ingest of these (`featuredb ingest photos DB FOLDER`: DB/_work), which is not
done again. Prints, for each model that GPS places, each group of photos outside it whose positions agree:
their common offset in metres and over the limit of `ElsewhereOptions`, and how many of them are where the
rest of the model is by the truth. The limit belongs between the two kinds.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ingest.executor import PoolExecutor
from ingest.placed_models import placed_by_gps
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.register.gps import GpsOptions, place_by_gps
from ingest.scan import require_usable, scan_folder
from ingest.tagged_elsewhere import agreeing_groups, least_offset_m
from ingest.workspace import Workspace
from tools.growth_common import open_album, table

_APART_M, _FIT_SIGMA_M = 1.0, 0.3


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    options, truth = MapMakingOptions(), open_album(args.world).truth
    photos = require_usable(scan_folder(args.photos), args.photos, least=3)
    prefix = args.photos.relative_to(args.world).as_posix() if args.photos.is_relative_to(args.world) else "."
    with PoolExecutor(args.workers) as pool:
        workspace = Workspace(root=args.work, job_id="tags-elsewhere")
        done = reconstruct_photos(photos, workspace, options, pool)
    rows = []
    for number, model in enumerate(done.reconstruction.models()):
        chosen = [done.usable[r] for r in model.rows]
        _, with_gps, placed = placed_by_gps(model, chosen, options.gps)
        if placed.reason is not None:
            continue
        names = [(Path(prefix) / photo.name).as_posix() for photo in chosen]
        true = np.array([truth.images[name].cam_from_local.center for name in names])
        fit = place_by_gps(model.centers(), true, np.full(true.shape, _FIT_SIGMA_M), GpsOptions())
        right = np.linalg.norm(fit.residuals_m, axis=1) <= _APART_M
        least = least_offset_m(placed, options.elsewhere)
        rows += [
            (number, len(g.photos), int(right[list(g.photos)].sum()), g.offset_m, g.offset_m / least)
            for g in agreeing_groups(model, with_gps, placed, options.elsewhere)
        ]
    head = ("model", "photos", "right", "offset m", "over limit")
    sys.stdout.write(table(sorted(rows, key=lambda row: row[-1]), head) + "\n")
    return 0


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
