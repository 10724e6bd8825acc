"""Absolute pose from 2D-3D matches: LO-RANSAC, focal length where unknown, refinement, covariance."""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray
from scipy.special import chdtri

from featuredb.adjust.shared_noise import design_effect
from featuredb.adjust.terms import whole_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.stop_signals import handle_as_before
from reloc.localise.lens_prior import LensPriors, QueryLensPrior, lens_of, pixel_jacobians, with_lens
from reloc.localise.options import PoseOptions
from reloc.localise.self_calibration import calibrate, covariance_from_information, score
from reloc.wire.query import CameraSource

# Of twice the logarithm of the likelihood, by three parameters: one of twenty whole photos is above, and its
# bound is wider then. A lens that a map has lent is known far better than a photo tells it: one of a
# thousand.
_PART_GAIN, _LENT_GAIN = float(chdtri(3, 0.05)), float(chdtri(3, 0.001))

handle_as_before()  # pycolmap's glog has put a handler there that prints a stack trace


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseHypothesis:
    """A pose with the matches that agree with it.

    Attributes:
        cam_from_local: area frame to camera.
        camera: intrinsics, the focal length estimated where `camera_source` is exif or estimated.
        inliers: (m,) bool over the matches that it was estimated from.
        lens_prior: what was known of the lens beforehand, where it is estimated with the pose; None: it is
            exact.
        part: the picture was cut out of a larger one, or zoomed; said of one of a thousand whole ones.
    """

    cam_from_local: Rigid3
    camera: Camera
    camera_source: CameraSource
    inliers: NDArray[np.bool_]
    lens_prior: QueryLensPrior | None = None
    part: bool = False

    @property
    def count(self) -> int:
        return int(self.inliers.sum())


def estimate_pose(
    pixels: FloatArray, points: FloatArray, camera: Camera, source: CameraSource, options: PoseOptions
) -> PoseHypothesis | None:
    """LO-RANSAC (poselib's P3P; pycolmap's P4Pf besides where the focal length is free), or None.

    Args:
        pixels: (m, 2) full-size pixels. points: (m, 3) metres in the area's frame.
        camera: intrinsics, or a start for the focal length where `source` is exif or estimated.
    """
    if len(pixels) < options.min_matches:
        return None
    tolerance_px = options.tolerance_px(camera)
    asked = (pixels, points, tolerance_px, options)
    tries = [_ransac(guess, *asked) for guess in _guesses(camera, source, options.lens)]
    if source in ("exif", "estimated"):
        tries.append(_ransac_focal(camera, *asked))
    found = [
        PoseHypothesis(
            cam_from_local=cam_from_local,
            camera=lens,
            camera_source=source,
            inliers=reprojection_errors(pixels, points, lens, cam_from_local) < tolerance_px,
            lens_prior=options.lens.of_source(camera, source),
        )
        for cam_from_local, lens in (found for found in tries if found is not None)
    ]
    return max(found, key=lambda pose: pose.count, default=None)


def _guesses(camera: Camera, source: CameraSource, lens: LensPriors) -> list[Camera]:
    """Lenses that are tried as if they were known.

    The focal length of a minimal sample is arbitrary where the scene is flat and seen from above; there any
    focal length fits, and the refinement goes on from the guess.
    """
    wide = 1.0 + lens.exif_focal_rel
    factors = {"exif": (1.0, 1.0 / wide, wide), "estimated": (1.0, 0.5, 0.7, 1.4, 2.0)}
    return [
        camera if f == 1.0 else camera.with_focal(f * camera.focal_px) for f in factors.get(source, (1.0,))
    ]


def _ransac(
    camera: Camera, pixels: FloatArray, points: FloatArray, tolerance_px: float, options: PoseOptions
) -> tuple[Rigid3, Camera] | None:
    pose, info = poselib.estimate_absolute_pose(
        pixels,
        points,
        asdict(camera),
        {
            "max_reproj_error": tolerance_px,
            "seed": options.seed,
            "success_prob": options.confidence,
            "min_iterations": 200,
            "max_iterations": options.max_iterations,
        },
        {"loss_type": "CAUCHY", "loss_scale": 0.25 * tolerance_px},
    )
    if info["num_inliers"] < 4:
        return None
    w, x, y, z = pose.q
    return Rigid3.from_quaternion([x, y, z, w], pose.t), camera


def _ransac_focal(
    camera: Camera, pixels: FloatArray, points: FloatArray, tolerance_px: float, options: PoseOptions
) -> tuple[Rigid3, Camera] | None:
    settings = pycolmap.AbsolutePoseEstimationOptions()
    settings.estimate_focal_length = True
    settings.ransac.max_error = tolerance_px
    settings.ransac.random_seed = options.seed
    settings.ransac.confidence = options.confidence
    settings.ransac.max_num_trials = options.max_iterations
    settings.ransac.min_num_trials = 200
    working = camera.to_pycolmap()  # pycolmap writes the focal length into it
    found = pycolmap.estimate_absolute_pose(pixels, points, working, settings)
    if found is None or found["num_inliers"] < 4:
        return None
    focal = float(np.mean([working.params[i] for i in working.focal_length_idxs()]))
    # 0.3 to 5 times the longer side is 118 to 11 degrees of view: outside lies no camera that SIFT serves.
    if not 0.3 <= focal / max(camera.width, camera.height) <= 5.0:
        return None
    return _from_pycolmap(found["cam_from_world"]), Camera.from_pycolmap(working)


def with_any_lens(
    pixels: FloatArray, points: FloatArray, found: PoseHypothesis, options: PoseOptions
) -> PoseHypothesis | None:
    """The pose of a picture that was cut out of a larger one or zoomed; None for lenses other than OPENCV's.

    Args:
        pixels, points: as of `estimate_pose`, which has found the pose of a whole photo.
    """
    lens, lent = whole_camera(found.camera), found.camera_source == "map"
    if lens.model != "OPENCV":
        return None
    starts = [(found.cam_from_local, lens)]
    zoomed = _ransac_focal(lens, pixels, points, options.tolerance_px(lens), options) if lent else None
    if zoomed is not None:
        starts.append((zoomed[0], with_lens(lens, np.append(zoomed[1].focal_px, lens_of(lens)[1:]))))
    prior = options.lens.of_part(lens, distorts=not lent)
    part = replace(found, camera_source="estimated", lens_prior=prior, part=True)
    tries = [
        _widened(pixels, points, replace(part, cam_from_local=cam_from_local, camera=camera), options)
        for cam_from_local, camera in starts
    ]
    return max(tries, key=lambda pose: pose.count)


def _widened(
    pixels: FloatArray, points: FloatArray, start: PoseHypothesis, options: PoseOptions
) -> PoseHypothesis:
    """Refined as long as more matches agree: from one corner over the rest of the picture."""
    best = refine_pose(pixels, points, start, options)
    while (further := refine_pose(pixels, points, best, options)).count > best.count:
        best = further
    return best


def refine_pose(
    pixels: FloatArray, points: FloatArray, start: PoseHypothesis, options: PoseOptions, rounds: int = 2
) -> PoseHypothesis:
    """Robust refinement (Cauchy) on all matches within reach, then the inliers counted anew.

    The lens is refined too where it is not known, within what lenses are like.

    Args:
        rounds: how often the matches within reach are chosen anew.
    """
    tolerance_px = options.tolerance_px(start.camera)
    pose = start
    for _ in range(rounds):
        residual = reprojection_errors(pixels, points, pose.camera, pose.cam_from_local)
        near = residual < 2.0 * tolerance_px
        if near.sum() < 4:
            break
        if pose.lens_prior is not None:
            problem = (pose.cam_from_local, pose.camera, pose.lens_prior)
            moved, camera, _ = calibrate(pixels[near], points[near], *problem, 0.25 * tolerance_px)
            pose = replace(pose, cam_from_local=moved, camera=camera)
        else:
            pose = _refine_known_lens(pixels, points, near, pose, tolerance_px)
    residual = reprojection_errors(pixels, points, pose.camera, pose.cam_from_local)
    return replace(pose, inliers=residual < tolerance_px)


def refined_as_part(
    pixels: FloatArray,
    points: FloatArray,
    whole: PoseHypothesis,
    known: QueryLensPrior,
    options: PoseOptions,
) -> PoseHypothesis | None:
    """The pose of a picture cut out of a larger one, zoomed, or put into one; None: it may be a whole photo.

    Contradiction: the ratio of the likelihoods with any focal length and the lens's axis anywhere, and with
    what is known of whole photos, by chi-square (Wilks), over what neighbouring residuals share. Where a map
    has lent the lens, the derivatives alone are asked before it, which takes no time: one whole photo of
    twenty passes.

    Args:
        pixels, points: (m, 2), (m, 3) of all matches. whole: refined, as of a whole photo.
        known: what is known of its lens, also where a map has lent it and it is not estimated.
    """
    lent = whole.lens_prior is None
    tolerance_px = options.tolerance_px(whole.camera)
    near = reprojection_errors(pixels, points, whole.camera, whole.cam_from_local) < 2.0 * tolerance_px
    seen = (pixels[near], points[near], whole.cam_from_local, whole.camera)
    prior = options.lens.of_part(whole.camera, distorts=not lent)
    as_whole = replace(known, dilution=1.0)
    noise_px = 0.25 * tolerance_px
    if lent and score(*seen, prior, noise_px) - score(*seen, as_whole, noise_px) < _PART_GAIN:
        return None
    moved, camera, gain = calibrate(*seen, prior, noise_px)
    if lent:
        gain -= calibrate(*seen, as_whole, noise_px)[2]
    left = camera.project(moved.act(points[near])) - pixels[near]
    fits = np.linalg.norm(left, axis=1) < tolerance_px
    one = np.zeros(int(fits.sum()), dtype=np.int64)
    shared = design_effect(left[fits], pixels[near][fits], one, max(camera.width, camera.height))
    if gain < shared * (_LENT_GAIN if lent else _PART_GAIN):
        return None
    # Once more: how much the pixels count followed from the residuals of a whole photo.
    told = replace(prior, dilution=shared)
    part = replace(whole, cam_from_local=moved, camera=camera, lens_prior=told, part=lent)
    return refine_pose(pixels, points, replace(part, camera_source="estimated"), options)


def _refine_known_lens(
    pixels: FloatArray,
    points: FloatArray,
    near: NDArray[np.bool_],
    start: PoseHypothesis,
    tolerance_px: float,
) -> PoseHypothesis:
    settings = pycolmap.AbsolutePoseRefinementOptions()
    settings.loss_function_scale = 0.25 * tolerance_px
    found = pycolmap.refine_absolute_pose(
        pycolmap.Rigid3d(start.cam_from_local.matrix()[:3]),
        pixels,
        points,
        near,
        start.camera.to_pycolmap(),
        settings,
    )
    return start if found is None else replace(start, cam_from_local=_from_pycolmap(found["cam_from_world"]))


def reprojection_errors(
    pixels: FloatArray, points: FloatArray, camera: Camera, cam_from_local: Rigid3
) -> FloatArray:
    """(m,) distances in pixels, infinity for points behind the camera."""
    difference = camera.project(cam_from_local.act(points)) - pixels
    error = np.sqrt(np.einsum("ij,ij->i", difference, difference))
    return np.where(np.isfinite(error), error, np.inf)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseUncertainty:
    """Covariance of a pose, measurement part.

    Attributes:
        joint: (6 + n, 6 + n), area frame's axes: rotation of the camera (rad) before displacement of its
            centre (m); R_true = R(dtheta) R, C_true = C + dC for world_from_cam = (R, C). Then the
            parameters of the lens in the order of `lens_of`, where it was estimated, too; else n = 0.
        residual_rms_px: of the inliers.
    """

    joint: FloatArray
    residual_rms_px: float

    @property
    def covariance(self) -> FloatArray:
        """(6, 6), of the pose."""
        return self.joint[:6, :6]


def pose_uncertainty(
    pixels: FloatArray,
    points: FloatArray,
    point_covariance: FloatArray,
    pose: PoseHypothesis,
    options: PoseOptions,
) -> PoseUncertainty:
    """From the Jacobian of the inliers, scaled by the measured residuals; an estimated lens marginalised.

    Args:
        pixels, points: (k, 2), (k, 3) of the inliers only.
        point_covariance: (k, 3, 3) in the area's frame.
    """
    lens = pose.lens_prior
    by_point, jacobian = pixel_jacobians(pose.camera, pose.cam_from_local, points, lens=lens is not None)
    residual = pose.camera.project(pose.cam_from_local.act(points)) - pixels
    noise = np.eye(2) + by_point @ point_covariance @ by_point.transpose(0, 2, 1)
    weight = np.linalg.inv(noise)
    chi_square = float(np.einsum("ni,nij,nj->", residual, weight, residual))
    # Chi-square per degree of freedom, times what the robust loss costs.
    factor = chi_square / max(2 * len(points) - jacobian.shape[2], 1)
    # The scale of the Cauchy loss is a quarter of the inlier tolerance.
    factor *= _price_of_robustness(residual, 0.25 * options.tolerance_px(pose.camera), jacobian.shape[2])
    # Residuals of zero are test data; the floor is a hundredth of a pixel.
    information = np.einsum("nij,nik,nkl->jl", jacobian, weight, jacobian) / max(factor, 1e-4)
    if lens is not None:
        information[6:, 6:] += np.diag(lens.information)
    covariance = covariance_from_information(information)
    if lens is not None and lens.dilution > 1.0:
        by_lens = covariance[:, 6:] @ np.linalg.solve(covariance[6:, 6:], covariance[6:])
        covariance = covariance + (lens.dilution - 1.0) * by_lens
    return PoseUncertainty(
        joint=covariance,
        residual_rms_px=float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))),
    )


def _price_of_robustness(residual: FloatArray, scale_px: float, parameters: int) -> float:
    """Variance of the Cauchy estimate over that of least squares, for residuals (k, 2) like these.

    Asymptotic variance of an M-estimator, E[psi^2] / E[psi']^2, with the correction for the number of
    estimated parameters (Huber, Robust Statistics, 1981, ch. 3 and 7.6). Above 1 for residuals as wide as
    the loss. Far below it where most are small and a few lie at the edge of the tolerance, as matches
    usually do: least squares would follow those few.
    """
    squared = np.sum(residual**2, axis=1)
    spread = float(np.mean(squared))
    if spread <= 0.0:
        return 1.0
    weight = 1.0 / (1.0 + squared / scale_px**2)
    across, along = weight, weight - 2.0 * weight**2 * squared / scale_px**2
    # Residuals much larger than the scale have hardly any slope left; beyond this the formula says nothing.
    slope = max(float(np.mean(across + along)) / 2.0, 0.1)
    variation = max(float(np.mean(across**2 + along**2)) / 2.0 / slope**2 - 1.0, 0.0)
    few = 1.0 + parameters / residual.size * variation
    # A dozen residuals may be small by luck; the lower bound keeps that from being taken for precision.
    return float(np.clip(few**2 * np.mean(weight**2 * squared) / spread / slope**2, 0.1, 10.0))


def _from_pycolmap(rigid: Any) -> Rigid3:
    return Rigid3.from_matrix(rigid.matrix())
