"""Bundle adjustment of a model with some of its points and lenses held fixed.

Like ingest.colmap_bridge and ingest.colmap_adjust this module knows pycolmap's reconstructions.
"""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap_bridge import Model, SfmPhoto, TwoView, quiet, read_model, write_database
from ingest.focal_prior import FocalPriorOptions, add_focal_priors, fix_gauge
from ingest.precision import shared_variance_px2


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchoredOptions:
    """The adjustment.

    Attributes:
        loss_scale_px: of the Cauchy loss, at `error_reference_side_px`: a SIFT keypoint is good to about
            half a pixel of the image that it was found on.
        max_error_px: observations further off are dropped between rounds, at the same size; what
            reconstruction itself allows.
        error_reference_side_px: keypoints are located on images of about this size.
        rounds: of adjusting and dropping.
        focal_prior: how much the focal lengths of EXIF count.
        max_iterations: of Ceres, each round.
        threads: one gives the same numbers in every run.
    """

    loss_scale_px: float = 0.5
    max_error_px: float = 4.0
    error_reference_side_px: int = 1600
    rounds: int = 2
    focal_prior: FocalPriorOptions = field(default_factory=FocalPriorOptions)
    max_iterations: int = 60
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FixedPoints:
    """Points that stay where they are and the pixels in which a model's photos see them.

    Attributes:
        xyz: (q, 3) in the model's frame.
        point_of, photo_of: (m,) rows of xyz and of the model's photos.
        pixels: (m, 2).
    """

    xyz: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    pixels: FloatArray

    @classmethod
    def none(cls) -> "FixedPoints":
        """No points."""
        rows = np.zeros(0, dtype=np.int64)
        return cls(xyz=np.zeros((0, 3)), point_of=rows, photo_of=rows, pixels=np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anchored:
    """An adjusted model.

    Attributes:
        model: poses, lenses and free points; observations that fit, points with at least two of them.
        fixed_kept: (m,) observations of fixed points that fit.
        old_point: (n,) row of the given model's points that each point was.
    """

    model: Model
    fixed_kept: NDArray[np.bool_]
    old_point: NDArray[np.int64]


def adjust_anchored(
    model: Model,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    constant_cameras: Sequence[int],
    options: AnchoredOptions,
    focal_px: Mapping[int, float] | None = None,
    *,
    free_centers: bool = False,
    constant_photos: Sequence[int] = (),
    constant_points: Sequence[int] = (),
) -> Anchored:
    """Adjust poses, free points and lenses (focal lengths and distortion) but those of `constant_cameras`.

    Without fixed points and constant photos the gauge is that of the first two photos' poses.

    Args:
        keypoints: pixels (n, 2) of each photo of the model, in the order of its rows.
        focal_px: focal lengths of EXIF by camera, where there is one.
        free_centers: adjust the principal points of these lenses, too.
        constant_photos: rows of the model's photos whose poses stay. constant_points: of its points.
    """
    observation = _in_tracks(model, np.ones(len(model.point_of), dtype=np.bool_))
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    state = model
    for _ in range(options.rounds):
        with quiet():
            state = _adjusted(
                state,
                observation,
                keypoints,
                fixed,
                kept,
                constant_cameras,
                focal_px or {},
                free_centers,
                constant_photos,
                constant_points,
                options,
            )
        observation, kept = _fitting(state, keypoints, fixed, options)
        observation &= _in_tracks(state, observation)
    return Anchored(
        model=with_observations(state, observation),
        fixed_kept=kept,
        old_point=np.unique(state.point_of[observation]),
    )


def _adjusted(
    model: Model,
    observation: NDArray[np.bool_],
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
    constant_cameras: Sequence[int],
    focal_px: Mapping[int, float],
    free_centers: bool,
    constant_photos: Sequence[int],
    constant_points: Sequence[int],
    options: AnchoredOptions,
) -> Model:
    """One round: the model with new poses, lenses and points."""
    reconstruction, free_ids, fixed_ids = _reconstruction(model, observation, keypoints, fixed, kept)
    side = max(max(c.width, c.height) for c in model.cameras)
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = False
    settings.refine_principal_point = free_centers
    settings.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    loss_scale_px = options.loss_scale_px * max(1.0, side / options.error_reference_side_px)
    settings.ceres.loss_function_scale = loss_scale_px
    settings.ceres.solver_options.max_num_iterations = options.max_iterations
    settings.ceres.solver_options.function_tolerance = 1e-6
    settings.ceres.solver_options.num_threads = options.threads
    config = pycolmap.BundleAdjustmentConfig()
    for k in range(len(model.rows)):
        config.add_image(k + 1)
    for camera in constant_cameras:
        config.set_constant_cam_intrinsics(camera + 1)
    for photo in constant_photos:
        config.set_constant_rig_from_world_pose(reconstruction.image(photo + 1).frame_id)
    for point_id in (*fixed_ids, *(free_ids[p] for p in constant_points if p in free_ids)):
        config.add_constant_point(point_id)
    free = set(np.unique(model.camera_of).tolist()) - set(constant_cameras)
    focals = {c + 1: focal for c, focal in options.focal_prior.of(focal_px, free).items()}
    if not fixed_ids and not constant_photos:
        fix_gauge(reconstruction, config, 1, focals)
    if focals:
        variance = _shared_variance_px2(model, observation, keypoints)
        add_focal_priors(reconstruction, config, focals, variance, loss_scale_px, options.focal_prior)
    pycolmap.create_default_bundle_adjuster(settings, config, reconstruction).solve()
    xyz = model.xyz.copy()
    for point, point_id in free_ids.items():
        xyz[point] = reconstruction.point3D(point_id).xyz
    poses = [reconstruction.image(k + 1).cam_from_world().matrix() for k in range(len(model.rows))]
    return replace(
        model,
        cameras=tuple(Camera.from_pycolmap(reconstruction.camera(c + 1)) for c in range(len(model.cameras))),
        cam_from_sfm=tuple(Rigid3.from_matrix(np.asarray(pose)) for pose in poses),
        xyz=xyz,
    )


def _shared_variance_px2(
    model: Model, observation: NDArray[np.bool_], keypoints: Sequence[FloatArray]
) -> float:
    """Of the residuals of the free points, see `shared_variance_px2`."""
    rows = np.flatnonzero(observation)
    residuals, pixels = np.zeros((len(rows), 2)), np.zeros((len(rows), 2))
    for k, pose in enumerate(model.cam_from_sfm):
        mine = model.photo_of[rows] == k
        pixels[mine] = keypoints[k][model.keypoint_of[rows[mine]]]
        seen = pose.act(model.xyz[model.point_of[rows[mine]]])
        residuals[mine] = model.cameras[int(model.camera_of[k])].project(seen) - pixels[mine]
    good = np.isfinite(residuals).all(axis=1)
    side = max(max(c.width, c.height) for c in model.cameras)
    return shared_variance_px2(residuals[good], pixels[good], model.photo_of[rows[good]], side)


def _reconstruction(
    model: Model,
    observation: NDArray[np.bool_],
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
) -> tuple[Any, dict[int, int], list[int]]:
    """pycolmap's reconstruction, ids of the free points by row, ids of the fixed points.

    Pixels of fixed points are keypoints of their own, behind the photo's: a feature may be held by points
    of two maps.
    """
    reconstruction = pycolmap.Reconstruction()
    for c, camera in enumerate(model.cameras):
        reconstruction.add_camera_with_trivial_rig(camera.to_pycolmap(c + 1))
    place = np.zeros(len(fixed.point_of), dtype=np.int64)
    for k, pose in enumerate(model.cam_from_sfm):
        rows = np.flatnonzero((fixed.photo_of == k) & kept)
        place[rows] = len(keypoints[k]) + np.arange(len(rows))
        image = pycolmap.Image(
            name=str(k),
            keypoints=np.concatenate([keypoints[k], fixed.pixels[rows]]).astype(np.float64),
            camera_id=int(model.camera_of[k]) + 1,
            image_id=k + 1,
        )
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
    free = np.flatnonzero(observation)
    free_ids = _add_points(
        reconstruction, model.xyz, model.point_of[free], model.photo_of[free], model.keypoint_of[free]
    )
    held = np.flatnonzero(kept)
    fixed_ids = _add_points(
        reconstruction, fixed.xyz, fixed.point_of[held], fixed.photo_of[held], place[held]
    )
    _add_onlooker(reconstruction, list(fixed_ids.values()), len(model.cameras) + 1, len(model.rows) + 1)
    return reconstruction, free_ids, list(fixed_ids.values())


def _add_onlooker(reconstruction: Any, point_ids: list[int], camera_id: int, image_id: int) -> None:
    """An image outside the problem that sees the points of one photo: COLMAP wants two views of each.

    Point, pose and lens of these residuals are constant, so they change nothing.
    """
    single = [p for p in point_ids if reconstruction.point3D(p).track.length() == 1]
    if not single:
        return
    lens = Camera.from_focal(100, 100, 100.0, "SIMPLE_PINHOLE")
    reconstruction.add_camera_with_trivial_rig(lens.to_pycolmap(camera_id))
    image = pycolmap.Image(
        name="onlooker", keypoints=np.zeros((len(single), 2)), camera_id=camera_id, image_id=image_id
    )
    reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for k, point_id in enumerate(single):
        reconstruction.add_observation(point_id, pycolmap.TrackElement(image_id, k))


def _add_points(
    reconstruction: Any,
    xyz: FloatArray,
    point_of: NDArray[np.int64],
    photo_of: NDArray[np.int64],
    keypoint_of: NDArray[np.int64],
) -> dict[int, int]:
    """Add the points that have observations; their ids by row of xyz."""
    order = np.argsort(point_of, kind="stable")
    ids: dict[int, int] = {}
    starts = np.flatnonzero(np.diff(point_of[order], prepend=-1))
    for rows in np.split(order, starts[1:]) if len(order) else []:
        track = pycolmap.Track()
        for o in rows:
            track.add_element(int(photo_of[o]) + 1, int(keypoint_of[o]))
        point = int(point_of[rows[0]])
        ids[point] = reconstruction.add_point3D(xyz[point], track)
    return ids


def _fitting(
    model: Model, keypoints: Sequence[FloatArray], fixed: FixedPoints, options: AnchoredOptions
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which observations of free and of fixed points lie within the tolerance."""
    free = np.zeros(len(model.point_of), dtype=np.bool_)
    held = np.zeros(len(fixed.point_of), dtype=np.bool_)
    for k, pose in enumerate(model.cam_from_sfm):
        camera = model.cameras[int(model.camera_of[k])]
        limit = options.max_error_px * max(
            1.0, max(camera.width, camera.height) / options.error_reference_side_px
        )
        mine = np.flatnonzero(model.photo_of == k)
        pixels = camera.project(pose.act(model.xyz[model.point_of[mine]]))
        free[mine] = np.linalg.norm(pixels - keypoints[k][model.keypoint_of[mine]], axis=1) < limit
        mine = np.flatnonzero(fixed.photo_of == k)
        pixels = camera.project(pose.act(fixed.xyz[fixed.point_of[mine]]))
        held[mine] = np.linalg.norm(pixels - fixed.pixels[mine], axis=1) < limit
    return free, held


def _in_tracks(model: Model, observation: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Observations of points that at least two of them hold."""
    counts = np.bincount(model.point_of[observation], minlength=len(model.xyz))
    return np.asarray(counts[model.point_of] >= 2)


def with_observations(model: Model, observation: NDArray[np.bool_]) -> Model:
    """The model with the chosen observations (m,) and the points that they see."""
    points, point_of = np.unique(model.point_of[observation], return_inverse=True)
    return replace(
        model,
        xyz=model.xyz[points],
        point_of=point_of.reshape(-1),
        photo_of=model.photo_of[observation],
        keypoint_of=model.keypoint_of[observation],
    )


def triangulate_posed(
    cameras: Sequence[Camera],
    photos: Sequence[SfmPhoto],
    poses: Sequence[Rigid3],
    geometries: Mapping[tuple[int, int], TwoView],
) -> Model:
    """Points from the verified matches of photos whose poses and lenses are known, and stay as they are.

    Args:
        photos: their camera_row names the camera. poses: cam_from_sfm of each.
        geometries: of pairs of rows.
    """
    with quiet(), tempfile.TemporaryDirectory(prefix="featuredb-points-") as scratch:
        database = Path(scratch) / "colmap.db"
        write_database(database, [(camera, True) for camera in cameras], photos, geometries)
        reconstruction = pycolmap.Reconstruction()
        for c, camera in enumerate(cameras):
            reconstruction.add_camera_with_trivial_rig(camera.to_pycolmap(c + 1))
        for k, (photo, pose) in enumerate(zip(photos, poses, strict=True)):
            image = pycolmap.Image(name=photo.name, camera_id=photo.camera_row + 1, image_id=k + 1)
            reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
        settings = pycolmap.IncrementalPipelineOptions()
        settings.extract_colors = False
        settings.triangulation.ignore_two_view_tracks = False
        settings.num_threads = 1
        settings.random_seed = 0
        side = max(max(camera.width, camera.height) for camera in cameras)
        error_px = 4.0 * max(1.0, side / AnchoredOptions().error_reference_side_px)
        settings.triangulation.create_max_angle_error = 2.0
        settings.mapper.filter_max_reproj_error = error_px
        settings.triangulation.complete_max_reproj_error = error_px
        settings.triangulation.merge_max_reproj_error = error_px
        settings.ba_refine_focal_length = False
        settings.ba_refine_extra_params = False
        output = Path(scratch) / "points"
        output.mkdir()
        found = pycolmap.triangulate_points(
            reconstruction, str(database), scratch, str(output), clear_points=True, options=settings
        )
        found.write(str(output))
        return read_model(output)
