"""Final adjustment of a reconstruction: the whole lens of every camera, under its priors, with all else.

A lens that the model cannot follow bends the whole reconstruction while the reprojection errors hardly show
it; one with more freedom than the photos determine trades it against tilt and height. Every lens therefore is
adjusted whole, and what is known of lenses beforehand decides as far as photos do not. Like
ingest.colmap.bridge this module knows pycolmap's reconstructions.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from featuredb.adjust.problem import Problem
from featuredb.adjust.shared_noise import shared_variance_px2
from featuredb.adjust.terms import (
    Block,
    CenterPriors,
    LensPrior,
    LensWidths,
    Marks,
    Terms,
    lens_prior,
    whole_lens,
)
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from ingest.colmap.bridge import SfmPhoto, quiet, triangulation_settings, whole_model_of
from ingest.colmap.precision import in_cameras, projected
from ingest.positions.center_priors import center_priors

# COLMAP's own gates of mapping: 4 px at keypoints good to half a pixel, 1.5 degrees, 15 observations.
_MAX_ERROR_OVER_SCALE = 8.0
_MIN_ANGLE_DEG = 1.5
_FOCAL_OVER_SIDE, _MAX_DISTORTION = (0.1, 10.0), 1.0  # COLMAP's own for bogus lenses
_MIN_OBSERVATIONS = 15
_LEAST_PX2 = 1e-6  # of a variance: exact observations
# Of costs, relative. What is left of the last is below micrometres; before it the noise of positions and new
# points are asked of the shape alone.
_ROUGH, _FINE = 1e-4, 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustOptions:
    """The final adjustment.

    Attributes:
        refine_focal: False keeps the lenses.
        whole_lens: False keeps the lens model; the start of a reconstruction that is not settled.
        exif_focal_rel: of a focal length of EXIF. 35 mm equivalents are rounded to whole millimetres (1 % at
            28 mm), nominal focal lengths are met within 1 to 2 %.
        lens: of what is not known of any camera; its focal length is COLMAP's, from the photos.
        dilution: so many observations of the size that residuals have with what neighbours share
            (`featuredb.adjust.shared_noise`) count as one against these priors and positions: a
            lens model's faults are common to whole photos too. On `brighton`, from above, EXIF's focal length
            of 2311 px comes to 2482 with 1, 2319 with 10, 2304 with 50, where its scan says 2303.
        max_iterations: of Ceres; only a net. Six photos of a strip whose mapping gave twice EXIF's focal
            length are 31 % off after 60, and 0.2 % after 200.
        threads: one gives the same numbers in every run.
    """

    refine_focal: bool = True
    whole_lens: bool = True
    exif_focal_rel: float = 0.02
    lens: LensWidths = field(
        default_factory=lambda: LensWidths(
            focal_rel=0.3, aspect_rel=0.001, center_rel=0.01, radial=0.1, tangential=0.003
        )
    )
    dilution: float = 50.0
    max_iterations: int = 500
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
        rough = replace(options, whole_lens=False)
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
    if options.whole_lens and options.refine_focal:
        _bundle(reconstruction, known, loss_scale_px, options, (_ROUGH,))
        reconstruction = _triangulated_anew(reconstruction, database, folder)
    settled = (_ROUGH, _FINE) if options.whole_lens else (_ROUGH,)  # a start is adjusted again
    _bundle(reconstruction, known, loss_scale_px, options, settled)
    return reconstruction


def _bundle(
    reconstruction: Any,
    known: Known,
    loss_scale_px: float,
    options: AdjustOptions,
    tolerances: Sequence[float],
) -> None:
    """Adjust everything.

    Args:
        tolerances: of rounds of noise of positions and adjustment: how far positions are off follows from the
            shape. Without positions the last is all there is.
    """
    _drop_bogus_lenses(reconstruction)
    if reconstruction.num_reg_images() < 2:
        return
    model = whole_model_of(reconstruction)
    image_ids = (model.rows + 1).tolist()
    camera_ids = sorted({reconstruction.image(i).camera_id for i in image_ids})
    point_ids = sorted(reconstruction.point3D_ids())
    block = model.block(model.pixels([known.photos[i - 1].keypoints for i in image_ids]))
    if options.whole_lens and options.refine_focal:
        block = whole_lens(block)
    lenses = [
        lens_prior_of(camera, known.focal_px.get(camera_id), options)
        for camera, camera_id in zip(block.cameras, camera_ids, strict=True)
    ]
    for tolerance in tolerances:
        centers = _center_priors(block, image_ids, known.photos)
        terms = Terms(
            keypoint_px=loss_scale_px,
            dilution=options.dilution * block_variance_px2(block) / loss_scale_px**2,
            lenses=tuple(lenses) if options.refine_focal else (None,) * len(lenses),
            centers=centers,
            held_photos=() if centers is not None else (0,),
        )
        problem = Problem(block, terms, options.threads)
        problem.solve(options.max_iterations, tolerance if centers is not None else tolerances[-1])
        block = problem.block()
        if centers is None:
            break
    for camera_id, lens in zip(camera_ids, block.cameras, strict=True):
        camera = reconstruction.camera(camera_id)
        camera.model = pycolmap.CameraModelId.__members__[lens.model]
        camera.params = list(lens.params)
    for image_id, pose in zip(image_ids, block.cam_from_block, strict=True):
        frame = reconstruction.frame(reconstruction.image(image_id).frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(pose.matrix()[:3])
    for point_id, xyz in zip(point_ids, block.xyz, strict=True):
        reconstruction.point3D(point_id).xyz = xyz
    reconstruction.update_point_3d_errors()


def residuals_of(
    block: Block, marks: Marks | None = None
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Residuals (m, 2) of a block and its marks, with their pixels (m, 2) and photos (m,).

    Points that their camera cannot see are left out: they say nothing.
    """
    xyz, point_of, photo_of, xy = block.xyz, block.point_of, block.photo_of, block.xy
    if marks is not None:
        point_of = np.concatenate([point_of, len(xyz) + np.arange(len(marks.xyz))])
        xyz, photo_of = np.concatenate([xyz, marks.xyz]), np.concatenate([photo_of, marks.photo_of])
        xy = np.concatenate([xy, marks.xy])
    in_camera = in_cameras(block.cam_from_block, xyz, point_of, photo_of)
    residuals = xy - projected(block.cameras, block.camera_of[photo_of], in_camera)
    seen = np.isfinite(residuals).all(axis=1)
    return residuals[seen], xy[seen], photo_of[seen]


def block_variance_px2(block: Block, marks: Marks | None = None) -> float:
    """`shared_variance_px2` of the residuals of a block and its marks."""
    return max(shared_variance_px2(*residuals_of(block, marks), longest_side(block.cameras)), _LEAST_PX2)


def longest_side(cameras: Sequence[Camera]) -> int:
    """Of all pictures, pixels."""
    return max(max(camera.width, camera.height) for camera in cameras)


def lens_prior_of(camera: Camera, exif_px: float | None, options: AdjustOptions) -> LensPrior:
    """Around an undistorted lens in the middle of the picture, of EXIF's focal length or the one found."""
    widths = options.lens if exif_px is None else replace(options.lens, focal_rel=options.exif_focal_rel)
    focal_px = camera.focal_px if exif_px is None else exif_px
    return lens_prior(Camera.from_focal(camera.width, camera.height, focal_px, camera.model), widths)


def _center_priors(block: Block, image_ids: list[int], photos: tuple[SfmPhoto, ...]) -> CenterPriors | None:
    """Positions of the photos in the block's frame; None where they do not tell a similarity."""
    told = [k for k, image_id in enumerate(image_ids) if photos[image_id - 1].prior_position is not None]
    if len(told) < 3:
        return None
    measured = np.array([photos[image_ids[k] - 1].prior_position for k in told])
    sigmas = np.array([photos[image_ids[k] - 1].prior_sigma_m for k in told])
    centers = block.centers()[told]
    ransac = pycolmap.RANSACOptions()
    ransac.max_error = 3.0 * float(np.linalg.norm(sigmas, axis=1).max())
    ransac.random_seed = 0
    found = pycolmap.estimate_sim3d_robust(centers, measured, ransac)
    if found is None:
        return None
    fit = found["tgt_from_src"]
    turn = Rigid3.from_matrix(np.column_stack([fit.rotation.matrix(), fit.translation])).rotation
    start = Sim3(scale=float(fit.scale), rotation=turn, translation=fit.translation)
    return center_priors(np.array(told, dtype=np.int64), centers, measured, sigmas, start)


def _triangulated_anew(reconstruction: Any, database: Path, folder: Path) -> Any:
    """The same poses and lenses with points triangulated from all matches again."""
    with pycolmap.Database.open(str(database)) as stored:
        # COLMAP refuses a database whose cameras are of another model.
        for camera_id in sorted({reconstruction.image(i).camera_id for i in reconstruction.reg_image_ids()}):
            stored.update_camera(reconstruction.camera(camera_id))
    settings, place = triangulation_settings(), str(folder)
    return pycolmap.triangulate_points(
        reconstruction, str(database), place, place, clear_points=True, options=settings
    )
