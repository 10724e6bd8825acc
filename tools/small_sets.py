"""Maps of few photos: are their cameras inside the bounds that they state?

Runs of four, six and eight photos, in the order of their names, each become a database of their own: of
--photos with the positions of their EXIF, against poses that the scan alone gives (tools/scan_poses.py);
of FOLDERs with laser truth (`tools.laser_set`) with exact positions. Prints of the photos in placed maps how
many are outside the 99.9 % bound of their map, the largest squared errors over their covariances (three axes;
16.3 is 99.9 %), and by how much a focal length is off at most.
"""

import argparse
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import FeatureMap
from tools.commands import all_maps, make
from tools.figures import bounds_figures, write_figures
from tools.laser_set import FRAME, read_laser_set, with_exif
from tools.laser_truth import camera_squares
from tools.photo_files import copied
from tools.scan_poses import scan_parser, scan_truth

_SIZES, _EVERY = (4, 6, 8), 2


class Run(NamedTuple):
    """Photos in `folder`/photos; their true poses in a frame, by name, and the true lens."""

    folder: Path
    frame: LocalFrame
    true: dict[str, Rigid3]
    lens: Camera


def main() -> None:
    parser = scan_parser(__doc__, "--work")
    parser.add_argument("folders", type=Path, nargs="*", metavar="FOLDER", help="with laser truth")
    args = parser.parse_args()
    squares: list[dict[str, list[float]]] = []
    runs = active = 0
    focal_off = 0.0
    for run in (*_by_scan(args), *(made for folder in args.folders for made in _by_laser(folder, args.work))):
        make(run.folder / "db", "photos", run.folder / "photos", ("--work", str(run.folder.parent / "cache")))
        placed = [one for one in all_maps(run.folder / "db") if isinstance(one, FeatureMap)]
        shutil.rmtree(run.folder)
        runs, active = runs + 1, active + sum(one.status == "active" for one in placed)
        for one in placed:
            focal_off = max([focal_off, *(abs(c.focal_px / run.lens.focal_px - 1.0) for c in one.cameras)])
            squares.append(camera_squares(one, run.frame, run.true))
    photos = sum(len(of["position"]) for of in squares)
    counts = {"runs": runs, "maps": len(squares), "active": active, "photos": photos}
    write_figures(args.json, counts | {"focal_off": focal_off} | bounds_figures(squares))


def _by_scan(args: argparse.Namespace) -> Iterator[Run]:
    truth = scan_truth(args)
    for names, folder in _chosen(truth.poses, args.work / "scan"):
        copied(args.photos, names, folder / "photos", strip=False)
        yield Run(folder, truth.frame, truth.poses, truth.cameras[names[0]])


def _by_laser(source: Path, work: Path) -> Iterator[Run]:
    truth = read_laser_set(source)
    for names, folder in _chosen(truth.poses, work / source.name):
        with_exif(truth, names, folder / "photos", positions=True)
        yield Run(folder, FRAME, truth.poses, truth.camera)


def _chosen(poses: dict[str, Rigid3], work: Path) -> Iterator[tuple[list[str], Path]]:
    """Names of photos that follow each other, and a new folder for them."""
    names = sorted(poses)
    for size in _SIZES:
        for first in range(0, len(names) - size + 1, _EVERY):
            folder = work / f"{size}-{first}"
            shutil.rmtree(folder, ignore_errors=True)
            yield names[first : first + size], folder


if __name__ == "__main__":
    main()
