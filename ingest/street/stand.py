"""Where a person could stand and take a photo, by a scan's ground."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError, RegistrationError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import GROUND, PointCloud

_CELL_M = 1.0  # finer cells of a scan with some points per square metre are empty


@dataclass(frozen=True, slots=True, kw_only=True)
class StandOptions:
    """Where and how views are taken.

    Attributes:
        step_m: distance of neighbouring places. SIFT bridges 30 degrees or so: at 12 m from a front a step
            of 12 m is 45 degrees between neighbours, half of that from the middle between them.
        headings: views around each place; 75 degrees wide, six overlap by a fifth.
        eye_m: above the ground. pitch_deg: of the views; people hold a camera a little upward.
        free_m: nothing stands within so much of a place ...
        low_m, high_m: ... between these heights above the ground: kerbs are stepped over, crowns are above.
    """

    step_m: float = 12.0
    headings: int = 6
    eye_m: float = 1.6
    pitch_deg: float = 8.0
    free_m: float = 1.0
    low_m: float = 0.5
    high_m: float = 2.2

    def __post_init__(self) -> None:
        if not (self.step_m >= _CELL_M and self.headings >= 1 and 0 <= self.low_m < self.high_m):
            raise InvalidValueError(f"StandOptions: value out of range in {self}")


def standing_places(
    cloud: PointCloud, low: FloatArray, high: FloatArray, options: StandOptions | None = None
) -> FloatArray:
    """Eye positions (n, 3) on free ground in a box, local frame of the cloud.

    Args:
        low, high: (2,) corners of the box, east and north, metres.

    Raises:
        RegistrationError: no point of the scan in the box is classified as ground.
    """
    options = options or StandOptions()
    ground, blocked = _ground_and_obstacles(cloud, low, high, options)
    reach = max(1, int(np.ceil(options.free_m / _CELL_M)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    free = (cv2.dilate(blocked.astype(np.uint8), disc) == 0) & np.isfinite(ground)
    rows, columns = np.nonzero(free)
    if not len(rows):
        return np.empty((0, 3))
    # Of each square of the step's size the free cell nearest to its middle.
    per = options.step_m / _CELL_M
    square = np.stack([rows // per, columns // per], axis=1).astype(np.int64)
    off = np.hypot(rows - (square[:, 0] + 0.5) * per, columns - (square[:, 1] + 0.5) * per)
    order = np.argsort(off, kind="stable")
    _, first = np.unique(square[order], axis=0, return_index=True)
    chosen = order[first]
    east = low[0] + (columns[chosen] + 0.5) * _CELL_M
    north = low[1] + (rows[chosen] + 0.5) * _CELL_M
    return np.column_stack([east, north, ground[rows[chosen], columns[chosen]] + options.eye_m])


def views_around(place: FloatArray, options: StandOptions | None = None) -> list[Rigid3]:
    """Poses cam_from_local of the views from one place (3,), the first to the north."""
    options = options or StandOptions()
    pitch = np.radians(options.pitch_deg)
    poses = []
    for heading in 2.0 * np.pi * np.arange(options.headings) / options.headings:
        s, c = np.sin(heading), np.cos(heading)
        forward = np.array([s * np.cos(pitch), c * np.cos(pitch), np.sin(pitch)])
        right = np.array([c, -s, 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append(Rigid3(rotation=rotation, translation=-rotation @ place))
    return poses


def _ground_and_obstacles(
    cloud: PointCloud, low: FloatArray, high: FloatArray, options: StandOptions
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Height of the ground (NaN where unknown) and what is built over, by cells; rows go north."""
    xyz = cloud.xyz
    inside = ((xyz[:, :2] >= low) & (xyz[:, :2] < high)).all(axis=1)
    points, is_ground = xyz[inside].astype(np.float64), cloud.classification[inside] == GROUND
    if not is_ground.any():
        raise RegistrationError(
            "street views: expected ground (class 2) among the scan's points, found none; classify the scan, "
            "as `pdal ground` does, and add it again"
        )
    shape = tuple(np.maximum(np.ceil((high - low) / _CELL_M).astype(int), 1)[::-1])
    cell = np.floor((points[:, :2] - low) / _CELL_M).astype(np.int64)
    at = cell[:, 1] * shape[1] + cell[:, 0]
    size = shape[0] * shape[1]
    total = np.bincount(at[is_ground], weights=points[is_ground, 2], minlength=size)
    count = np.bincount(at[is_ground], minlength=size)
    with np.errstate(invalid="ignore"):
        ground = np.where(count > 0, total / count, np.nan)
    above = points[:, 2] - ground[at]
    # Where there is no ground a roof or a crown may have hidden it: nobody is put there.
    standing = ~is_ground & (above > options.low_m) & (above < options.high_m)
    blocked = np.bincount(at[standing], minlength=size) > 0
    return ground.reshape(shape), blocked.reshape(shape) | (count.reshape(shape) == 0)
