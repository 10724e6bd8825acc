"""What tells photos that a look-alike building has joined to the wrong place from right ones?

    python -m tools.look_alike_joints --world WORLD --photos FOLDER --work WORK [--max-features N]

WORLD is an album of `featuredb.simworld` (tools/growth_scale.py writes one), FOLDER its photos or some of
them, WORK the work folder of an ingest of these (`featuredb ingest photos DB FOLDER`: DB/_work), which is not
done again. A photo is right if it is where the rest of its model is by the truth. Prints

1. by the number of points that pairs of photos have in common: how many right and wrong photos hang on the
   largest part of their model by fewer, and how many of these in parts that are large enough for a map;
2. for each model that GPS places, each group of photos outside the placement whose positions agree: their
   common offset in metres and over the limit of `ElsewhereOptions`, and how many of them are right.

The limits belong between the two kinds: `MapMakingOptions.min_tie`, `ElsewhereOptions`.
"""

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.extractor import ExtractorOptions
from ingest.colmap_bridge import Model
from ingest.executor import PoolExecutor
from ingest.links import tied_parts
from ingest.photo import Photo
from ingest.placed_models import placed_by_gps
from ingest.reconstruction import MapMakingOptions, reconstruct_photos
from ingest.scan import require_usable, scan_folder
from ingest.submodel import select_photos
from ingest.tagged_elsewhere import agreeing_groups, least_offset_m
from ingest.workspace import Workspace
from tools.growth_common import open_album, table, with_the_rest

_TIES = (15, 20, 30, 40, 50, 75, 100, 150)
_TIES_HEAD = ("points", "right photos outside", "in parts for a map", "wrong photos outside", "wrong inside")
_POSITIONS_HEAD = ("photos", "right", "offset m", "over limit")


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    options = MapMakingOptions(extractor=ExtractorOptions(max_features=args.max_features))
    truth = open_album(args.world).truth
    photos = require_usable(scan_folder(args.photos), args.photos, least=options.sfm.min_model_photos)
    prefix = args.photos.relative_to(args.world).as_posix() if args.photos.is_relative_to(args.world) else "."
    with PoolExecutor(args.workers) as pool:
        workspace = Workspace(root=args.work, job_id="look-alike-joints")
        done = reconstruct_photos(photos, workspace, options, pool)
    models = list(done.reconstruction.models())

    def right(model: Model) -> NDArray[np.bool_]:
        names = [(Path(prefix) / done.usable[row].name).as_posix() for row in model.rows]
        true = np.array([truth.images[name].cam_from_local.center for name in names])
        return with_the_rest(model.centers(), true)

    judged = [(model, right(model)) for model in models]
    _show(by_ties(judged, options), _TIES_HEAD)
    groups = [group for model, good in judged for group in by_positions(model, good, done.usable, options)]
    groups.sort(key=lambda group: group[-1])
    _show(groups, _POSITIONS_HEAD)
    return 0


def by_ties(
    models: Sequence[tuple[Model, NDArray[np.bool_]]], options: MapMakingOptions
) -> Iterator[tuple[int, int, int, int, int]]:
    """A row for each number of points in common."""
    for least in _TIES:
        outside_right = in_parts = outside_wrong = inside_wrong = 0
        for model, right in models:
            largest, *others = tied_parts(model, least)
            inside_wrong += int((~right[np.isin(model.rows, largest)]).sum())
            for rows in others:
                here = right[np.isin(model.rows, rows)]
                outside_right += int(here.sum())
                outside_wrong += int((~here).sum())
                in_parts += int(here.sum()) if len(rows) >= options.sfm.min_model_photos else 0
        yield least, outside_right, in_parts, outside_wrong, inside_wrong


def by_positions(
    model: Model, right: NDArray[np.bool_], photos: Sequence[Photo], options: MapMakingOptions
) -> Iterator[tuple[int, int, float, float]]:
    """A row for each group of each part that GPS places."""
    for rows in tied_parts(model, options.min_tie):
        if len(rows) < options.sfm.min_model_photos:
            continue
        part, inside = select_photos(model, rows), right[np.isin(model.rows, rows)]
        _, with_gps, placed = placed_by_gps(part, [photos[r] for r in part.rows], options.gps)
        if placed.reason is not None:
            continue
        least = least_offset_m(placed, options.elsewhere)
        for group in agreeing_groups(part, with_gps, placed, options.elsewhere):
            agree = int(inside[list(group.photos)].sum())
            yield len(group.photos), agree, group.offset_m, group.offset_m / least


def _show(rows: Iterable[Sequence[object]], head: Sequence[str]) -> None:
    sys.stdout.write(table(list(rows), head) + "\n\n")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--world", type=Path, required=True)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--max-features", type=int, default=ExtractorOptions().max_features)
    parser.add_argument("--workers", type=int, default=2)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
