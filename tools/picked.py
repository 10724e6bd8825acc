"""What a person would pick: points of a scan that a photo shows, at their true pixels plus an error."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from tools.commands import anchor

# A point hides others of its cell that are farther by more than this share of the distance.
_CELL_PX, _HIDDEN_REL = 12.0, 0.01
_MARGIN = 0.05  # of the picture's sides: nobody picks at the rim
_COLUMNS, _ROWS = 3, 2  # parts of the picture, in each of which one pick lies
_SIGMA_PX = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """A scan in memory: `utm` (n, 3) as the file has it, `local` (n, 3) in a local frame."""

    utm: FloatArray
    local: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """An image of a map with its true camera and pose, in the local frame of the scan."""

    image: str
    camera: Camera
    cam_from_local: Rigid3


def read_scan(path: Path, frame: LocalFrame, epsg: int) -> Scan:
    """A LAS or LAZ file whose coordinates are of this UTM zone, metres."""
    file = laspy.read(path)
    utm = np.stack([np.asarray(file.x), np.asarray(file.y), np.asarray(file.z)], axis=1)
    return Scan(utm=utm, local=frame.enu_from_utm(utm, epsg))


def picks(
    scan: Scan, camera: Camera, cam_from_local: Rigid3, rng: np.random.Generator, sigma_px: float
) -> tuple[FloatArray, FloatArray]:
    """Six picks, one in each part of the picture that shows the scan: pixels (n, 2) and UTM (n, 3)."""
    rows, pixels = visible(scan, camera, cam_from_local)
    chosen = [int(rng.choice(part)) for part in _parts(pixels, camera)]
    noisy = pixels[chosen] + sigma_px * rng.standard_normal((len(chosen), 2))
    return noisy, scan.utm[rows[chosen]]


def visible(scan: Scan, camera: Camera, cam_from_local: Rigid3) -> tuple[NDArray[np.int64], FloatArray]:
    """Rows (m,) of the scan that a photo shows, away from its rim, and their pixels (m, 2)."""
    in_camera = cam_from_local.act(scan.local)
    ahead = np.flatnonzero(in_camera[:, 2] > 0.5)
    size = np.array([camera.width, camera.height])
    wide = np.abs(in_camera[ahead, :2]) <= in_camera[ahead, 2:] * size / camera.focal_px
    ahead = ahead[wide.all(axis=1)]  # far outside a lens' polynomials fold back
    pixels = camera.project(in_camera[ahead])
    inside = ((pixels > _MARGIN * size) & (pixels < (1.0 - _MARGIN) * size)).all(axis=1)
    rows, pixels = ahead[inside], pixels[inside]
    depth = in_camera[rows, 2]
    cells = (pixels // _CELL_PX).astype(np.int64)
    key = cells[:, 1] * (camera.width // int(_CELL_PX) + 1) + cells[:, 0]
    nearest = np.full(int(key.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, key, depth)
    seen = depth <= nearest[key] * (1.0 + _HIDDEN_REL)
    return rows[seen], pixels[seen]


def place_by_picks(
    database: Path, map_id: str, photos: Path, seen: Seen, scan: Scan, work: Path, seed: int
) -> bool:
    """Place a map on its scan by six picks in one image; whether it was placed."""
    file = write_picks(work / "picks.csv", scan, seen, np.random.default_rng(seed))
    return anchor(database, map_id, photos, work / "anchor", "--picks", str(file), "--image", seen.image)


def write_picks(path: Path, scan: Scan, seen: Seen, rng: np.random.Generator) -> Path:
    """Six picks with 3 px of error, in the file that `featuredb anchor --picks` reads."""
    lines = ["image,x,y,easting,northing,height"]
    for xy, utm in zip(*picks(scan, seen.camera, seen.cam_from_local, rng, _SIGMA_PX), strict=True):
        words = (*(f"{value:.2f}" for value in xy), *(f"{value:.3f}" for value in utm))
        lines.append(",".join([seen.image, *words]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _parts(pixels: FloatArray, camera: Camera) -> Iterator[NDArray[np.int64]]:
    """Rows of the pixels by parts of the picture; of a part without any, rows of the whole."""
    column = (pixels[:, 0] * _COLUMNS / camera.width).astype(int)
    row = (pixels[:, 1] * _ROWS / camera.height).astype(int)
    for part in range(_COLUMNS * _ROWS):
        inside = np.flatnonzero((column == part % _COLUMNS) & (row == part // _COLUMNS))
        yield inside if len(inside) else np.arange(len(pixels))
