"""A map of photos without positions against the cameras that a laser scan gives (Strecha's sets).

    python -m tools.laser_truth FOLDER [--json FILE]

FOLDER has images/ and cameras/, a `NAME.camera` for each photo: calibration, camera-to-world rotation and
centre in metres, size. Copies of the photos with the EXIF of one camera (maker, model, focal length in
whole millimetres of 35 mm film) are ingested into a new database, which knows of no place; the map's camera
centres are moved onto the true ones by the similarity that fits them best. Prints photos in the map, medians
and largest of what is left: of positions in millimetres, of orientations in degrees, and the scale of the
set, its largest distance between two cameras. Exit code 0 if there is one map of all photos.
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from PIL import ExifTags, Image

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.unplaced_map import AnyMap
from tools.figures import add_json_option, write_figures
from tools.made_maps import all_maps, make, photo_names

_ROTATION_LINES, _CENTER_LINE, _SIZE_LINE = slice(4, 7), 7, 8


def main(argv: Sequence[str] | None = None) -> int:
    args = _arguments(argv)
    photos = args.folder / "images" if (args.folder / "images").is_dir() else args.folder
    names = photo_names(photos)
    truth = {name: true_pose(camera_file(args.folder / "cameras", name)) for name in names}
    with tempfile.TemporaryDirectory() as scratch:
        work = args.work or Path(scratch)
        lens = true_lens(camera_file(args.folder / "cameras", names[0]))
        shown = with_exif(photos, names, lens, work / "photos")
        made = make(work / "db", "photos", shown, len(names))
        found = all_maps(work / "db")
    figures: dict[str, object] = {"photos": len(names), "maps": made.maps, "largest": made.largest}
    if found:
        figures |= compared(max(found, key=lambda one: len(one.images)), truth)
    sys.stdout.write(f"{args.folder.name}: {figures}\n")
    write_figures(args.json, figures)
    return 0 if made.maps == 1 and made.largest == len(names) else 1


def compared(one: AnyMap, truth: dict[str, Rigid3]) -> dict[str, float]:
    """What a similarity leaves between the map's cameras and the true ones."""
    mine = np.array([image.cam_from_local.center for image in one.images])
    true = [truth[image.name] for image in one.images]
    move = best_similarity(mine, np.array([pose.center for pose in true]))
    moved = [move.act_on_pose(image.cam_from_local) for image in one.images]
    millimetres = [
        1000.0 * float(np.linalg.norm(a.center - b.center)) for a, b in zip(moved, true, strict=True)
    ]
    degrees = [a.angle_to_deg(b) for a, b in zip(moved, true, strict=True)]
    apart = max(float(np.linalg.norm(a.center - b.center)) for a in true for b in true)
    return {
        "median_mm": float(np.median(millimetres)),
        "largest_mm": max(millimetres),
        "median_deg": float(np.median(degrees)),
        "largest_deg": max(degrees),
        "set_m": apart,
    }


def best_similarity(source: FloatArray, target: FloatArray) -> Sim3:
    """The similarity that takes points (n, 3) onto others with the least squares left."""
    found = pycolmap.estimate_sim3d(source, target)
    if found is None:
        raise SystemExit("the cameras of the map lie on a line or a point; no similarity can be told")
    return Sim3(
        scale=float(found.scale),
        rotation=np.array(found.rotation.matrix()),
        translation=np.array(found.translation),
    )


def with_exif(photos: Path, names: Sequence[str], focal_rel: float, folder: Path) -> Path:
    """Copies of JPEG files with EXIF of one camera.

    Args:
        focal_rel: focal length as a share of the longer side; photos are in 3:2, as film is.
    """
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Strecha", "laser truth"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(36.0 * focal_rel)
    content = exif.tobytes()
    segment = b"\xff\xe1" + (len(content) + 2).to_bytes(2, "big") + content
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        data = (photos / name).read_bytes()
        if data[:2] != b"\xff\xd8":
            raise SystemExit(f"{photos / name}: expected a JPEG file")
        (folder / name).write_bytes(data[:2] + segment + data[2:])
    return folder


def true_lens(path: Path) -> float:
    """Focal length over the longer side, in a file of Strecha's."""
    rows = [[float(word) for word in line.split()] for line in path.read_text(encoding="utf-8").splitlines()]
    return rows[0][0] / max(rows[_SIZE_LINE])


def camera_file(folder: Path, photo: str) -> Path:
    """Its camera: `0000.camera` or `0000.png.camera`."""
    found = [p for p in (folder / f"{Path(photo).stem}.camera", folder / f"{photo}.camera") if p.is_file()]
    if not found:
        raise SystemExit(f"{folder}: no camera of photo {photo}")
    return found[0]


def true_pose(path: Path) -> Rigid3:
    """The pose in a file of Strecha's: cam_from_world."""
    rows = [[float(word) for word in line.split()] for line in path.read_text(encoding="utf-8").splitlines()]
    world_from_cam, center = nearest_rotation(rows[_ROTATION_LINES]), np.array(rows[_CENTER_LINE])
    return Rigid3(rotation=world_from_cam.T, translation=-world_from_cam.T @ center)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--work", type=Path, default=None, help="keep the database there")
    add_json_option(parser)
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
