"""What a map's joint errors add to the covariance of a pose that was found by its points."""

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import skew
from featuredb.index.area import Area
from featuredb.maps.error_modes import ErrorModes
from featuredb.maps.feature_map import FeatureMap
from reloc.localise.jacobians import pixel_jacobians
from reloc.localise.lens_prior import lens_of, opencv_by_lens
from reloc.localise.pose import PoseHypothesis
from reloc.localise.self_calibration import joint_jacobians

_DAMPING = 1e-9


def shape_covariance(
    area: Area, main: int, pose: PoseHypothesis, rows: NDArray[np.int64], modes: ErrorModes
) -> FloatArray | None:
    """(6 + n, 6 + n) of pose and lens, as in PoseUncertainty; None where the modes do not cover the images.

    A lens of the map, which it lent, is as wrong as there and moves along: then n = 8.

    Args:
        main: row of the map. rows: (k,) of the area's points that gave the pose.
    """
    mine = rows[area.point_map[rows] == main]
    moved = _moved_points(area, main, mine, modes)
    if moved is None:
        return None
    points, shift = moved
    own = pose.lens_prior
    jacobians = pixel_jacobians if own is None else joint_jacobians
    by_point, by_own = jacobians(pose.camera, pose.cam_from_local, area.points[points])
    pixels = np.einsum("kij,kjr->kir", by_point, shift)
    lender = _lender(area.maps[main], pose.camera)
    lent = np.zeros((0, shift.shape[2]))
    if lender is not None:
        _, by_lens = joint_jacobians(pose.camera, pose.cam_from_local, area.points[points])
        zoom = pose.camera.width / area.maps[main].cameras[lender].width
        lent = _as_lens_of(pose.camera, modes.lenses[lender], zoom)
        pixels += by_lens[:, :, 6:] @ lent
    normal = np.einsum("kij,kil->jl", by_own, by_own)
    if own is not None:
        normal[6:, 6:] += np.diag(own.information)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    solved = np.linalg.solve(
        normal * scale[:, None] * scale + _DAMPING * np.eye(len(scale)),
        scale[:, None] * np.einsum("kij,kir->jr", by_own, pixels),
    )
    error = scale[:, None] * solved
    if own is None:  # what points and lens are off by, the pose takes up: it errs the other way
        error = np.concatenate([error, -lent])
    return np.asarray(error @ error.T)


def _moved_points(
    area: Area, main: int, rows: NDArray[np.int64], modes: ErrorModes
) -> tuple[NDArray[np.int64], FloatArray] | None:
    """Points (n,) of the area and their displacements (n, 3, r), as the images that see them move."""
    feature_map = area.maps[main]
    first = int(np.searchsorted(area.image_map, main))
    wanted = np.full(len(area.points), -1, dtype=np.int64)
    points = np.unique(rows)
    wanted[points] = np.arange(len(points))
    seen = wanted[area.see_point] >= 0
    images, of = area.see_image[seen], wanted[area.see_point[seen]]
    place = {int(image_id): k for k, image_id in enumerate(modes.image_id)}
    turn = area.frame.enu_from(feature_map.frame)
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, modes.poses.shape[2]))
    for image in np.unique(images):
        photo = feature_map.images[image - first]
        if photo.image_id not in place:
            return None
        sees = of[images == image]
        camera = feature_map.cameras[photo.camera_id]
        pose = photo.cam_from_local @ turn.inverse()
        if camera.model != "OPENCV":
            return None
        by_point, by_pose = joint_jacobians(camera, pose, area.points[points[sees]])
        in_camera = pose.act(area.points[points[sees]])
        by_camera = by_point @ pose.rotation.T
        left = np.concatenate([-by_camera @ skew(in_camera), by_camera], axis=2)
        mode = modes.poses[place[photo.image_id]].copy()
        mode[3:] *= area.image_reach[image]
        pixels = left @ mode
        pixels += by_pose[:, :, 6:] @ _as_lens_of(camera, modes.lenses[photo.camera_id])
        normal[sees] += np.swapaxes(by_point, 1, 2) @ by_point
        right[sees] -= np.swapaxes(by_point, 1, 2) @ pixels
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return points, np.linalg.solve(normal + _DAMPING * trace * np.eye(3), right)


def _lender(feature_map: FeatureMap, camera: Camera) -> int | None:
    """The map's camera that this is, of pictures of any size; None if it is none."""
    for c, own in enumerate(feature_map.cameras):
        try:
            same = own.model == "OPENCV" and own.scaled_to(camera.width, camera.height) == camera
        except InvalidValueError:  # of another shape
            continue
        if same:
            return c
    return None


def _as_lens_of(camera: Camera, modes: FloatArray, zoom: float = 1.0) -> FloatArray:
    """(8, r) of OPENCV's parameters, in the order of `lens_of`, of pictures so much larger."""
    scaled = modes * np.repeat([zoom, 1.0], 4)[:, None]
    return np.asarray(np.linalg.solve(opencv_by_lens(lens_of(camera)), scaled))
