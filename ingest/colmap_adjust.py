"""Final adjustment of a reconstruction: a fuller lens model where the photos support it, positions as priors.

A lens that the model cannot follow bends the whole reconstruction while the reprojection errors hardly show
it; a lens with more freedom than the photos determine trades it against tilt and height. COLMAP's mapping
runs best with one distortion parameter. Once it has converged, a ladder is climbed as far as the data ask for
(Bayesian information criterion): RADIAL (two radial coefficients), then OPENCV (tangential coefficients, two
focal lengths) with a free principal point. Like ingest.colmap_bridge this module knows pycolmap's
reconstructions.
"""

import copy
import logging
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap_bridge import SfmPhoto, quiet
from ingest.focal_prior import (
    FocalPriorOptions,
    add_focal_priors,
    fix_gauge,
    take_adjusted,
)
from ingest.lens_ladder import (
    MORE_OF_OPENCV,
    MORE_OF_RADIAL,
    as_opencv,
    as_radial,
    aspect_rel,
    center_shift_rel,
    information_gain,
)
from ingest.precision import shared_variance_px2

_LOG = logging.getLogger(__name__)
# COLMAP's own gates of mapping: 4 px at keypoints good to half a pixel, 1.5 degrees, 15 observations.
_MAX_ERROR_OVER_SCALE = 8.0
_MIN_ANGLE_DEG = 1.5
_FOCAL_OVER_SIDE, _MAX_DISTORTION = (0.1, 10.0), 1.0  # COLMAP's own for bogus lenses
_MIN_OBSERVATIONS = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustOptions:
    """The final adjustment.

    Attributes:
        refine_focal: False keeps the focal lengths, and with them the lens model.
        fuller_lens: climb the ladder for SIMPLE_RADIAL cameras with enough photos.
        min_photos_of_camera: below, the lens is not told from the scene's shape.
        radial_evidence: how many times the information criterion's penalty the gain of RADIAL must be.
            Neighbouring residuals are not independent, as the criterion assumes, hence not 1.
        opencv_evidence: the same for OPENCV with a free principal point. Over flat ground these trade
            against the cameras' tilt: the gain was about 8 on `brighton`, where
            they turned cameras by 0.9 degrees between subsets of the photos and fitted a laser scan no
            better than RADIAL, and far more on the simulated drone, whose lens truly is so.
        max_center_shift_rel: an OPENCV lens whose principal point moved further from the middle (a share of
            the longer side) is not a lens that was measured but one that was traded against tilt: those of
            consumer cameras lie within 1 %. Two flight lines of `brighton` moved it by 12 %, at a gain of
            43 times the penalty, and bent the map.
        max_aspect_rel: the same of one whose two focal lengths differ by more: pixels are square. A flight
            straight ahead, begun wrongly, came to 224 and 168 pixels, at a gain of 32 times the penalty.
        use_positions: GPS positions take part, robustly, each with its own sigma.
        focal_prior: how much the focal lengths of EXIF count.
        max_iterations: of Ceres.
        threads: one gives the same numbers in every run.
    """

    refine_focal: bool = True
    fuller_lens: bool = True
    min_photos_of_camera: int = 8
    radial_evidence: float = 5.0
    opencv_evidence: float = 20.0
    max_center_shift_rel: float = 0.03
    max_aspect_rel: float = 0.03
    use_positions: bool = True
    focal_prior: FocalPriorOptions = field(default_factory=FocalPriorOptions)
    max_iterations: int = 60
    threads: int = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """What is known of the photos beforehand.

    Attributes:
        photos: with their positions, as they are in COLMAP's database.
        focal_px: focal lengths of EXIF by camera id.
    """

    photos: tuple[SfmPhoto, ...]
    focal_px: Mapping[int, float] = field(default_factory=dict)


def adjust_models(
    output: Path, database: Path, known: Known, loss_scale_px: float, options: AdjustOptions
) -> None:
    """Adjust every model folder under `output` in place.

    Args:
        database: COLMAP's, from which points are triangulated anew with the better lens.
        known: the focal lengths are used where the adjustment is free to change them.
        loss_scale_px: of the Cauchy loss.
    """
    for folder in sorted(p for p in output.iterdir() if p.is_dir()):
        with quiet():
            reconstruction = pycolmap.Reconstruction(str(folder))
            adjusted = _adjusted(reconstruction, folder, database, known, loss_scale_px, options)
            _drop_bogus_lenses(adjusted)
            adjusted.write(str(folder))


def adjust_posed(
    folder: Path, database: Path, known: Known, loss_scale_px: float, options: AdjustOptions
) -> list[int]:
    """Points for a model folder of poses alone, triangulated from all matches, and everything adjusted.

    Poses that were joined from several models are off at the seams by more pixels than triangulation
    admits: after the first adjustment more matches fit, so there are two. Photos that are left without
    enough points are no longer registered.

    Returns:
        Rows of the registered photos; none, and no files, where poses and matches have nothing to do with
        each other.
    """
    with quiet():
        reconstruction = pycolmap.Reconstruction(str(folder))
        rough = replace(options, fuller_lens=False)
        for step in (rough, options):
            reconstruction = _triangulated_anew(reconstruction, database, folder)
            reconstruction = _adjusted(reconstruction, folder, database, known, loss_scale_px, step)
            _filter(reconstruction, loss_scale_px)
            if reconstruction.num_reg_images() < 2:
                shutil.rmtree(folder)
                return []
        reconstruction.write(str(folder))
    return sorted(image_id - 1 for image_id in reconstruction.reg_image_ids())


def _drop_bogus_lenses(reconstruction: Any) -> None:
    """Photos whose lens is none are no longer registered.

    Photos of nothing common, or of one flat thing, say nothing of a focal length that nobody knows: it runs
    away, to 10^7 pixels in the simulated community.
    """
    manager = pycolmap.ObservationManager(reconstruction)
    for frame_id in manager.filter_frames(*_FOCAL_OVER_SIDE, _MAX_DISTORTION, 0):
        manager.deregister_frame(frame_id)


def _filter(reconstruction: Any, loss_scale_px: float) -> None:
    """Observations that do not fit go, then photos that are left with too few, or without a lens."""
    _drop_bogus_lenses(reconstruction)
    manager = pycolmap.ObservationManager(reconstruction)
    manager.filter_all_points3D(_MAX_ERROR_OVER_SCALE * loss_scale_px, _MIN_ANGLE_DEG)
    for frame_id in sorted(reconstruction.reg_frame_ids()):
        (image_id,) = (data.id for data in reconstruction.frame(frame_id).data_ids)
        if reconstruction.image(image_id).num_points3D < _MIN_OBSERVATIONS:
            manager.deregister_frame(frame_id)


def _adjusted(
    reconstruction: Any,
    folder: Path,
    database: Path,
    known: Known,
    loss_scale_px: float,
    options: AdjustOptions,
) -> Any:
    free = options.fuller_lens and options.refine_focal
    fuller = _cameras_to_free(reconstruction, options) if free else []
    if fuller:
        radial = copy.deepcopy(reconstruction)
        for camera_id in fuller:
            _climb(radial.camera(camera_id), as_radial)
        _bundle(radial, known, loss_scale_px, [], options)
        gain = information_gain(_residuals(reconstruction), _residuals(radial), MORE_OF_RADIAL * len(fuller))
        _LOG.info("%s: RADIAL gains %.1f times the penalty", folder.name, gain)
        if gain >= options.radial_evidence:
            return _with_opencv(radial, fuller, folder, database, known, loss_scale_px, options)
    _bundle(reconstruction, known, loss_scale_px, [], options)
    return reconstruction


def _with_opencv(
    radial: Any,
    fuller: list[int],
    folder: Path,
    database: Path,
    known: Known,
    loss_scale_px: float,
    options: AdjustOptions,
) -> Any:
    """The better of RADIAL and OPENCV, with points triangulated anew."""
    opencv = copy.deepcopy(radial)
    for camera_id in fuller:
        _climb(opencv.camera(camera_id), as_opencv)
    _bundle(opencv, known, loss_scale_px, fuller, options)
    gain = information_gain(_residuals(radial), _residuals(opencv), MORE_OF_OPENCV * len(fuller))
    _LOG.info("%s: OPENCV gains %.1f times the penalty", folder.name, gain)
    lenses = [Camera.from_pycolmap(opencv.camera(camera_id)) for camera_id in fuller]
    measured = (
        gain >= options.opencv_evidence
        and max(center_shift_rel(lens) for lens in lenses) <= options.max_center_shift_rel
        and max(aspect_rel(lens) for lens in lenses) <= options.max_aspect_rel
    )
    chosen, free_center = (opencv, fuller) if measured else (radial, [])
    chosen = _triangulated_anew(chosen, database, folder)
    _bundle(chosen, known, loss_scale_px, free_center, options)
    return chosen


def _cameras_to_free(reconstruction: Any, options: AdjustOptions) -> list[int]:
    """SIMPLE_RADIAL cameras that enough registered photos share."""
    counts = Counter(reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids())
    return sorted(
        camera_id
        for camera_id, count in counts.items()
        if count >= options.min_photos_of_camera
        and reconstruction.camera(camera_id).model.name == "SIMPLE_RADIAL"
    )


def _climb(camera: Any, rung: Callable[[Camera], Camera]) -> None:
    """Turn a camera of a reconstruction into the same lens one rung further up."""
    fuller = rung(Camera.from_pycolmap(camera))
    camera.model = pycolmap.CameraModelId.__members__[fuller.model]
    camera.params = list(fuller.params)


def _bundle(
    reconstruction: Any,
    known: Known,
    loss_scale_px: float,
    free_center: list[int],
    options: AdjustOptions,
) -> None:
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = False
    settings.refine_focal_length = options.refine_focal
    settings.refine_principal_point = bool(free_center)
    settings.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    settings.ceres.loss_function_scale = loss_scale_px
    settings.ceres.solver_options.max_num_iterations = options.max_iterations
    settings.ceres.solver_options.function_tolerance = 1e-6  # relative; what is left is below micrometres
    settings.ceres.solver_options.num_threads = options.threads
    config = pycolmap.BundleAdjustmentConfig()
    image_ids = sorted(reconstruction.reg_image_ids())
    for image_id in image_ids:
        config.add_image(image_id)
    if free_center:
        # The principal point is free for all or none; cameras with few photos stay as they are.
        for camera_id in {reconstruction.image(i).camera_id for i in image_ids} - set(free_center):
            config.set_constant_cam_intrinsics(camera_id)
    priors = _position_priors(reconstruction, image_ids, known.photos) if options.use_positions else []
    free = {reconstruction.image(i).camera_id for i in image_ids} if options.refine_focal else set()
    focals = options.focal_prior.of(known.focal_px, free)
    if len(priors) < 3:
        fix_gauge(reconstruction, config, image_ids[0], focals)
    work = copy.deepcopy(reconstruction)
    if focals:
        variance = _shared_variance_px2(reconstruction)
        add_focal_priors(work, config, focals, variance, loss_scale_px, options.focal_prior)
    if len(priors) >= 3:
        prior_settings = pycolmap.PosePriorBundleAdjustmentOptions()
        prior_settings.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
        prior_settings.alignment_ransac.max_error = 3.0 * max(
            float(np.sqrt(np.trace(np.asarray(p.position_covariance)))) for p in priors
        )
        prior_settings.alignment_ransac.random_seed = 0
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(settings, prior_settings, config, priors, work)
    else:
        adjuster = pycolmap.create_default_bundle_adjuster(settings, config, work)
    adjuster.solve()
    take_adjusted(work, reconstruction)
    reconstruction.update_point_3d_errors()


def _position_priors(reconstruction: Any, image_ids: list[int], photos: tuple[SfmPhoto, ...]) -> list[Any]:
    """Positions of the registered photos that have one; image ids are rows of the photos + 1."""
    return [
        pycolmap.PosePrior(
            pose_prior_id=image_id,
            corr_data_id=reconstruction.image(image_id).data_id,
            position=photos[image_id - 1].prior_position,
            position_covariance=photos[image_id - 1].prior_covariance,
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image_id in image_ids
        if photos[image_id - 1].prior_position is not None
    ]


def _triangulated_anew(reconstruction: Any, database: Path, folder: Path) -> Any:
    """The same poses and lenses with points triangulated from all matches again."""
    stored = pycolmap.Database.open(str(database))
    try:  # COLMAP refuses a database whose cameras are of another model
        for camera_id in sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()}):
            stored.update_camera(reconstruction.camera(camera_id))
    finally:
        stored.close()
    settings = pycolmap.IncrementalPipelineOptions()
    settings.extract_colors = False
    settings.triangulation.ignore_two_view_tracks = False
    settings.num_threads = 1
    settings.random_seed = 0
    return pycolmap.triangulate_points(
        reconstruction, str(database), str(folder), str(folder), clear_points=True, options=settings
    )


def _shared_variance_px2(reconstruction: Any) -> float:
    """Of its residuals, see `shared_variance_px2`."""
    side = max(max(camera.width, camera.height) for camera in reconstruction.cameras.values())
    seen = list(_residuals_by_image(reconstruction))
    if not seen:
        return 0.0
    photos = np.repeat([image_id for image_id, _, _ in seen], [len(pixels) for _, pixels, _ in seen])
    residuals = np.concatenate([r for _, _, r in seen])
    return shared_variance_px2(residuals, np.concatenate([p for _, p, _ in seen]), photos, side)


def _residuals(reconstruction: Any) -> FloatArray:
    """(m, 2) reprojection residuals in pixels, in an order that the structure alone determines."""
    parts = [residuals for _, _, residuals in _residuals_by_image(reconstruction)]
    return np.concatenate(parts) if parts else np.zeros((0, 2))


def _residuals_by_image(reconstruction: Any) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    """Image id, pixels (k, 2) and residuals (k, 2) of every registered image that sees points.

    A point that the camera cannot see (behind it, or beyond what its lens can bend) is a picture off.
    """
    for image_id in sorted(reconstruction.reg_image_ids()):
        image = reconstruction.image(image_id)
        seen = [p for p in image.points2D if p.has_point3D()]
        if not seen:
            continue
        pixels = np.array([p.xy for p in seen])
        points = np.array([reconstruction.point3D(p.point3D_id).xyz for p in seen])
        matrix = np.asarray(image.cam_from_world().matrix())
        camera = reconstruction.camera(image.camera_id)
        in_camera = np.ascontiguousarray(points @ matrix[:, :3].T + matrix[:, 3])
        off = float(max(camera.width, camera.height))
        residuals = np.asarray(camera.img_from_cam(in_camera)) - pixels
        yield image_id, pixels, np.nan_to_num(residuals, nan=off, posinf=off, neginf=-off)
