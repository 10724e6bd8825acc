"""Single strips of photos, placed by positions with the cameras' angles and without: are the bounds true?

Real strips are runs of five or six photos along one line of the folder, with the positions and angles of
their EXIF and XMP; the truth is POSES.json (tools/scan_poses.py, from a scan alone). Simulated ones have
noise of 0.3 to 2 m, as much bias as a plain receiver, and angles as wrong as those of `brighton`: in one
strip of four some yaws are off by 180 degrees, as there. Each strip is placed with angles and without.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from featuredb.features.exif.angles import DEFAULT_SIGMA_TILT_DEG, DEFAULT_SIGMA_YAW_DEG
from featuredb.features.exif.read import read_exif
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera_angles import CameraAngles, cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from tools.figures import median, write_figures
from tools.position_draws import Flight, shares, squares, white
from tools.scan_poses import ScanTruth, scan_parser, scan_truth

_LEAST, _MOST_BEND = 5, 0.1  # photos of a real strip; its width over its length
_EACH_DEG, _COMMON_DEG = np.array([1.3, 1.3, 1.8]), np.array([1.5, 1.5, 2.2])  # camera x and y, up
_FLIPPED = 0.25
_SEED = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraStrip:
    """Cameras along a line, and what they say of where (n, 3) and how they are."""

    flight: Flight
    positions: FloatArray
    angles: tuple[CameraAngles | None, ...]


def main() -> None:
    parser = scan_parser(__doc__)
    parser.add_argument("--draws", type=int, default=200, help="simulated strips")
    args = parser.parse_args()
    with threadpool_limits(1):
        figures = measure("real", list(real_strips(scan_truth(args), args.photos)))
        drawn = [simulated_strip(np.random.default_rng((_SEED, draw))) for draw in range(args.draws)]
        figures |= measure("simulated", drawn)
    write_figures(args.json, figures)


def measure(kind: str, strips: Sequence[CameraStrip]) -> dict[str, float]:
    """How many are placed and answer, and how often their errors lie inside their bounds."""
    figures = {f"{kind}_strips": float(len(strips))}
    for name, angles in (("", True), ("without_", False)):
        scores: list[dict[str, float]] = []
        turns: list[float] = []
        answer = 0
        for number, strip in enumerate(strips):
            found = strip.flight.placed(strip.positions, strip.angles if angles else ())
            if found.reason is not None:
                continue
            answer += not found.provisional
            camera = np.random.default_rng((_SEED, 5, number)).integers(len(strip.flight.xyz))
            scores.append(squares(found, strip.flight.xyz[camera]))
            turns.append(found.figures["turn_sigma_deg"])
        figures |= {
            f"{kind}_{name}placed": len(scores) / len(strips),
            f"{kind}_{name}answer": answer / len(strips),
            f"{kind}_{name}turn_deg": median(turns),
            **shares(f"{kind}_{name}", scores),
        }
    return figures


def real_strips(truth: ScanTruth, photos: Path) -> Iterator[CameraStrip]:
    """Runs of photos, in the order of their names, that lie along a line."""
    frame, by_name = truth.frame, truth.poses
    names = sorted(by_name)
    told = [read_exif((photos / name).read_bytes()) for name in names]
    positions = np.array([frame.enu_from_geodetic([e.latitude_deg, e.longitude_deg, 0.0]) for e in told])
    positions[:, 2] = [exif.altitude_m - frame.height_m for exif in told]
    xyz = np.array([by_name[name].center for name in names])
    seconds = np.array([(exif.capture_time - told[0].capture_time).total_seconds() for exif in told])
    for count in (_LEAST, _LEAST + 1):
        for first in range(len(names) - count + 1):
            rows = slice(first, first + count)
            size = np.linalg.svd(xyz[rows] - xyz[rows].mean(axis=0), compute_uv=False)
            if size[1] > _MOST_BEND * size[0]:
                continue
            flight = Flight(
                xyz=xyz[rows],
                times_s=seconds[rows] - seconds[first],
                cam_from_local=tuple(by_name[name] for name in names[rows]),
            )
            angles = tuple(exif.angles for exif in told[rows])
            yield CameraStrip(flight=flight, positions=positions[rows], angles=angles)


def simulated_strip(rng: np.random.Generator) -> CameraStrip:
    """Six to fifteen photos along 60 to 200 m, all turned alike, from straight down to 50 degrees down."""
    count = int(rng.integers(6, 16))
    heading = rng.uniform(0.0, 2.0 * np.pi)
    along = np.array([np.sin(heading), np.cos(heading), 0.0])
    xyz = np.outer(np.linspace(-0.5, 0.5, count) * rng.uniform(60.0, 200.0), along)
    xyz += rng.normal([0.0, 0.0, 60.0], 0.5, xyz.shape)
    yaw, pitch = rng.uniform(0.0, 360.0), rng.uniform(-90.0, -50.0)
    common = rng.normal(0.0, _COMMON_DEG)
    flipped = rng.random() < _FLIPPED
    poses: list[Rigid3] = []
    angles: list[CameraAngles] = []
    for center in xyz:
        told = CameraAngles(
            yaw_deg=yaw + rng.normal(0.0, 3.0),
            pitch_deg=pitch + rng.normal(0.0, 1.0),
            roll_deg=0.0,
            sigma_yaw_deg=DEFAULT_SIGMA_YAW_DEG,
            sigma_tilt_deg=DEFAULT_SIGMA_TILT_DEG,
        )
        off = np.radians(common + rng.normal(0.0, _EACH_DEG))
        rotation = so3_exp([off[0], off[1], 0.0]) @ cam_from_enu(told.yaw_deg, told.pitch_deg, 0.0)
        poses.append(Rigid3.from_center(rotation @ so3_exp([0.0, 0.0, off[2]]), center))
        if flipped and rng.random() < 0.5:
            told = replace(told, yaw_deg=told.yaw_deg + 180.0)
        angles.append(told)
    flight = Flight(xyz=xyz, times_s=4.0 * np.arange(count, dtype=np.float64), cam_from_local=tuple(poses))
    positions = xyz + white(rng.uniform(0.3, 2.0))(flight, rng)
    return CameraStrip(flight=flight, positions=positions, angles=tuple(angles))


if __name__ == "__main__":
    main()
