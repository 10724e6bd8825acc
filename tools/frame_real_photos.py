"""Real photos registered to a real scan, one by one, from their EXIF alone and from priors that are wrong.

Two registrations of each photo:

- `exif`: position and pitch from EXIF and XMP, heading unknown (drones turn the gimbal's by 180 degrees);
- `wrong`: the pose found so, made wrong by 15 m and 10 degrees in random directions.

Both have to end at one pose: figures are how far apart they are, in metres and degrees.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.features.exif.read import read_exif
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.simworld.camera.photograph import look_pose
from ingest.register.frame.register import register_frame
from ingest.register.frame.views import FrameOptions
from ingest.register.frame_registration import FramePrior, FrameRegistration
from tools.commands import cloud_of
from tools.figures import median, off_pose, prior_off_by, say, study_parser, write_figures
from tools.photo_files import photo_names

_OFF_M, _OFF_DEG = 15.0, 10.0


def main() -> None:
    parser = study_parser(__doc__, "scan", "folder")
    parser.add_argument("--lens", required=True, metavar="MODEL:PARAMS", help="COLMAP's model and parameters")
    parser.add_argument("--photos", nargs="+", default=[], metavar="NAME")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        cloud = cloud_of(args.scan, Path(scratch) / "db")
    names = args.photos or photo_names(args.folder)
    apart, seconds = [], []
    for number, name in enumerate(names):
        data = (args.folder / name).read_bytes()
        image = decode_gray(data)
        camera = lens(args.lens, image.shape[1], image.shape[0])
        first, _ = _timed(name, image, camera, exif_prior(data, cloud), cloud)
        if first.cam_from_local is None:
            continue
        wrong = wrong_prior(first.cam_from_local, np.random.default_rng(number))
        second, cpu_s = _timed(name, image, camera, wrong, cloud)
        seconds.append(cpu_s)
        if second.cam_from_local is not None:
            apart.append((second.cam_from_local, first.cam_from_local))
    figures = {
        "photos": len(names),
        "accepted": len(apart),
        "largest_apart_m": max((np.linalg.norm(a.center - b.center) for a, b in apart), default=np.nan),
        "largest_apart_deg": max((a.angle_to_deg(b) for a, b in apart), default=np.nan),
        "cpu_s": median(seconds),
    }
    write_figures(args.json, figures)


def _timed(
    name: str, image: NDArray[np.uint8], camera: Camera, prior: FramePrior, cloud: PointCloud
) -> tuple[FrameRegistration, float]:
    cpu = time.process_time()
    found = register_frame(image, camera, prior, cloud, FrameOptions(threads=2))
    cpu_s = time.process_time() - cpu
    said = "accepted" if found.accepted else f"{found.reason}: {found.message}"
    say(f"{name}: {said}, {len(found.pixels)} inliers, {cpu_s:.1f} s")
    return found, cpu_s


def lens(text: str, width: int, height: int) -> Camera:
    """A camera of a model and its parameters, MODEL:p1,p2,..."""
    model, _, params = text.partition(":")
    return Camera(model=model, width=width, height=height, params=tuple(float(p) for p in params.split(",")))


def exif_prior(data: bytes, cloud: PointCloud) -> FramePrior:
    """Position from GPS, pitch from XMP or straight down, no heading."""
    exif = read_exif(data)
    if exif.latitude_deg is None or exif.longitude_deg is None or exif.altitude_m is None:
        raise SystemExit("a photo without GPS cannot be registered from EXIF alone")
    center = cloud.frame.enu_from_geodetic([exif.latitude_deg, exif.longitude_deg, 0.0])
    center[2] = exif.altitude_m - cloud.frame.height_m
    pitch = -90.0 if exif.angles is None or exif.angles.pitch_deg is None else exif.angles.pitch_deg
    return FramePrior(
        cam_from_local=look_pose(center, 0.0, pitch),
        sigma_horizontal_m=5.0,
        sigma_vertical_m=12.0,  # heights of drones are metres to tens of metres off
        sigma_heading_deg=180.0,
        sigma_tilt_deg=5.0,
    )


def wrong_prior(truth: Rigid3, rng: np.random.Generator) -> FramePrior:
    """15 m and 10 degrees off."""
    return prior_off_by(off_pose(truth, rng, _OFF_M, _OFF_DEG), _OFF_M, _OFF_DEG)


if __name__ == "__main__":
    main()
