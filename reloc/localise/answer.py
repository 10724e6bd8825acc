"""From an accepted pose in the area's frame to an answer on Earth with its uncertainty."""

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import skew
from featuredb.geometry.sim3 import point_jacobian
from featuredb.index.area import Area
from featuredb.maps.error_modes import ErrorModes
from featuredb.maps.feature_map import FeatureMap
from reloc.localise.lens_prior import lens_for, lens_jacobians, lens_of, opencv_by_lens, pixel_jacobians
from reloc.localise.pose import PoseHypothesis, PoseUncertainty
from reloc.localise.result import LocalisedPose, place_on_earth
from reloc.wire.query import InlierPoints, Lineage

_DAMPING = 1e-9


def make_answer(
    area: Area,
    pose: PoseHypothesis,
    uncertainty: PoseUncertainty,
    pixels: FloatArray,
    point_rows: NDArray[np.int64],
    want_inliers: bool,
    told: Camera | None = None,
    lent: PoseUncertainty | None = None,
) -> LocalisedPose:
    """The pose in UTM and as a GeoPose, with covariance and radii.

    Args:
        pixels: (k, 2) of the inliers. point_rows: (k,) rows of the area's points.
        told: the camera that the request gives as exact, whatever the map's errors made of it.
        lent: of a lens that the map has lent: how uncertain pose and lens are together, within what is known
            of it.
    """
    counts = np.bincount(area.map_of(point_rows), minlength=len(area.maps))
    order = [int(i) for i in np.argsort(-counts, kind="stable") if counts[i] > 0]
    main = area.maps[order[0]]
    center = pose.cam_from_local.center
    modes = area.modes_of(order[0])
    shape = None if modes is None else shape_covariance(area, order[0], pose, point_rows, modes)
    joint = on_earth(area, main, center, uncertainty.joint, point_rows, shape)
    covariance = joint[:6, :6]
    # Where the map's joint errors are not known, those of its images are not added: they move the points of
    # the map, too, and a pixel goes on showing what it shows.
    seen = (
        joint
        if shape is not None
        else on_earth(area, main, center, (lent or uncertainty).joint, point_rows, np.zeros((6, 6)))
    )
    return LocalisedPose(
        frame=area.frame,
        cam_from_local=pose.cam_from_local,
        covariance=covariance,
        view_covariance=None if told else _of_params(pose.camera, seen),
        camera=told or pose.camera,
        camera_source=pose.camera_source,
        **place_on_earth(area.frame, pose.cam_from_local, main.epsg),
        height_datum=main.height_datum,
        map_ids=tuple(area.maps[i].map_id for i in order),
        lineage=tuple(_lineage(area.maps[i]) for i in order),
        residual_rms_px=uncertainty.residual_rms_px,
        inliers=_inliers(area, order, pixels, point_rows) if want_inliers else None,
    )


def _of_params(camera: Camera, joint: FloatArray) -> FloatArray | None:
    """Covariance (6 + n, 6 + n) of the pose and the camera's n parameters.

    None where the lens is exact, or what is known of it is in other parameters than those of its model.
    """
    if len(joint) != 6 + len(camera.params):
        return None
    by_lens = np.eye(len(joint))
    if camera.model == "OPENCV":
        by_lens[6:, 6:] = opencv_by_lens(lens_of(camera))
    return np.asarray(by_lens @ joint @ by_lens.T, dtype=np.float64)


def placement_covariance(area: Area, feature_map: FeatureMap, center: FloatArray) -> FloatArray:
    """What the map's placement adds to the covariance (6, 6) of a pose, in the area's axes.

    Args:
        center: (3,) camera centre in the area's frame.
    """
    area_from_map = area.frame.enu_from(feature_map.frame)
    by_placement = np.zeros((6, 7))
    by_placement[:3, 1:4] = np.eye(3)
    by_placement[3:, :] = point_jacobian(area_from_map.inverse().act(center))
    turn = np.kron(np.eye(2), area_from_map.rotation)
    placed = turn @ by_placement @ feature_map.placement.covariance @ by_placement.T @ turn.T
    return np.asarray(placed, dtype=np.float64)


def map_covariance(area: Area, center: FloatArray, rows: NDArray[np.int64]) -> FloatArray:
    """What the map's adjustment adds to the covariance (6, 6) of a pose, in the area's axes.

    The pose of the map's image that shares most points stands for the shape of the map there: what moved it
    moves whoever is localised by those points.

    Args:
        center: (3,) camera centre in the area's frame. rows: of the area's points that gave the pose.
    """
    images, _ = area.images_that_see(np.unique(rows))
    best = int(np.argmax(np.bincount(images, minlength=1)))
    image = area.image(best)
    if image.covariance is None:
        return np.zeros((6, 6))
    turn = area.points.turns[area.image_map[best]] @ image.cam_from_local.rotation.T
    arm = np.eye(6)
    arm[3:, :3] = -skew(center - area.image_center[best])
    by_pose = arm @ np.kron(np.eye(2), -turn)
    return np.asarray(by_pose @ image.covariance @ by_pose.T, dtype=np.float64)


def on_earth(
    area: Area,
    main: FeatureMap,
    center: FloatArray,
    measured: FloatArray,
    rows: NDArray[np.int64],
    shape: FloatArray | None = None,
) -> FloatArray:
    """Measured covariance plus those of the map and its placement, true east-north-up at the camera.

    Args:
        center: (3,) camera centre in the area's frame.
        measured: (6 + n, 6 + n) of a pose and n parameters of its lens, in the area's axes.
        rows: of the area's points that gave the pose.
        shape: that of the map, (6, 6) or with the lens; None: by the map's image that shares most points.

    Returns:
        Of the same parameters, those of a lens that only `shape` knows included.
    """
    parts = [
        measured,
        placement_covariance(area, main, center),
        map_covariance(area, center, rows) if shape is None else shape,
    ]
    size = max(len(part) for part in parts)
    total = sum(np.pad(part, (0, size - len(part))) for part in parts)
    to_true = np.eye(size)
    to_true[:6, :6] = np.kron(np.eye(2), area.frame.true_enu_from_enu(center))
    covariance = to_true @ total @ to_true.T
    return np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)


def _lineage(feature_map: FeatureMap) -> Lineage:
    return Lineage(
        map_id=feature_map.map_id,
        method=feature_map.placement.method,
        generation=int(feature_map.generation),
        parents=tuple(feature_map.parents),
    )


def _inliers(area: Area, order: list[int], pixels: FloatArray, point_rows: NDArray[np.int64]) -> InlierPoints:
    place = np.full(len(area.maps), -1, dtype=np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    utm = np.empty((len(point_rows), 3))
    for i in order:
        mine = area.map_of(point_rows) == i
        utm[mine] = area.frame.utm_from_enu(area.points[point_rows[mine]], area.maps[i].epsg)
    return InlierPoints(
        pixels=tuple(map(tuple, np.round(pixels, 2).tolist())),
        utm=tuple(map(tuple, np.round(utm, 4).tolist())),
        map_rows=tuple(place[area.map_of(point_rows)].tolist()),
    )


def shape_covariance(
    area: Area, main: int, pose: PoseHypothesis, rows: NDArray[np.int64], modes: ErrorModes
) -> FloatArray | None:
    """(6 + n, 6 + n) of pose and lens, as in PoseUncertainty; None where the modes do not cover the images.

    A lens of the map, which it lent, is as wrong as there and moves along: then n = 8.

    Args:
        main: row of the map. rows: (k,) of the area's points that gave the pose.
    """
    mine = rows[area.map_of(rows) == main]
    moved = _moved_points(area, main, mine, modes)
    if moved is None:
        return None
    points, shift = moved
    own = pose.lens_prior
    seen = (pose.camera, pose.cam_from_local, area.points[points])
    by_point, by_own = pixel_jacobians(*seen, lens=own is not None)
    pixels = np.einsum("kij,kjr->kir", by_point, shift)
    lender = _lender(area.maps[main], pose.camera)
    lent = np.zeros((0, shift.shape[2]))
    if lender is not None:
        _, by_lens = pixel_jacobians(*seen, lens=True)
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
    points = np.unique(rows)
    images, of = area.images_that_see(points)
    seen_by, photo_of = np.unique(images, return_inverse=True)
    photos = [area.image(int(image)) for image in seen_by]
    place = {int(image_id): k for k, image_id in enumerate(modes.image_id)}
    cameras = [feature_map.cameras[photo.camera_id] for photo in photos]
    if any(p.image_id not in place or c.model != "OPENCV" for p, c in zip(photos, cameras, strict=True)):
        return None
    to_map = area.frame.enu_from(feature_map.frame).inverse()
    poses = [photo.cam_from_local @ to_map for photo in photos]
    rotation = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)[photo_of]
    shift = np.array([pose.translation for pose in poses]).reshape(-1, 3)[photo_of]
    in_camera = np.einsum("kij,kj->ki", rotation, area.points[points[of]]) + shift
    mode = modes.poses[[place[photo.image_id] for photo in photos]]
    mode[:, 3:] *= area.image_reach[seen_by, None, None]
    by_camera, pixels = np.empty((len(of), 2, 3)), np.empty((len(of), 2, modes.poses.shape[2]))
    for camera_id in {photo.camera_id for photo in photos}:
        own = np.array([photo.camera_id == camera_id for photo in photos])[photo_of]
        camera = feature_map.cameras[camera_id]
        by_camera[own], by_lens = lens_jacobians(camera, in_camera[own])
        pixels[own] = by_lens @ _as_lens_of(camera, modes.lenses[camera_id])
    by_turn_and_shift = np.concatenate([-by_camera @ skew(in_camera), by_camera], axis=2)
    by_point = by_camera @ rotation
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3, pixels.shape[2]))
    for photo in range(len(photos)):  # each sees a point once
        mine = photo_of == photo
        moved = pixels[mine] + by_turn_and_shift[mine] @ mode[photo]
        transposed = by_point[mine].swapaxes(1, 2)
        normal[of[mine]] += transposed @ by_point[mine]
        right[of[mine]] -= transposed @ moved
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return points, np.linalg.solve(normal + _DAMPING * trace * np.eye(3), right)


def _lender(feature_map: FeatureMap, camera: Camera) -> int | None:
    """The map's camera that this is, of pictures of any size; None if it is none."""
    for camera_id, own in enumerate(feature_map.cameras):
        if own.model == "OPENCV" and lens_for(own, camera.width, camera.height) == camera:
            return camera_id
    return None


def _as_lens_of(camera: Camera, modes: FloatArray, zoom: float = 1.0) -> FloatArray:
    """(8, r) of OPENCV's parameters, in the order of `lens_of`, of pictures so much larger."""
    scaled = modes * np.repeat([zoom, 1.0], 4)[:, None]
    return np.asarray(np.linalg.solve(opencv_by_lens(lens_of(camera)), scaled))
