"""Rays of marks: where they meet each other, and where they meet the ground that a block shows."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from ingest.register.control.marks import Control

_NEIGHBOURS = 12  # observations around a mark: enough for a plane, few enough to be near
_MAX_DISTANCE_SHARE = 0.1  # of the photo's diagonal; further away the ground may be anything


def ray(block: Block, photo: int, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera centre (3,) and unit direction (3,) of a pixel (2,), in the block's frame."""
    pose = block.cam_from_block[photo]
    direction = pose.rotation.T @ np.append(block.camera(photo).unproject(xy)[0], 1.0)
    return pose.center, direction / np.linalg.norm(direction)


def intersect(
    block: Block, photos: NDArray[np.int64], xy: FloatArray, min_angle_deg: float
) -> FloatArray | None:
    """The place (3,) next to the rays of pixels (m, 2) of m photos; None where they are nearly parallel."""
    rays = [ray(block, int(p), pixel) for p, pixel in zip(photos, xy, strict=True)]
    directions = np.array([d for _, d in rays])
    if not np.isfinite(directions).all():
        return None
    cosine = float((directions @ directions.T).min())
    if cosine > np.cos(np.radians(min_angle_deg)):
        return None
    across = [np.eye(3) - np.outer(d, d) for _, d in rays]
    at_centers = np.sum([a @ center for a, (center, _) in zip(across, rays, strict=True)], axis=0)
    return np.asarray(np.linalg.solve(np.sum(across, axis=0), at_centers))


def shown(block: Block, photos: NDArray[np.int64], xyz: FloatArray) -> FloatArray:
    """Pixels (m, 2) at which m photos show places (m, 3) or one (3,); NaN behind a camera."""
    places = np.broadcast_to(xyz, (len(photos), 3))
    return np.array(
        [
            block.camera(p).project(block.cam_from_block[p].act(place[None]))[0]
            for p, place in zip(photos.tolist(), places, strict=True)
        ]
    ).reshape(-1, 2)


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
