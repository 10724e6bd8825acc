"""A block with exact truth, and control points marked in it, for tests of placement by control points."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from featuredb.adjust.terms import Block
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from ingest.register.control.control_file import ControlFile, parse_control_file
from ingest.register.control.marks import Control, meet
from tests.support.planar_map import view
from tests.support.scenes import CAMERA, EASTING, EPSG, HEIGHT, NORTHING, pixels_inside

FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
LOCAL_FROM_BLOCK = Sim3(
    scale=6.5, rotation=so3_exp([2.6, 0.5, -1.0]), translation=np.array([3.0, -8.0, 40.0])
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurveyedBlock:
    """A block whose true place is known.

    Attributes:
        block: in a frame of its own; local_from_block is the truth.
        control_local: (n, 3) true positions of the control points, local frame.
        marks: pixels by (point, photo), with noise.
    """

    block: Block
    control_local: FloatArray
    marks: Mapping[tuple[int, int], FloatArray]
    local_from_block: Sim3 = LOCAL_FROM_BLOCK

    def control(
        self, surveyed: FloatArray, marks: Mapping[tuple[int, int], FloatArray] | None = None
    ) -> Control:
        """The control of surveyed positions (n, 3), local frame, NaN heights where unknown."""
        return meet(control_file(surveyed, marks or self.marks), self.block, FRAME)


def control_file(surveyed: FloatArray, marks: Mapping[tuple[int, int], FloatArray]) -> ControlFile:
    """The file of surveyed positions, by the parser itself."""
    return parse_control_file(control_text(surveyed, marks), "survey")


def control_text(surveyed: FloatArray, marks: Mapping[tuple[int, int], FloatArray]) -> str:
    """OpenDroneMap's file of surveyed positions (n, 3) in the local frame, and marks."""
    filled = np.where(np.isnan(surveyed), 0.0, surveyed)
    utm = FRAME.utm_from_enu(filled, EPSG)
    heights = np.where(np.isnan(surveyed[:, 2]), np.nan, utm[:, 2])
    lines = [
        f"{utm[point, 0]:.5f} {utm[point, 1]:.5f} {heights[point]:.5f} {x:.4f} {y:.4f} {photo}.jpg p{point}"
        for (point, photo), (x, y) in sorted(marks.items())
    ]
    return "\n".join([f"EPSG:{EPSG}", *lines]) + "\n"


def moved_mark(
    marks: Mapping[tuple[int, int], FloatArray], key: tuple[int, int], shift_px: tuple[float, float]
) -> dict[tuple[int, int], FloatArray]:
    """The marks with one of them elsewhere."""
    return {**marks, key: marks[key] + np.array(shift_px)}


def surveyed_block(
    seed: int = 0, *, points: int = 8, marks_of_point: int = 4, noise_px: float = 0.3, relief_m: float = 4.0
) -> SurveyedBlock:
    """Nine photos from 40 to 50 m over hilly ground of some 60 m, and control points on it."""
    rng = np.random.default_rng(seed)
    poses = [
        view(e, n, 45.0 + rng.uniform(-5, 5), rng.uniform(0, 15), rng.uniform(0, 360))
        for e in (-16, 0, 16)
        for n in (-12, 0, 12)
    ]
    ground = rng.uniform([-32, -26, 0], [32, 26, 0], (500, 3))
    ground[:, 2] = relief_m * np.sin(ground[:, 0] / 9.0) * np.cos(ground[:, 1] / 7.0)
    place, photo, xy = [], [], []
    for k, pose in enumerate(poses):
        pixels, inside = pixels_inside(CAMERA, pose, ground)
        rows = np.flatnonzero(inside)
        place.append(rows)
        photo.append(np.full(len(rows), k))
        xy.append(pixels[rows] + rng.normal(0, noise_px, (len(rows), 2)))
    block = Block(
        names=tuple(f"{k}.jpg" for k in range(len(poses))),
        cameras=(CAMERA,),
        camera_of=np.zeros(len(poses), dtype=np.int64),
        cam_from_block=tuple(poses),
        xyz=ground,
        point_of=np.concatenate(place),
        photo_of=np.concatenate(photo),
        xy=np.concatenate(xy),
    )
    seen = np.bincount(block.point_of, minlength=len(ground))
    block = _with_points(block, seen >= 3)
    control = _spread_points(rng, points, relief_m)
    return SurveyedBlock(
        block=block.moved(LOCAL_FROM_BLOCK.inverse()),
        control_local=control,
        marks=_marks(rng, poses, control, marks_of_point, noise_px),
    )


def _spread_points(rng: np.random.Generator, count: int, relief_m: float) -> FloatArray:
    turn = np.arange(count) * (2 * np.pi / count) + 0.3
    radius = np.where(np.arange(count) % 2, 18.0, 9.0)
    places = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(count)])
    places[:, :2] += rng.uniform(-1, 1, (count, 2))
    places[:, 2] = relief_m * np.sin(places[:, 0] / 9.0) * np.cos(places[:, 1] / 7.0)
    return places


def _marks(
    rng: np.random.Generator, poses: list[Rigid3], control: FloatArray, most: int, noise_px: float
) -> dict[tuple[int, int], FloatArray]:
    marks = {}
    for point, place in enumerate(control):
        showing = [k for k, pose in enumerate(poses) if pixels_inside(CAMERA, pose, place[None])[1][0]]
        for photo in showing[:most]:
            pixel = pixels_inside(CAMERA, poses[photo], place[None])[0][0]
            marks[point, photo] = pixel + rng.normal(0, noise_px, 2)
    return marks


def _with_points(block: Block, kept: np.ndarray) -> Block:
    rows = kept[block.point_of]
    index = np.cumsum(kept) - 1
    return replace(
        block,
        xyz=block.xyz[kept],
        point_of=index[block.point_of[rows]],
        photo_of=block.photo_of[rows],
        xy=block.xy[rows],
    )
