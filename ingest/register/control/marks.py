"""Marks of control points in a block: which of its photos have them, and where their rays lead."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.adjust.terms import Block
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from ingest.colmap.precision import in_cameras, projected
from ingest.register.control.control_file import ControlFile, Mark

_NEIGHBOURS = 12  # observations around a mark: enough for a plane, few enough to be near
_MIN_RAY_ANGLE_DEG = 1.0  # rays closer to parallel than that give no place
_MAX_DISTANCE_SHARE = 0.1  # of the photo's diagonal; further away the ground may be anything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Control:
    """Marks of control points in the photos of a block.

    Attributes:
        names: of the n points that have at least one mark in the block.
        surveyed: (n, 3) east, north, up in metres in the local frame; up is NaN where unknown.
        marks: m marks, as the file has them.
        point_of, photo_of: (m,) index of the point and of the block's photo.
        xy: (m, 2) full-size pixels.
        unused: marks that cannot take part, by reason for people.
        unmarked: names of points without any mark in the block.
    """

    file: ControlFile
    names: tuple[str, ...]
    surveyed: FloatArray
    marks: tuple[Mark, ...]
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    xy: FloatArray
    unused: tuple[tuple[Mark, str], ...]
    unmarked: tuple[str, ...]

    def marks_of(self, point: int) -> NDArray[np.int64]:
        """Rows of the marks of a point."""
        return np.flatnonzero(self.point_of == point)


def meet(file: ControlFile, block: Block, frame: LocalFrame) -> Control:
    """Find the block's photos for the marks; surveyed positions come out in `frame`."""
    by_name = {name.lower(): [row] for row, name in enumerate(block.names)}
    by_file = defaultdict(list)
    for row, name in enumerate(block.names):
        by_file[_file_name(name)].append(row)
    chosen: list[tuple[Mark, int]] = []
    unused: list[tuple[Mark, str]] = []
    for mark in file.marks:
        photos = by_name.get(mark.photo.lower()) or by_file[_file_name(mark.photo)]
        reason = _why_not(mark, block, photos)
        if reason:
            unused.append((mark, reason))
        else:
            chosen.append((mark, photos[0]))
    marked = {mark.point for mark, _ in chosen}
    kept = [i for i, name in enumerate(file.names) if name in marked]
    index = {file.names[i]: row for row, i in enumerate(kept)}
    # A point without height is taken at the frame's own.
    surveyed = np.array(frame.enu_from_geodetic(np.nan_to_num(file.lat_lon_h[kept], nan=frame.height_m)))
    surveyed[np.isnan(file.lat_lon_h[kept, 2]), 2] = np.nan
    return Control(
        file=file,
        names=tuple(index),
        surveyed=surveyed,
        marks=tuple(mark for mark, _ in chosen),
        point_of=np.array([index[mark.point] for mark, _ in chosen], dtype=np.int64),
        photo_of=np.array([photo for _, photo in chosen], dtype=np.int64),
        xy=np.array([(mark.x, mark.y) for mark, _ in chosen], dtype=np.float64).reshape(-1, 2),
        unused=tuple(unused),
        unmarked=tuple(name for name in file.names if name not in marked),
    )


def _file_name(name: str) -> str:
    return name.rsplit("/", 1)[-1].lower()


def _why_not(mark: Mark, block: Block, photos: list[int]) -> str:
    """Why a mark cannot take part, "" where it can; `photos` of the block are called as the mark says."""
    if not photos:
        return f"no photo {mark.photo} in the map"
    if len(photos) > 1:
        return f"{len(photos)} photos are called {mark.photo}; name it with its folder"
    camera = block.camera(photos[0])
    if mark.x <= camera.width and mark.y <= camera.height:
        return ""
    return (
        f"pixel {mark.x:g} {mark.y:g} is outside {mark.photo} of {camera.width}x{camera.height}; marks must "
        "be made on the photos as they are stored, not on larger or turned copies"
    )


def ray(block: Block, photo: int, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera centre (3,) and unit direction (3,) of a pixel (2,), in the block's frame."""
    pose = block.cam_from_block[photo]
    direction = pose.rotation.T @ np.append(block.camera(photo).unproject(xy)[0], 1.0)
    return pose.center, direction / np.linalg.norm(direction)


def intersect(block: Block, control: Control, rows: NDArray[np.int64]) -> FloatArray | None:
    """The place (3,) next to the rays of some marks; None where they are nearly parallel."""
    rays = [ray(block, int(control.photo_of[row]), control.xy[row]) for row in rows]
    directions = np.array([d for _, d in rays])
    if not np.isfinite(directions).all():
        return None
    cosine = float((directions @ directions.T).min())
    if cosine > np.cos(np.radians(_MIN_RAY_ANGLE_DEG)):
        return None
    across = [np.eye(3) - np.outer(d, d) for _, d in rays]
    at_centers = np.sum([a @ center for a, (center, _) in zip(across, rays, strict=True)], axis=0)
    return np.asarray(np.linalg.solve(np.sum(across, axis=0), at_centers))


def shown(block: Block, photos: NDArray[np.int64], xyz: FloatArray) -> FloatArray:
    """Pixels (m, 2) at which m photos show places (m, 3) or one (3,); NaN behind a camera."""
    places = np.broadcast_to(xyz, (len(photos), 3))
    in_camera = in_cameras(block.cam_from_block, places, np.arange(len(photos)), photos)
    return projected(block.cameras, block.camera_of[photos], in_camera)


def mark_residuals(block: Block, control: Control, xyz: FloatArray) -> FloatArray:
    """(m, 2) marks minus where the block shows their points (n, 3); NaN where it does not."""
    return control.xy - shown(block, control.photo_of, xyz[control.point_of])


def on_ground(block: Block, photo: int, xy: FloatArray) -> FloatArray | None:
    """Where the ray of a pixel (2,) meets the plane of the block's points that the photo shows around it.

    None where the photo shows none near.
    """
    rows = np.flatnonzero(block.photo_of == photo)
    if len(rows) < _NEIGHBOURS:
        return None
    camera = block.camera(photo)
    distance, nearest = (np.asarray(v) for v in cKDTree(block.xy[rows]).query(xy, k=_NEIGHBOURS))
    if distance[_NEIGHBOURS // 2] > _MAX_DISTANCE_SHARE * np.hypot(camera.width, camera.height):
        return None
    points = block.xyz[block.point_of[rows[nearest]]]
    center, direction = ray(block, photo, xy)
    middle = np.median(points, axis=0)
    spread = np.abs(points - middle).max(axis=1)
    points = points[spread <= 3.0 * np.median(spread)]  # without a far point behind an edge
    normal = np.linalg.svd(points - points.mean(axis=0))[2][-1]
    slope = float(normal @ direction)
    if abs(slope) < 0.2:  # the ray grazes the plane, or the plane is ill-defined: take the middle's depth
        return np.asarray(center + direction * float((middle - center) @ direction))
    return np.asarray(center + direction * (float(normal @ (points.mean(axis=0) - center)) / slope))
