"""Poses of photos registered directly to a coloured scan: the truth by which an anchored map is judged.

    python -m tools.scan_poses SCAN.laz PHOTO_FOLDER --poses poses.json

Registers every photo of the folder (tools/scan_to_photo.py, which shares no code with the map, with
anchoring or with localisation), estimates one lens over the photos of each camera, which EXIF tells apart
as in a map (`ExifInfo.camera_key`), and measures its own accuracy: how far poses with the lenses of two
disjoint halves of the photos differ, which shows how far focal length, principal point and height trade.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.exif.read import read_exif
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from tools.figures import say, study_parser
from tools.photo_files import photo_names
from tools.scan_to_photo import (
    Lens,
    PosedPicture,
    adjust,
    correspond,
    first_pose,
    nadir_raster,
    read_scan,
)

_ROUNDS = ((0, 3), (0, 1, 2, 3, 4), tuple(range(7)))  # lens parameters that are free, coarse to fine


def main() -> None:
    parser = study_parser(__doc__, "scan", "folder")
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE", help="write there")
    args = parser.parse_args()
    write_poses(args.scan, args.folder, args.poses)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanTruth:
    """Cameras and poses `cam_from_local` of photos by name, in a local frame; epsg: of the scan."""

    frame: LocalFrame
    epsg: int
    cameras: dict[str, Camera]
    poses: dict[str, Rigid3]


def scan_parser(doc: str | None, *shared: str) -> argparse.ArgumentParser:
    """What studies of photos with a scan are told; arguments as those of `study_parser`."""
    parser = study_parser(doc, "--photos", "--scan", *shared)
    parser.add_argument("--poses", type=Path, required=True, metavar="JSON", help="of tools/scan_poses.py")
    return parser


def scan_truth(args: argparse.Namespace) -> ScanTruth:
    """The file of --poses, made unless it is there; `args`: of `scan_parser`."""
    if not args.poses.exists():
        write_poses(args.scan, args.photos, args.poses)
    document = json.loads(args.poses.read_text(encoding="utf-8"))
    epsg = int(document["crs"].removeprefix("EPSG:"))
    cameras: dict[str, Camera] = {}
    poses: dict[str, Rigid3] = {}
    for name, entry in document["poses"].items():
        lens = document["cameras"][entry["camera"]]
        cameras[name] = Camera(**{key: lens[key] for key in ("model", "width", "height", "params")})
        rotation, translation = entry["cam_from_local_rotation"], entry["cam_from_local_translation"]
        poses[name] = Rigid3(rotation=rotation, translation=translation)
    frame = LocalFrame.from_utm(*document["origin"], epsg)
    return ScanTruth(frame=frame, epsg=epsg, cameras=cameras, poses=poses)


def write_poses(scan_path: Path, folder: Path, target: Path) -> None:
    """Write the poses of all photos of a folder that register, with the cameras and the accuracy."""
    cv2.setNumThreads(1)
    scan = read_scan(scan_path)
    raster = nadir_raster(scan)
    features = cv2.SIFT_create(20000).detectAndCompute(raster[0], None)
    of_camera: dict[str, list[PosedPicture]] = {}
    for path in (folder / name for name in photo_names(folder)):
        gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        pose = first_pose(gray, _start(gray), raster, features)
        say(f"{path.name}: {'no pose' if pose is None else 'first pose'}")
        if pose is not None:
            key = read_exif(path.read_bytes()).camera_key
            of_camera.setdefault(key, []).append(PosedPicture(path.name, gray, pose))
    cameras, poses = {}, {}
    for key, photos in of_camera.items():
        lens = _start(photos[0].gray)
        for free in _ROUNDS:
            photos = [correspond(photo, lens, scan) for photo in photos]
            photos, lens = adjust(photos, lens, free)
            say(f"{sum(len(p.world) for p in photos)} correspondences, focal {lens.values[0]:.1f} px")
        cameras[key] = _camera(photos, lens)
        for photo in photos:
            poses[photo.name] = {
                "camera": key,
                "cam_from_local_rotation": cv2.Rodrigues(photo.pose[:3])[0].tolist(),
                "cam_from_local_translation": photo.pose[3:].tolist(),
            }
    document = {"crs": scan.crs, "origin": list(scan.origin), "cameras": cameras, "poses": poses}
    target.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _start(gray: NDArray[np.uint8]) -> Lens:
    """Any focal length will do for a start: over nearly flat ground the height takes it up."""
    height, width = gray.shape
    return Lens(width, height, np.array([0.6 * width, width / 2 - 0.5, height / 2 - 0.5, 0, 0, 0, 0]))


def _camera(photos: list[PosedPicture], lens: Lens) -> dict[str, Any]:
    f, cx, cy, *distortion = lens.values.tolist()
    return {
        "model": "OPENCV",
        "width": lens.width,
        "height": lens.height,
        # COLMAP's pixels: centre of the top-left pixel at (0.5, 0.5).
        "params": [f, f, cx + 0.5, cy + 0.5, *distortion],
        "halves_of_photos": halves_of_photos(photos, lens),
    }


def halves_of_photos(photos: list[PosedPicture], lens: Lens) -> dict[str, float]:
    """How far poses with the camera of the even photos are from those with the camera of the odd ones."""
    lenses = [adjust(photos[parity::2], lens, _ROUNDS[-1])[1] for parity in (0, 1)]
    shifts, turns = [], []
    for a, b in zip(*(adjust(photos, half, ())[0] for half in lenses), strict=True):
        ra, rb = cv2.Rodrigues(a.pose[:3])[0], cv2.Rodrigues(b.pose[:3])[0]
        shifts.append(ra.T @ a.pose[3:] - rb.T @ b.pose[3:])
        turns.append(np.degrees(np.linalg.norm(cv2.Rodrigues(ra @ rb.T)[0])))
    return {
        **dict(zip(("east_m", "north_m", "up_m"), np.median(np.abs(shifts), axis=0).tolist(), strict=True)),
        "position_m": float(np.median(np.linalg.norm(shifts, axis=1))),
        "rotation_deg": float(np.median(turns)),
        "focal_px": abs(lenses[0].values[0] - lenses[1].values[0]),
    }


if __name__ == "__main__":
    main()
