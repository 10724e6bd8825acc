"""What an ingest costs beside COLMAP's own pipeline on the same photos, in processor time of one run.

    python -m tools.ingest_benchmark FOLDER [FOLDER ...] [--json FILE]

COLMAP is pycolmap: SIFT of photos at 1600 px, pairs of 15 neighbours where photos have positions and all
pairs where they have none, incremental mapping. Ours is `featuredb ingest photos` into a new database, to the
commit. Each is a process of its own, the one after the other.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from tools.figures import study_parser, write_figures
from tools.made_maps import all_maps, photo_names

_NEIGHBOURS = 15
_SIDE_PX = 1600
_THEIRS = f"""
import sys
import pycolmap
photos, work = sys.argv[1:]
pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
pycolmap.set_random_seed(0)
features = pycolmap.FeatureExtractionOptions()
features.max_image_size = {_SIDE_PX}
database = work + "/colmap.db"
pycolmap.extract_features(database, photos, extraction_options=features)
with pycolmap.Database.open(database) as opened:
    placed = opened.num_pose_priors()
if placed:
    pairs = pycolmap.SpatialPairingOptions()
    pairs.max_num_neighbors = {_NEIGHBOURS}
    pycolmap.match_spatial(database, pairing_options=pairs)
else:
    pycolmap.match_exhaustive(database)
models = pycolmap.incremental_mapping(database, photos, work).values()
print(max((m.num_reg_images() for m in models), default=0))
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Of one set: processor seconds, and photos in the largest model or map."""

    folder: str
    photos: int
    colmap_s: float
    colmap_photos: int
    ours_s: float
    ours_photos: int

    @property
    def ratio(self) -> float:
        return self.ours_s / self.colmap_s

    def figures(self) -> dict[str, float]:
        found = asdict(self)
        del found["folder"]
        return found | {"ratio": self.ratio}


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    costs = [measured(folder) for folder in args.folders]
    figures = {f"{cost.folder}_{name}": value for cost in costs for name, value in cost.figures().items()}
    figures["worst_ratio"] = max(cost.ratio for cost in costs)
    figures["fewer"] = max(cost.colmap_photos - cost.ours_photos for cost in costs)
    write_figures(args.json, figures)
    return 0


def measured(folder: Path) -> Cost:
    """Both programs over the photos of a folder."""
    with tempfile.TemporaryDirectory() as scratch:
        colmap_s, told = _processor_s("-c", _THEIRS, str(folder), scratch)
        database = Path(scratch) / "db"
        ours_s, _ = _processor_s(
            *("-m", "featuredb.cli", "ingest", "photos", str(database), str(folder), "--quiet")
        )
        largest = max(len(one.images) for one in all_maps(database))
    return Cost(
        folder=folder.parent.name,
        photos=len(photo_names(folder)),
        colmap_s=colmap_s,
        colmap_photos=int(told.split()[-1]),
        ours_s=ours_s,
        ours_photos=largest,
    )


def _processor_s(*argv: str) -> tuple[float, str]:
    """Of a Python process and all that it started; and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, *argv], stdout=subprocess.PIPE, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"exit code {done.returncode}: {' '.join(argv[:4])}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
