"""How many of the photos that COLMAP reconstructs together stay together in one map of ours.

    python -m tools.colmap_baseline FOLDER [--no-positions] --work DIR [--json FILE]

COLMAP is pycolmap with its defaults: SIFT, exhaustive matching, incremental mapping of every picture in the
folder. Ours is `featuredb ingest photos` into a new database, and what is read back from it: maps, placed or
not; with `--no-positions` of copies without any position (JPEG). Prints the photos of COLMAP's largest model,
how many of these are in our largest map, and the time of both. COLMAP's
result stays in the work folder and is made once.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import pycolmap

from tools.figures import study_parser, write_figures
from tools.made_maps import all_maps, copied, make

_PICTURES = {".jpg", ".jpeg", ".png"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Grouped:
    """Photos that one program put together.

    Attributes:
        groups: names of the photos of each reconstruction, largest first.
        wall_s: from the files to the reconstructions.
    """

    groups: tuple[tuple[str, ...], ...]
    wall_s: float

    @property
    def largest(self) -> frozenset[str]:
        """Photos of the largest reconstruction."""
        return frozenset(self.groups[0]) if self.groups else frozenset()


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    args.work.mkdir(parents=True, exist_ok=True)
    theirs = colmap_groups(args.folder, args.work)
    mine, placed = our_groups(args.folder, args.work, positions=not args.no_positions)
    both = len(theirs.largest & mine.largest)
    figures = {
        "photos": len(pictures(args.folder)),
        "positions": not args.no_positions,
        "colmap_largest": len(theirs.largest),
        "ours_largest": len(mine.largest),
        "ours_of_colmap_largest": both,
        "share": both / max(1, len(theirs.largest)),
        "colmap_groups": [len(g) for g in theirs.groups],
        "our_groups": [len(g) for g in mine.groups],
        "placed": placed,
        "colmap_s": theirs.wall_s,
        "ours_s": mine.wall_s,
        "times": mine.wall_s / theirs.wall_s,
        "missing": sorted(theirs.largest - mine.largest),
    }
    write_figures(args.json, figures)
    return 0


def pictures(folder: Path) -> list[str]:
    """Names of the pictures in the folder and its folders."""
    found = (p for p in folder.rglob("*") if p.suffix.lower() in _PICTURES)
    return sorted(p.relative_to(folder).as_posix() for p in found)


def colmap_groups(folder: Path, work: Path) -> Grouped:
    """COLMAP's reconstructions, made now or read from the work folder."""
    kept = work / "colmap.json"
    if kept.exists():
        document = json.loads(kept.read_text(encoding="utf-8"))
        return Grouped(groups=tuple(tuple(g) for g in document["groups"]), wall_s=document["wall_s"])
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=work) as scratch:
        database, output = Path(scratch) / "colmap.db", Path(scratch) / "models"
        output.mkdir()
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
        pycolmap.set_random_seed(0)
        pycolmap.extract_features(str(database), str(folder), image_names=pictures(folder))
        pycolmap.match_exhaustive(str(database))
        models = pycolmap.incremental_mapping(str(database), str(folder), str(output)).values()
        names = [sorted(m.image(i).name for i in m.reg_image_ids()) for m in models]
    groups = tuple(tuple(g) for g in sorted(names, key=lambda g: (-len(g), g)))
    found = Grouped(groups=groups, wall_s=time.perf_counter() - started)
    kept.write_text(json.dumps(asdict(found), indent=1) + "\n", encoding="utf-8")
    return found


def our_groups(folder: Path, work: Path, *, positions: bool) -> tuple[Grouped, int]:
    """Photos of the maps in a new database after one ingest, and how many of the maps have a place."""
    with tempfile.TemporaryDirectory(dir=work) as scratch:
        photos, names = folder, pictures(folder)
        if not positions:
            photos = copied(folder, names, Path(scratch) / "photos", strip=True)
        made = make(Path(scratch) / "db", "photos", photos, len(names))
        maps = all_maps(Path(scratch) / "db")
    groups = [tuple(sorted(image.name for image in one.images)) for one in maps]
    groups.sort(key=lambda g: (-len(g), g))
    return Grouped(groups=tuple(groups), wall_s=made.seconds), made.placed


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = study_parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--no-positions", action="store_true")
    parser.add_argument("--work", type=Path, required=True, help="where COLMAP's result is kept")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
