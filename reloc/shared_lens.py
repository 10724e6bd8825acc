"""One lens of many photos, estimated with all their poses: a photo alone hardly tells it from its height.

Least squares over all photos, by the residuals, weights and priors of `reloc.self_calibration`; each one's
pose is eliminated (Schur complement), since only the lens ties them. The map's points are held fixed.
COLMAP's bundle adjustment has no priors on lenses, which three photos from above may need.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from reloc.lens_prior import LensPrior, LensPriors, lens_of
from reloc.options import PoseOptions
from reloc.self_calibration import (
    LensProblem,
    NormalEquations,
    calibrate,
    covariance_from_information,
    lens_step,
    measured_noise_px,
    pose_step,
    prior_cost,
)
from reloc.wire import CameraRequest, LocaliseReply


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedLensOptions:
    """When photos have a lens in common.

    Attributes:
        least_photos: that agree on a lens.
        max_excess: by how much more a photo's pixels disagree with the common lens than with one of its own:
            half a chi-square of eight degrees of freedom, 99.9 % of which is below. Photos of one lens had 10
            at most, those of another camera 2,800 and more.
        sigma_scale: errors of neighbouring pixels are not independent: the focal lengths of random groups of
            3 to 14 photos of a simulated drone were off by 1.4 to 1.7 of the plain sigmas.
    """

    least_photos: int = 3
    max_excess: float = 13.1
    sigma_scale: float = 1.6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensView:
    """What a localised photo says of its lens: pixels (k, 2) of points (k, 3), and its own pose and lens."""

    pixels: FloatArray
    points: FloatArray
    cam_from_local: Rigid3
    camera: Camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SharedLens:
    """A lens that photos agree on.

    Attributes:
        camera: OPENCV. sigmas: (8,) one standard deviation of each of its parameters, in their order.
        agree: (n,) which of the photos. excess: (n,) see `SharedLensOptions.max_excess`.
    """

    camera: Camera
    sigmas: FloatArray
    agree: NDArray[np.bool_]
    excess: FloatArray

    def as_request(self) -> CameraRequest:
        """As a query takes it."""
        camera = self.camera
        return CameraRequest(
            model=camera.model,
            width=camera.width,
            height=camera.height,
            params=camera.params,
            sigmas=tuple(float(s) for s in self.sigmas),
        )


def views_of(replies: Sequence[LocaliseReply]) -> list[LensView | None]:
    """From answers with inliers; None for those that are not localised, or whose lens was known."""
    views: list[LensView | None] = []
    frame: LocalFrame | None = None
    for reply in replies:
        utm, lens, inliers = reply.utm, reply.camera, reply.inlier_points
        if utm is None or lens is None or inliers is None or lens.source not in ("exif", "estimated"):
            views.append(None)
            continue
        where = np.array([utm.easting, utm.northing, utm.height])
        frame = frame or LocalFrame.from_utm(utm.easting, utm.northing, utm.height, utm.epsg)
        center = frame.enu_from_utm(where, utm.epsg)
        rotation = matrix_from_quaternion(utm.cam_from_utm_xyzw) @ frame.grid_from_enu(center, utm.epsg)
        views.append(
            LensView(
                pixels=np.array(inliers.pixels, dtype=np.float64).reshape(-1, 2),
                points=frame.enu_from_utm(np.array(inliers.utm, dtype=np.float64).reshape(-1, 3), utm.epsg),
                cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
                camera=Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params),
            )
        )
    return views


def lenses_of_cameras(
    keys: Sequence[str], views: Sequence[LensView | None]
) -> tuple[dict[str, SharedLens], list[CameraRequest | None]]:
    """The lens of each camera whose photos agree on one, and what each photo (n) is to be asked with.

    A photo that contradicts its camera's lens, or whose lens is known already, is asked with none.

    Args:
        keys: (n) of the photos' cameras. views: (n) see `views_of`.
    """
    rows: dict[str, list[int]] = {}
    for row, (key, view) in enumerate(zip(keys, views, strict=True)):
        if view is not None:
            rows.setdefault(key, []).append(row)
    lenses: dict[str, SharedLens] = {}
    asked_with: list[CameraRequest | None] = [None] * len(views)
    for key, own in rows.items():
        lens = shared_lens([view for view in (views[row] for row in own) if view is not None])
        if lens is None:
            continue
        lenses[key] = lens
        for row, agrees in zip(own, lens.agree, strict=True):
            asked_with[row] = lens.as_request() if agrees else None
    return lenses, asked_with


def shared_lens(
    views: Sequence[LensView],
    priors: LensPriors | None = None,
    pose: PoseOptions | None = None,
    options: SharedLensOptions | None = None,
) -> SharedLens | None:
    """The lens that most views agree on, without those that do not; None where too few are left.

    Args:
        views: of pictures of one size; any camera of OPENCV's or SIMPLE_RADIAL's model.
    """
    priors, pose, options = priors or LensPriors(), pose or PoseOptions(), options or SharedLensOptions()
    agree = np.ones(len(views), dtype=np.bool_)
    excess = np.full(len(views), np.inf)
    if len(views) < options.least_photos:
        return None
    first = views[0].camera
    # Where a photo's own lens lies among the priors does not matter: all of them outweigh these by far.
    focal_px = float(np.median([v.camera.focal_px for v in views]))
    prior = priors.around(first, focal_px, priors.unknown_focal_rel)
    noise_px = 0.25 * pose.tolerance_rel * max(first.width, first.height)
    problems = [_problem(view, prior, noise_px) for view in views]
    alone = np.array([_alone(p, v) for p, v in zip(problems, views, strict=True)])
    while agree.sum() >= options.least_photos:
        rows = [int(r) for r in np.flatnonzero(agree)]
        start = views[max(rows, key=lambda r: len(views[r].pixels))].camera
        joint = _Joint([problems[r] for r in rows], prior)
        poses, camera = joint.minimised([views[r].cam_from_local for r in rows], start)
        for r, found in zip(rows, poses, strict=True):
            excess[r] = problems[r].cost_of_pixels(found, camera) - alone[r]
        worst = max(rows, key=lambda r: excess[r])
        if excess[worst] <= options.max_excess:
            return SharedLens(
                camera=camera,
                sigmas=_sigmas(camera, joint.covariance(poses, camera)),
                agree=agree,
                excess=excess,
            )
        agree[worst] = False
    return None


def _problem(view: LensView, prior: LensPrior, noise_px: float) -> LensProblem:
    noise = measured_noise_px(view.pixels, view.points, view.cam_from_local, view.camera, noise_px)
    return LensProblem(
        pixels=view.pixels, points=view.points, noise_px=noise_px, trust=(noise_px / noise) ** 2, prior=prior
    )


def _alone(problem: LensProblem, view: LensView) -> float:
    """What a photo's pixels cost with a lens of its own."""
    own = calibrate(
        view.pixels, view.points, view.cam_from_local, view.camera, problem.prior, problem.noise_px
    )
    return problem.cost_of_pixels(own.cam_from_local, own.camera)


class _Joint:
    """All photos' pixels, and one lens."""

    def __init__(self, problems: Sequence[LensProblem], prior: LensPrior) -> None:
        self._problems, self._prior = problems, prior

    def minimised(self, poses: Sequence[Rigid3], camera: Camera) -> tuple[list[Rigid3], Camera]:
        """Levenberg-Marquardt."""
        found, damping = list(poses), 1e-4
        cost = self._cost(found, camera)
        for _ in range(50):
            systems = self._systems(found, camera)
            before = cost
            while damping < 1e6:
                steps, lens = self._step(systems, camera, damping)
                tried = [pose_step(p, s) for p, s in zip(found, steps, strict=True)]
                bent = lens_step(camera, lens)
                moved = self._cost(tried, bent)
                if moved < cost:
                    found, camera, cost = tried, bent, moved
                    damping = max(0.3 * damping, 1e-10)
                    break
                damping *= 10.0
            if before - cost < 1e-9 * before:
                break
        return found, camera

    def covariance(self, poses: Sequence[Rigid3], camera: Camera) -> FloatArray:
        """Of the lens, in the order of `lens_of`; the poses marginalised."""
        information = np.diag(self._prior.information)
        for system in self._systems(poses, camera):
            information = information + _without_pose(system, 0.0)[0]
        return covariance_from_information(information)

    def _cost(self, poses: Sequence[Rigid3], camera: Camera) -> float:
        pixels = (p.cost_of_pixels(pose, camera) for p, pose in zip(self._problems, poses, strict=True))
        return sum(pixels) + prior_cost(self._prior, camera)

    def _systems(self, poses: Sequence[Rigid3], camera: Camera) -> list[NormalEquations]:
        return [p.linearise_pixels(pose, camera) for p, pose in zip(self._problems, poses, strict=True)]

    def _step(
        self, systems: Sequence[NormalEquations], camera: Camera, damping: float
    ) -> tuple[list[FloatArray], FloatArray]:
        information = np.diag(self._prior.information)
        gradient = (self._prior.mean - lens_of(camera)) * self._prior.information
        for system in systems:
            of_lens, by_lens = _without_pose(system, damping)
            information, gradient = information + of_lens, gradient + by_lens
        information = information + damping * np.diag(np.diag(information))
        lens: FloatArray = np.linalg.solve(information, gradient).astype(np.float64)
        steps = [
            np.asarray(np.linalg.solve(_damped(s, damping), s.gradient[:6] - s.information[:6, 6:] @ lens))
            for s in systems
        ]
        return steps, lens


def _damped(system: NormalEquations, damping: float) -> FloatArray:
    # The floor keeps the matrix regular where no point says anything of a parameter.
    own = system.information[:6, :6]
    return np.asarray(own + np.diag(np.maximum(damping * np.diag(own), 1e-9)))


def _without_pose(system: NormalEquations, damping: float) -> tuple[FloatArray, FloatArray]:
    """What a photo says of the lens, whatever its pose: information and gradient."""
    across = system.information[:6, 6:]
    solved = np.linalg.solve(_damped(system, damping), np.column_stack([across, system.gradient[:6]]))
    return (
        np.asarray(system.information[6:, 6:] - across.T @ solved[:, :-1]),
        np.asarray(system.gradient[6:] - across.T @ solved[:, -1]),
    )


def _sigmas(camera: Camera, covariance: FloatArray) -> FloatArray:
    """Of OPENCV's parameters, from the covariance of `lens_of`."""
    lens = lens_of(camera)
    by_lens = np.zeros((8, 8))
    by_lens[[0, 2, 3, 4, 5, 6, 7], [0, 1, 2, 3, 5, 6, 7]] = 1.0
    by_lens[1, [0, 4]] = 1.0 + lens[4], lens[0]
    return np.asarray(np.sqrt(np.diag(by_lens @ covariance @ by_lens.T)))
