"""A block and its terms as COLMAP's bundle adjustment, to whose Ceres problem pyceres adds the terms."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pyceres
import pycolmap
from pycolmap import cost_functions
from scipy import sparse

from featuredb.adjust.block import Block
from featuredb.adjust.marginals import Marginals, marginals
from featuredb.adjust.terms import CenterPriors, LensPrior, Marks, PointPriors, Terms
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3

_LOG = logging.getLogger(__name__)
_MAX_RADIUS = 1e10  # of Levenberg-Marquardt; without any damping what nothing determines is singular
_LETS_GO = 2.0  # sigmas beyond which a lens prior loses to photos that know: EXIF of a cropped photo
_DENSE_SIZE = 1500  # shared parameters; above, the reduced system is factorised sparsely


class Problem:
    """Parameters and residuals in Ceres. Not a value: `solve` changes the parameters.

    Ids of COLMAP are rows + 1. Residuals of keypoints are in pixels, all others are whitened and then
    multiplied by the keypoints' standard deviation, so that one loss has one meaning.
    """

    def __init__(self, block: Block, terms: Terms, threads: int = 1) -> None:
        self._block, self._terms, self._threads = block, terms, threads
        only_marks = _seen_by_marks_alone(block, terms)
        self._reconstruction = _reconstruction(block, only_marks)
        self._options = pycolmap.BundleAdjustmentOptions()
        self._options.refine_principal_point = True
        self._options.print_summary = False
        self._options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        self._options.ceres.loss_function_scale = terms.keypoint_px
        config = pycolmap.BundleAdjustmentConfig()
        for k in range(len(block.names)):
            config.add_image(k + 1)
        for k in terms.held_photos:
            config.set_constant_rig_from_world_pose(self._reconstruction.image(k + 1).frame_id)
        for k in range(len(only_marks)):
            config.add_constant_point(len(block.xyz) + k + 1)
        for c, lens in enumerate(terms.lenses):
            if lens is None:
                config.set_constant_cam_intrinsics(c + 1)
        self._adjuster = pycolmap.create_default_ceres_bundle_adjuster(
            self._options, config, self._reconstruction
        )
        self._ceres = self._adjuster.problem
        self._poses = [
            self._reconstruction.frame(self._reconstruction.image(k + 1).frame_id).rig_from_world.params
            for k in range(len(block.names))
        ]
        self._lenses = [self._reconstruction.camera(c + 1).params for c in range(len(block.cameras))]
        seen = np.unique(block.point_of)
        self._points = {int(p): self._reconstruction.point3D(int(p) + 1).xyz for p in seen}
        self._loss = pyceres.CauchyLoss(terms.keypoint_px)
        self._add_lenses(terms.lenses)
        if terms.marks is not None:
            self._add_marks(terms.marks)
        if terms.centers is not None:
            self._add_centers(terms.centers)
        if terms.points is not None:
            self._add_points(terms.points)

    def solve(self, max_iterations: int, function_tolerance: float) -> Any:
        """Minimise; returns Ceres' summary."""
        options = pyceres.SolverOptions()
        options.max_num_iterations = max_iterations
        options.function_tolerance = function_tolerance
        options.num_threads = self._threads
        options.max_trust_region_radius = _MAX_RADIUS
        shared = 6 * len(self._poses) + sum(map(len, self._lenses))
        options.linear_solver_type = (
            pyceres.LinearSolverType.DENSE_SCHUR
            if shared <= _DENSE_SIZE
            else pyceres.LinearSolverType.SPARSE_SCHUR
        )
        summary = pyceres.SolverSummary()
        pyceres.solve(options, self._ceres, summary)
        if not summary.IsSolutionUsable():
            _LOG.warning("the adjustment failed, everything stays as it was: %s", summary.BriefReport())
        return summary

    def block(self) -> Block:
        """The block with the parameters as they are now."""
        xyz = self._block.xyz.copy()
        for row, value in self._points.items():
            xyz[row] = value
        return replace(
            self._block,
            cameras=tuple(
                replace(camera, params=tuple(params))
                for camera, params in zip(self._block.cameras, self._lenses, strict=True)
            ),
            cam_from_block=tuple(_pose(params) for params in self._poses),
            xyz=xyz,
        )

    def marginals(self) -> Marginals:
        """Covariances at the parameters as they are now, for independent residuals of the stated sigmas."""
        photos = [
            k for k, pose in enumerate(self._poses) if k not in self._terms.held_photos and self._has(pose)
        ]
        cameras = [
            c
            for c, prior in enumerate(self._terms.lenses)
            if prior is not None and self._has(self._lenses[c])
        ]
        rows = list(self._points)
        order = pyceres.EvaluateOptions()
        order.num_threads = self._threads
        order.set_parameter_blocks(
            [
                *self._points.values(),
                *(self._poses[k] for k in photos),
                *(self._lenses[c] for c in cameras),
            ]
        )
        found = self._ceres.evaluate_jacobian(order)
        jacobian = sparse.csr_matrix(
            (np.asarray(found.values), np.asarray(found.cols), np.asarray(found.rows)),
            shape=(found.num_rows, found.num_cols),
        )
        return marginals(
            jacobian / self._terms.keypoint_px,
            np.array(rows, dtype=np.int64),
            photos,
            cameras,
            self.block(),
        )

    def _has(self, parameters: FloatArray) -> bool:
        """Whether anything is observed of them."""
        return bool(self._ceres.has_parameter_block(parameters))

    def _add_lenses(self, priors: tuple[LensPrior | None, ...]) -> None:
        unit = 1.0 / (self._terms.keypoint_px**2 * self._terms.dilution)
        loss = pyceres.CauchyLoss(_LETS_GO / np.sqrt(unit))
        for params, prior in zip(self._lenses, priors, strict=True):
            if prior is not None and self._has(params):
                cost = pyceres.factors.NormalPrior(np.array(prior.mean.params), unit * prior.covariance)
                self._ceres.add_residual_block(cost, loss, [params])

    def _add_points(self, priors: PointPriors) -> None:
        unit = 1.0 / self._terms.keypoint_px**2
        for point, xyz, covariance in zip(
            priors.point_of.tolist(), priors.xyz, unit * priors.covariance, strict=True
        ):
            if point in self._points:
                cost = pyceres.factors.NormalPrior(xyz, covariance)
                self._ceres.add_residual_block(cost, self._loss, [self._points[point]])

    def _add_marks(self, marks: Marks) -> None:
        covariance = np.eye(2) * (marks.sigma_px / self._terms.keypoint_px) ** 2
        for xyz, photo, xy in zip(marks.xyz, marks.photo_of.tolist(), marks.xy, strict=True):
            lens = int(self._block.camera_of[photo])
            model = pycolmap.CameraModelId.__members__[self._block.cameras[lens].model]
            cost = cost_functions.ReprojErrorCost(
                camera_model_id=model, point2D_cov=covariance, point2D=xy, point3D=xyz
            )
            self._ceres.add_residual_block(cost, self._loss, [self._poses[photo], self._lenses[lens]])

    def _add_centers(self, priors: CenterPriors) -> None:
        unit = 1.0 / self._terms.keypoint_px**2
        for photo, xyz, covariance in zip(
            priors.photo_of.tolist(), priors.xyz, priors.covariance, strict=True
        ):
            cost = cost_functions.AbsolutePosePositionPriorCost(unit * covariance, xyz)
            self._ceres.add_residual_block(cost, self._loss, [self._poses[photo]])


def _pose(params: FloatArray) -> Rigid3:
    return Rigid3.from_quaternion(params[:4] / np.linalg.norm(params[:4]), params[4:])


def _seen_by_marks_alone(block: Block, terms: Terms) -> list[int]:
    """Photos that see marks and nothing of the block."""
    marked = terms.marks.photo_of if terms.marks is not None else np.zeros(0, dtype=np.int64)
    return sorted(set(marked.tolist()) - set(block.photo_of.tolist()))


def _reconstruction(block: Block, only_marks: list[int]) -> Any:
    """The block as COLMAP's reconstruction; ids are rows + 1, each photo a frame of its camera's rig.

    COLMAP makes parameters of photos that see points. Those of `only_marks` get one behind them, twice, which
    has no residual, beyond the ids of the block's points.
    """
    result = pycolmap.Reconstruction()
    for c, camera in enumerate(block.cameras):
        result.add_camera_with_trivial_rig(camera.to_pycolmap(c + 1))
    by_photo = np.argsort(block.photo_of, kind="stable")
    starts = np.searchsorted(block.photo_of[by_photo], np.arange(len(block.names) + 1))
    place = np.empty(len(by_photo), dtype=np.int64)  # of an observation among those of its photo
    for k, pose in enumerate(block.cam_from_block):
        rows = by_photo[starts[k] : starts[k + 1]]
        place[rows] = np.arange(len(rows))
        pixels = np.zeros((2, 2)) if k in only_marks else block.xy[rows]
        image = pycolmap.Image(
            name=str(k), keypoints=pixels, camera_id=int(block.camera_of[k]) + 1, image_id=k + 1
        )
        result.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
    by_point = np.argsort(block.point_of, kind="stable")
    points, first = np.unique(block.point_of[by_point], return_index=True)
    photo, at = (block.photo_of[by_point] + 1).tolist(), place[by_point].tolist()
    ends = np.append(first[1:], len(by_point))[: len(first)].tolist()
    colour = np.zeros(3, dtype=np.uint8)
    for point, start, end in zip(points.tolist(), first.tolist(), ends, strict=True):
        elements = [pycolmap.TrackElement(photo[i], at[i]) for i in range(start, end)]
        result.add_point3D_with_id(
            point + 1, pycolmap.Point3D(xyz=block.xyz[point], track=pycolmap.Track(elements), color=colour)
        )
    for i, k in enumerate(only_marks):
        track = pycolmap.Track([pycolmap.TrackElement(k + 1, 0), pycolmap.TrackElement(k + 1, 1)])
        behind = block.cam_from_block[k].inverse().act(np.array([0.0, 0.0, -1.0]))
        result.add_point3D_with_id(
            len(block.xyz) + i + 1, pycolmap.Point3D(xyz=behind, track=track, color=colour)
        )
    return result
