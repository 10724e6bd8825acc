"""A block and its terms as COLMAP's bundle adjustment, to whose Ceres problem pyceres adds the terms."""

import logging
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pyceres
import pycolmap
from numpy.typing import NDArray
from pycolmap import cost_functions
from scipy import sparse

from featuredb.adjust.lens_agreement import Weighted, diluted, lens_disagreement
from featuredb.adjust.marginals import (
    Marginals,
    TargetMarginals,
    inverse_without_points,
    marginals,
    points_by_shared,
    target_marginals,
)
from featuredb.adjust.terms import (
    Block,
    CenterPriors,
    LensPrior,
    Marks,
    Orientations,
    PointPriors,
    Targets,
    Terms,
)
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.stop_signals import handle_as_before

_LOG = logging.getLogger(__name__)
handle_as_before()  # pyceres has put a handler there that prints a stack trace
_MAX_RADIUS = 1e10  # of Levenberg-Marquardt; without any damping what nothing determines is singular
_LETS_GO = 2.0  # sigmas beyond which a lens prior loses to photos that know: EXIF of a cropped photo
_ANYWHERE = 1e6  # units of the block: sigma of a position of which nothing is known
_FAR_BEHIND = 1e6  # units of the block: no camera comes so far that what was behind it is not
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
        self._targets: list[Any] = []  # residual blocks: the marks, then the surveyed points
        self._diluted: list[Any] = []  # residual blocks of priors that count `dilution` times
        self._add_lenses(terms.lenses)
        if terms.marks is not None:
            self._add_marks(terms.marks)
        if terms.centers is not None:
            self._add_centers(terms.centers)
        if terms.points is not None:
            self._add_points(terms.points)
        if terms.orientations is not None:
            self._add_orientations(terms.orientations)
        if terms.targets is not None:
            self._add_targets(terms.targets)

    def solve(self, max_iterations: int, function_tolerance: float, radius: float | None = None) -> Any:
        """Minimise; returns Ceres' summary.

        Args:
            radius: of the trust region to begin with. What hangs on a few terms, such as a whole block on its
                control points, does not move before it is large.
        """
        options = pyceres.SolverOptions()
        if radius is not None:
            options.initial_trust_region_radius = radius
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
        told = pyceres.logging.minloglevel
        pyceres.logging.minloglevel = pyceres.logging.Level.ERROR.value  # steps taken back are no news
        try:
            pyceres.solve(options, self._ceres, summary)
        finally:
            pyceres.logging.minloglevel = told
        if not summary.IsSolutionUsable():
            _LOG.warning("the adjustment failed, everything stays as it was: %s", summary.BriefReport())
        elif summary.termination_type == pyceres.TerminationType.NO_CONVERGENCE:
            _LOG.info("the adjustment was stopped on its way after %d steps", max_iterations)
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
            cam_from_block=tuple(
                Rigid3.from_quaternion(p[:4] / np.linalg.norm(p[:4]), p[4:]) for p in self._poses
            ),
            xyz=xyz,
        )

    def marginals(self) -> Marginals:
        """Covariances at the parameters as they are now, for independent residuals of the stated sigmas."""
        poses, lenses = self._free()
        return marginals(inverse_without_points(*self._by_point_and_shared()), poses, lenses, self.block())

    def honest_marginals(self) -> tuple[Marginals, Marginals]:
        """Covariances as the residuals and the priors as they are have them, where `dilution` is a choice of
        weights (`featuredb.adjust.lens_agreement`); and `marginals`.
        """
        (poses, lenses), block, weighted = self._free(), self.block(), self._weighted()
        disagreement, columns, inverse = lens_disagreement(weighted), weighted.lenses, weighted.inverse
        del weighted  # its Jacobian is large
        of_priors = self._jacobian(self._shared(), self._diluted).toarray()
        covariance = diluted(inverse, of_priors, self._terms.dilution, columns, disagreement)
        return marginals(covariance, poses, lenses, block), marginals(inverse, poses, lenses, block)

    def points_by_shared(self) -> tuple[NDArray[np.int64], Any, FloatArray]:
        """The block's points that are seen (n,); `featuredb.adjust.marginals.points_by_shared` of them."""
        moved, information = points_by_shared(*self._by_point_and_shared(), self._free()[0], self.block())
        return np.array(list(self._points), dtype=np.int64), moved, information

    def _weighted(self) -> Weighted:
        """The adjustment, linear at the parameters as they are now."""
        poses, lenses = self._free()
        by_point, by_shared = self._by_point_and_shared()
        inverse = inverse_without_points(by_point, by_shared)
        ends = 6 * len(poses) + np.cumsum([0, *(len(self._lenses[c]) for c in lenses)])
        return Weighted(
            by_point=by_point,
            by_shared=by_shared,
            residual=np.asarray(self._ceres.evaluate_residuals()) / self._terms.keypoint_px,
            inverse=inverse,
            lenses=[slice(int(a), int(b)) for a, b in pairwise(ends)],
        )

    def by_lens_priors(self, found: Marginals, cameras: Collection[int]) -> FloatArray:
        """(q, q) the part of `found.by_lenses()` that comes from how far lenses are off their priors.

        Args:
            found: by `marginals`. cameras: rows of the lenses.
        """
        part = np.zeros_like(found.shared)
        for c in cameras:
            prior = self._terms.lenses[c]
            if prior is not None and found.lens_start[c] >= 0:
                off = np.array(self._lenses[c]) - np.array(prior.mean.params)
                information = np.linalg.inv(prior.covariance)
                squares = float(off @ information @ off)
                weight = 1.0 / (1.0 + squares / _LETS_GO**2) if prior.robust else 1.0  # of the Cauchy loss
                start = int(found.lens_start[c])
                across = found.shared[:, start : start + found.lens_size[c]]
                part += across @ (weight**2 * information) @ across.T
        return part

    def target_marginals(self) -> TargetMarginals:
        """The same with the targets, and what their residuals may be."""
        assert self._terms.targets is not None
        poses, lenses = self._free()
        targets = _target_rows(self._terms.targets)
        columns = [*(self._points[row] for row in targets.tolist()), *self._shared()]
        residual = self._ceres.evaluate_residuals(self._targets)
        return target_marginals(
            inverse_without_points(
                self._jacobian([self._points[row] for row in self._points.keys() - set(targets.tolist())]),
                self._jacobian(columns),
            ),
            self._jacobian(columns, self._targets),
            np.asarray(residual) / self._terms.keypoint_px,
            targets,
            len(self._terms.targets.xy),
            (poses, lenses),
            self.block(),
        )

    def _free(self) -> tuple[list[int], list[int]]:
        """Photos and cameras that are not held, and of which anything is observed."""
        poses = [
            k for k, pose in enumerate(self._poses) if k not in self._terms.held_photos and self._has(pose)
        ]
        lenses = [
            c
            for c, prior in enumerate(self._terms.lenses)
            if prior is not None and self._has(self._lenses[c])
        ]
        return poses, lenses

    def _has(self, parameters: FloatArray) -> bool:
        """Whether anything is observed of them."""
        return bool(self._ceres.has_parameter_block(parameters))

    def _shared(self) -> list[FloatArray]:
        """Parameters of free poses and lenses."""
        poses, lenses = self._free()
        return [*(self._poses[k] for k in poses), *(self._lenses[c] for c in lenses)]

    def _by_point_and_shared(self) -> tuple[Any, Any]:
        """The Jacobian by points, and by free poses and lenses."""
        poses, lenses = self._free()
        by_pose = self._jacobian([self._poses[k] for k in poses])
        by_lens = self._jacobian([self._lenses[c] for c in lenses])
        by_shared = sparse.hstack([by_pose, by_lens], format="csr")
        return self._jacobian(list(self._points.values())), by_shared

    def _jacobian(self, parameters: Sequence[FloatArray], residuals: Sequence[Any] | None = None) -> Any:
        """(r, q) CSR, of all whitened residuals or of some, by parameters."""
        if not parameters or residuals == []:
            rows = self._ceres.num_residuals() if residuals is None else 0
            return sparse.csr_matrix((rows, sum(map(self._ceres.parameter_block_tangent_size, parameters))))
        order = pyceres.EvaluateOptions()
        order.num_threads = self._threads
        order.set_parameter_blocks(list(parameters))
        if residuals:
            order.set_residual_blocks(list(residuals))
        found = self._ceres.evaluate_jacobian(order)
        shape = (found.num_rows, found.num_cols)
        # One after the other: each comes as a list of Python's, six times as large.
        values = np.array(found.values, np.float64)
        values /= self._terms.keypoint_px
        columns = np.array(found.cols, np.int32)
        rows = np.array(found.rows, np.int32)
        del found
        return sparse.csr_matrix((values, columns, rows), shape=shape)

    def _add_lenses(self, priors: tuple[LensPrior | None, ...]) -> None:
        unit = 1.0 / (self._terms.keypoint_px**2 * self._terms.dilution)
        loss = pyceres.CauchyLoss(_LETS_GO / np.sqrt(unit))
        for params, prior in zip(self._lenses, priors, strict=True):
            if prior is not None and self._has(params):
                cost = pyceres.factors.NormalPrior(np.array(prior.mean.params), unit * prior.covariance)
                self._diluted.append(
                    self._ceres.add_residual_block(cost, loss if prior.robust else None, [params])
                )

    def _add_points(self, priors: PointPriors) -> None:
        unit = 1.0 / self._terms.keypoint_px**2
        for point, xyz, covariance in zip(
            priors.point_of.tolist(), priors.xyz, unit * priors.covariance, strict=True
        ):
            if point in self._points:
                cost = pyceres.factors.NormalPrior(xyz, covariance)
                self._ceres.add_residual_block(cost, self._loss, [self._points[point]])

    def _add_marks(self, marks: Marks) -> None:
        variance = np.broadcast_to(np.square(marks.sigma_px / self._terms.keypoint_px), len(marks.xyz))
        for xyz, photo, xy, one in zip(
            marks.xyz, marks.photo_of.tolist(), marks.xy, variance.tolist(), strict=True
        ):
            cost, parameters = self._reprojection(photo, one, point2D=xy, point3D=xyz)
            self._ceres.add_residual_block(cost, self._loss, parameters)

    def _reprojection(
        self, photo: int, variance: float, **points: FloatArray
    ) -> tuple[Any, list[FloatArray]]:
        """The cost of a pixel of a photo, and the parameters of its pose and lens."""
        lens = int(self._block.camera_of[photo])
        model = pycolmap.CameraModelId.__members__[self._block.cameras[lens].model]
        cost = cost_functions.ReprojErrorCost(
            camera_model_id=model, point2D_cov=variance * np.eye(2), **points
        )
        return cost, [self._poses[photo], self._lenses[lens]]

    def _add_centers(self, priors: CenterPriors) -> None:
        unit = 1.0 / (self._terms.keypoint_px**2 * self._terms.dilution)
        loss = pyceres.CauchyLoss(1.0 / np.sqrt(unit))
        for photo, xyz, covariance in zip(
            priors.photo_of.tolist(), priors.xyz, priors.covariance, strict=True
        ):
            cost = cost_functions.AbsolutePosePositionPriorCost(unit * covariance, xyz)
            self._diluted.append(self._ceres.add_residual_block(cost, loss, [self._poses[photo]]))

    def _add_orientations(self, priors: Orientations) -> None:
        unit = 1.0 / self._terms.keypoint_px**2
        for photo, rotation, covariance in zip(
            priors.photo_of.tolist(), priors.cam_from_block, priors.covariance, strict=True
        ):
            whole = np.eye(6) * _ANYWHERE**2
            whole[:3, :3] = unit * rotation @ covariance @ rotation.T
            expected = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), self._poses[photo][4:])
            cost = cost_functions.AbsolutePosePriorCost(whole, expected)
            self._ceres.add_residual_block(cost, self._loss, [self._poses[photo]])

    def _add_targets(self, targets: Targets) -> None:
        for row in _target_rows(targets).tolist():
            self._points.setdefault(row, self._block.xyz[row].copy())
        unit = 1.0 / self._terms.keypoint_px**2
        for point, photo, xy in zip(
            targets.point_of.tolist(), targets.photo_of.tolist(), targets.xy, strict=True
        ):
            cost, parameters = self._reprojection(photo, unit * targets.sigma_px**2, point2D=xy)
            parameters = [self._points[point], *parameters]
            self._targets.append(self._ceres.add_residual_block(cost, None, parameters))
        survey = targets.survey
        for point, xyz, covariance in zip(
            survey.point_of.tolist(), survey.xyz, unit * survey.covariance, strict=True
        ):
            cost = pyceres.factors.NormalPrior(xyz, covariance)
            self._targets.append(self._ceres.add_residual_block(cost, None, [self._points[point]]))


def _target_rows(targets: Targets) -> NDArray[np.int64]:
    """The block's points that are marked or surveyed, in order."""
    return np.union1d(targets.point_of, targets.survey.point_of)


def _seen_by_marks_alone(block: Block, terms: Terms) -> list[int]:
    """Photos that see marks or targets and nothing of the block."""
    marked = {
        photo for seen in (terms.marks, terms.targets) if seen is not None for photo in seen.photo_of.tolist()
    }
    return sorted(marked - set(block.photo_of.tolist()))


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
        behind = block.cam_from_block[k].inverse().act(np.array([0.0, 0.0, -_FAR_BEHIND]))
        result.add_point3D_with_id(
            len(block.xyz) + i + 1, pycolmap.Point3D(xyz=behind, track=track, color=colour)
        )
    return result
