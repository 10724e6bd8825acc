"""The pose that picked points give, weighed as evidence: least squares, chi-square, leave-one-out.

A person's picks are measurements with a known deviation. Their residuals therefore tell by chi-square whether
they can all be right (Baarda's data snooping where they cannot): a set of picks is believed if the sum of its
squared normalised residuals is likely for its redundancy, and a pick is called wrong if the others fit
without it and no other pick's removal does nearly as well.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import poselib
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.localise.jacobians import pixel_jacobians
from reloc.localise.self_calibration import pose_step

_STARTS = 60  # triples that P3P is asked for
_REFINED = 6  # of their poses, best first, that are refined
_ROUNDS = 15


_CHANCE = 0.001  # rate at which right picks are called contradictory: one set in a thousand
# By how much the squared residuals must grow, in chi-square of one pick, until another explanation is out of
# the question: one in a hundred.
_APART = float(chi2.ppf(0.99, 2))
_MAX_WRONG = 2  # so many wrong picks are looked for


_SIGMA_PX_REL = 0.00075  # how well a person marks a point, over the longer side: 3 pixels in 4000
_SIGMA_M = 0.2  # how well a person reads a point off the scan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickFit:
    """What picks say about a camera.

    Attributes:
        cam_from_local: the pose. camera: the lens, its focal length estimated with the pose under its prior.
        covariance: (6, 6), rotation about the local axes (rad) before displacement of the centre (m), the
            focal length marginalised.
        residuals_px: (n, 2) seen minus predicted, of all picks.
        normalised: (n,) how many standard deviations each pick lies from where the others predict it.
        chi_square, redundancy: of the picks that are believed.
        wrong: picks that contradict the others.
        doubtful: picks of which one is wrong, but they do not tell which; empty where all is clear.
        consistent: the believed picks agree with each other.
        other_pose: another pose explains the picks as well.
    """

    cam_from_local: Rigid3
    camera: Camera
    covariance: FloatArray
    residuals_px: FloatArray
    normalised: FloatArray
    chi_square: float
    redundancy: int
    wrong: tuple[int, ...]
    doubtful: tuple[int, ...]
    consistent: bool
    other_pose: bool

    @property
    def distances_px(self) -> FloatArray:
        """(n,) lengths of the residuals."""
        return np.asarray(np.hypot(*self.residuals_px.T))

    @property
    def believed(self) -> list[int]:
        """Rows of the picks that carry the pose."""
        return [i for i in range(len(self.residuals_px)) if i not in self.wrong]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _State:
    """A pose and a lens with the cost of some picks."""

    pose: Rigid3
    camera: Camera
    cost: float
    information: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Problem:
    """Picks and what is known of the lens."""

    pixels: FloatArray
    points: FloatArray
    camera: Camera
    focal_sigma_rel: float

    @property
    def sigma_px(self) -> float:
        return _SIGMA_PX_REL * max(self.camera.width, self.camera.height)

    def noise(self, by_point: FloatArray) -> FloatArray:
        return self.sigma_px**2 * np.eye(2) + _SIGMA_M**2 * by_point @ by_point.transpose(0, 2, 1)

    def linear(
        self, pose: Rigid3, camera: Camera, rows: list[int]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residuals (k, 2), derivatives by pose and log focal length (k, 2, 7), inverse noise (k, 2, 2)."""
        points = self.points[rows]
        residual = self.pixels[rows] - camera.project(pose.act(points))
        by_point, by_pose = pixel_jacobians(camera, pose, points)
        step = 1e-4
        longer, shorter = (camera.with_focal(camera.focal_px * (1 + s)) for s in (step, -step))
        by_focal = (longer.project(pose.act(points)) - shorter.project(pose.act(points))) / (2 * step)
        jacobian = np.concatenate([by_pose, by_focal[:, :, None]], axis=2)
        return (
            np.asarray(residual),
            np.asarray(jacobian, dtype=np.float64),
            np.asarray(np.linalg.inv(self.noise(by_point)), dtype=np.float64),
        )

    def focal_off(self, camera: Camera) -> float:
        return float(np.log(camera.focal_px / self.camera.focal_px))


def fit_picks(
    pixels: FloatArray,
    points: FloatArray,
    camera: Camera,
    focal_sigma_rel: float,
) -> PickFit | None:
    """The pose of four or more picks, or None where no pose has all of a triple in front of the camera.

    Args:
        pixels: (n, 2) full-size pixels. points: (n, 3) local frame, metres.
        camera: the lens; its focal length is a prior with `focal_sigma_rel`.
    """
    problem = _Problem(pixels=pixels, points=points, camera=camera, focal_sigma_rel=focal_sigma_rel)
    starts = _starts(problem)
    if not starts:
        return None
    rows = list(range(len(pixels)))
    choice = _explanation(problem, starts, rows)
    if choice is None:
        return None
    state, kept, doubtful, consistent = choice
    redundancy = 2 * len(kept) - 6
    return PickFit(
        cam_from_local=state.pose,
        camera=state.camera,
        covariance=np.asarray(np.linalg.pinv(state.information, hermitian=True)[:6, :6], dtype=np.float64),
        residuals_px=np.asarray(pixels - state.camera.project(state.pose.act(points))),
        normalised=_normalised(problem, state, kept),
        chi_square=state.cost,
        redundancy=redundancy,
        wrong=tuple(i for i in rows if i not in kept),
        doubtful=doubtful,
        consistent=consistent,
        other_pose=consistent and _another(problem, starts, kept, state),
    )


def _explanation(
    problem: _Problem, starts: list[tuple[Rigid3, Camera]], rows: list[int]
) -> tuple[_State, list[int], tuple[int, ...], bool] | None:
    """State, picks believed, picks in doubt, and whether they agree: the fewest wrong picks that explain."""
    everything = _best(problem, starts, rows)
    # Of n picks, k wrong ones are told from right ones if 4 + k of these agree.
    for count in range(min(_MAX_WRONG, (len(rows) - 4) // 2) + 1):
        tries = []
        for left_out in combinations(_suspects(problem, starts, rows, count), count):
            kept = [i for i in rows if i not in left_out]
            state = everything if not left_out else _best(problem, starts, kept)
            if state is not None and state.cost <= chi2.ppf(1 - _CHANCE, 2 * len(kept) - 6):
                tries.append((state.cost, left_out, kept, state))
        if tries:
            tries.sort(key=lambda t: t[0])
            rivals = [t for t in tries if t[0] < tries[0][0] + _APART] if count else []
            doubtful = sorted({i for t in rivals for i in t[1]}) if len(rivals) > 1 else []
            _, _, kept, state = tries[0]
            return state, kept, tuple(doubtful), True
    return None if everything is None else (everything, rows, tuple(rows), False)


def _suspects(
    problem: _Problem, starts: list[tuple[Rigid3, Camera]], rows: list[int], count: int
) -> list[int]:
    """Picks that may be among several wrong ones: the worst under the pose that most agree with."""
    if count < 2:
        return rows
    pose, camera = starts[0]
    off = np.hypot(*(camera.project(pose.act(problem.points)) - problem.pixels).T)
    worst = np.argsort(-np.nan_to_num(off, nan=np.inf))[: count + 2]
    return sorted(int(i) for i in worst)


def _starts(problem: _Problem) -> list[tuple[Rigid3, Camera]]:
    """Poses by P3P of triples, those that most picks agree with first."""
    factors = (1.0,) if problem.focal_sigma_rel < 0.1 else (1.0, 0.75, 1.35)
    generator = np.random.default_rng(0)
    triples = list(combinations(range(len(problem.pixels)), 3))
    if len(triples) > _STARTS:
        triples = [triples[i] for i in generator.choice(len(triples), _STARTS, replace=False)]
    found: list[tuple[float, Rigid3, Camera]] = []
    for factor in factors:
        camera = problem.camera.with_focal(factor * problem.camera.focal_px)
        rays = np.column_stack([camera.unproject(problem.pixels), np.ones(len(problem.pixels))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for triple in map(list, triples):
            for solution in poselib.p3p(rays[triple], problem.points[triple]):
                if not np.isfinite(solution.Rt).all():
                    continue
                pose = Rigid3.from_matrix(np.vstack([solution.Rt, [0, 0, 0, 1]]))
                found.append((_rough_cost(problem, pose, camera), pose, camera))
    found = [f for f in found if np.isfinite(f[0])]
    found.sort(key=lambda f: f[0])
    return [(pose, camera) for _, pose, camera in found]


def _rough_cost(problem: _Problem, pose: Rigid3, camera: Camera) -> float:
    """Truncated, so that a wrong pick counts for no more than a bad one."""
    in_camera = pose.act(problem.points)
    if (in_camera[:, 2] <= 0).sum() > _MAX_WRONG:
        return float("inf")
    off = np.nan_to_num(camera.project(in_camera) - problem.pixels, nan=1e6)
    sigma = np.hypot(
        problem.sigma_px,
        _SIGMA_M * camera.focal_px / np.maximum(in_camera[:, 2], 1e-3),
    )
    return float(np.minimum((off**2).sum(axis=1) / (3 * sigma) ** 2, 25.0).sum())


def _best(problem: _Problem, starts: list[tuple[Rigid3, Camera]], rows: list[int]) -> _State | None:
    """Refined from the start that suits these picks best."""
    chosen = replace(problem, pixels=problem.pixels[rows], points=problem.points[rows])
    return _refined(
        problem, *min(starts[: 2 * _REFINED], key=lambda start: _rough_cost(chosen, *start)), rows
    )


def _refined(problem: _Problem, pose: Rigid3, camera: Camera, rows: list[int]) -> _State | None:
    """Levenberg-Marquardt over pose and focal length; None where picks fall behind the camera."""
    damping, state = 1e-3, _state(problem, pose, camera, rows)
    if state is None:
        return None
    for _ in range(_ROUNDS):
        residual, jacobian, weight = problem.linear(state.pose, state.camera, rows)
        gradient = np.einsum("nij,nik,nk->j", jacobian, weight, residual)
        gradient[6] -= problem.focal_off(state.camera) / problem.focal_sigma_rel**2
        step = np.linalg.lstsq(
            state.information + damping * np.diag(np.diag(state.information)), gradient, rcond=None
        )[0]
        new_pose = pose_step(state.pose, step[:6])
        new_camera = problem.camera.with_focal(
            state.camera.focal_px * float(np.exp(np.clip(step[6], -0.5, 0.5)))
        )
        new = _state(problem, new_pose, new_camera, rows)
        if new is None or new.cost > state.cost:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        settled, state, damping = state.cost - new.cost < 1e-4, new, damping * 0.1
        if settled:
            break
    return state


def _state(problem: _Problem, pose: Rigid3, camera: Camera, rows: list[int]) -> _State | None:
    if (pose.act(problem.points[rows])[:, 2] <= 0).any():
        return None
    residual, jacobian, weight = problem.linear(pose, camera, rows)
    if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
        return None
    information = np.einsum("nij,nik,nkl->jl", jacobian, weight, jacobian)
    information[6, 6] += 1.0 / problem.focal_sigma_rel**2
    cost = float(np.einsum("ni,nij,nj->", residual, weight, residual))
    cost += (problem.focal_off(camera) / problem.focal_sigma_rel) ** 2
    return _State(pose=pose, camera=camera, cost=cost, information=information)


def _normalised(problem: _Problem, state: _State, kept: list[int]) -> FloatArray:
    """(n,) root of each pick's chi-square against the prediction of the believed picks but itself."""
    out = np.full(len(problem.pixels), np.nan)
    for i in range(len(problem.pixels)):
        residual, jacobian, weight = problem.linear(state.pose, state.camera, [i])
        if not np.isfinite(residual).all():
            out[i] = np.inf
            continue
        information = state.information.copy()
        if i in kept:
            information -= jacobian[0].T @ weight[0] @ jacobian[0]
        spread = jacobian[0] @ np.linalg.pinv(information, hermitian=True) @ jacobian[0].T
        noise = np.linalg.inv(weight[0])
        # Of a pick that took part: what it had missed by had it not (its residual over its redundancy).
        missed = residual[0]
        if i in kept:
            own = np.linalg.pinv(state.information, hermitian=True)
            share = np.eye(2) - jacobian[0] @ own @ jacobian[0].T @ weight[0]
            missed = np.linalg.pinv(share) @ residual[0]
        out[i] = np.sqrt(max(float(missed @ np.linalg.pinv(noise + spread, hermitian=True) @ missed), 0.0))
    return out


def _another(problem: _Problem, starts: list[tuple[Rigid3, Camera]], kept: list[int], state: _State) -> bool:
    """Whether a pose that is clearly elsewhere explains the picks nearly as well."""
    limit = max(state.cost + _APART, 0.0)
    spread = np.linalg.pinv(state.information, hermitian=True)[:6, :6]
    far_m = 6.0 * float(np.sqrt(np.linalg.eigvalsh(spread[3:, 3:])[-1]))
    tried: list[Rigid3] = [state.pose]
    for pose, camera in starts[: 8 * _REFINED]:
        if min(float(np.linalg.norm(pose.center - t.center)) for t in tried) < max(far_m, 1.0):
            continue
        tried.append(pose)
        other = _refined(problem, pose, camera, kept)
        if other is not None and other.cost <= limit:
            apart = float(np.linalg.norm(other.pose.center - state.pose.center))
            if apart > max(far_m, 1.0):
                return True
        if len(tried) > _REFINED:
            break
    return False
