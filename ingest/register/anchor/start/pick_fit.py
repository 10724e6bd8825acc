"""The pose that picked points give, weighed as evidence: adjustment, chi-square, leave-one-out.

A set of picks is believed if the sum of its squared whitened residuals is likely for its redundancy, by
chi-square, and a pick is called wrong if the others fit without it and no other pick's removal does nearly as
well (Baarda's data snooping).
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import poselib
from scipy.stats import chi2

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, LensWidths, PointPriors, Targets, Terms, lens_prior
from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3

_STARTS = 60  # triples that P3P is asked for
_TRIED = 6  # of their poses, best first, that may be another explanation
_ADJUSTMENT = (50, 1e-9)  # steps, and relative change of the cost
# Sigmas of what is taken as known of a lens: all but its focal length.
_KNOWN_LENS = LensWidths(focal_rel=1.0, aspect_rel=1e-5, center_rel=1e-5, radial=1e-5, tangential=1e-5)

_CHANCE = 0.001  # rate at which right picks are called contradictory: one set in a thousand
# By how much the squared residuals must grow, in chi-square of one pick, until another explanation is out of
# the question: one in a hundred.
_APART = float(chi2.ppf(0.99, 2))
_MAX_WRONG = 2  # so many wrong picks are looked for

_SIGMA_PX_REL = 0.00075  # how well a person marks a point, over the longer side: 3 pixels in 4000
_SIGMA_M = 0.2  # how well a person reads a point off the scan

_Start = tuple[Rigid3, Camera]  # to begin with


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickFit:
    """What picks say about a camera.

    Attributes:
        cam_from_local: the pose. camera: the lens, its focal length estimated with the pose under its prior.
        covariance: (6, 6) of the left perturbation of the pose, rad and metres, the focal length
            marginalised.
        residuals_px: (n, 2) seen minus predicted, of all picks.
        normalised: (n,) how many standard deviations each pick lies from where the others predict it; NaN
            of those that are wrong.
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
class _Fitted:
    """A pose and a lens adjusted to some picks, with the sum of the squared whitened residuals."""

    pose: Rigid3
    camera: Camera
    cost: float
    problem: Problem


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Picked:
    """Picks and what is known of the lens."""

    pixels: FloatArray
    points: FloatArray
    camera: Camera
    focal_sigma_rel: float

    @property
    def sigma_px(self) -> float:
        return _SIGMA_PX_REL * max(self.camera.width, self.camera.height)

    def rough_cost(self, start: _Start, rows: list[int]) -> float:
        """Truncated, so that a wrong pick counts for no more than a bad one."""
        pose, camera = start
        in_camera = pose.act(self.points[rows])
        if (in_camera[:, 2] <= 0).sum() > _MAX_WRONG:
            return float("inf")
        off = np.nan_to_num(camera.project(in_camera) - self.pixels[rows], nan=1e6)
        by_point = _SIGMA_M * camera.focal_px / np.maximum(in_camera[:, 2], 1e-3)
        sigma = np.hypot(self.sigma_px, by_point)
        return float(np.minimum((off**2).sum(axis=1) / (3 * sigma) ** 2, 25.0).sum())

    def fitted(self, start: _Start, rows: list[int]) -> _Fitted | None:
        """Adjusted to some picks; None where no pose has all of them in front of the camera."""
        numbers, none, xyz = np.arange(len(rows)), np.zeros(0, dtype=np.int64), self.points[rows]
        block = Block(
            names=("picked",),
            cameras=(start[1],),
            camera_of=np.zeros(1, dtype=np.int64),
            cam_from_block=(start[0],),
            xyz=xyz,
            point_of=none,
            photo_of=none,
            xy=np.zeros((0, 2)),
        )
        read_off = np.tile(_SIGMA_M**2 * np.eye(3), (len(rows), 1, 1))
        survey = PointPriors(point_of=numbers, xyz=xyz, covariance=read_off)
        targets = Targets(
            point_of=numbers,
            photo_of=np.zeros(len(rows), dtype=np.int64),
            xy=self.pixels[rows],
            sigma_px=self.sigma_px,
            survey=survey,
        )
        lens = replace(_KNOWN_LENS, focal_rel=self.focal_sigma_rel)
        known = lens_prior(self.camera, lens, robust=False)
        problem = Problem(block, Terms(keypoint_px=1.0, lenses=(known,), targets=targets))
        summary = problem.solve(*_ADJUSTMENT)
        try:
            found = problem.block()
        except InvalidValueError:  # no focal length above 0 suits these picks
            return None
        pose, camera = found.cam_from_block[0], found.cameras[0]
        if not summary.IsSolutionUsable() or (pose.act(self.points[rows])[:, 2] <= 0).any():
            return None
        return _Fitted(pose=pose, camera=camera, cost=2.0 * summary.final_cost, problem=problem)


def fit_picks(
    pixels: FloatArray, points: FloatArray, camera: Camera, focal_sigma_rel: float
) -> PickFit | None:
    """The pose of four or more picks, or None where no pose has all of a triple in front of the camera.

    Args:
        pixels: (n, 2) full-size pixels. points: (n, 3) local frame, metres.
        camera: the lens; its focal length is a prior with `focal_sigma_rel`.
    """
    picked = _Picked(pixels=pixels, points=points, camera=camera, focal_sigma_rel=focal_sigma_rel)
    starts = _starts(picked)
    rows = list(range(len(pixels)))
    choice = _explanation(picked, starts, rows) if starts else None
    if choice is None:
        return None
    fitted, kept, doubtful, consistent = choice
    marginals = fitted.problem.target_marginals()
    covariance = marginals.block.pose(0)
    marks = marginals.marks.of(np.ones((len(kept), 2), dtype=bool))
    normalised = np.full(len(pixels), np.nan)
    for k, row in enumerate(kept):
        own = 2 * k + np.arange(2)
        alone, _ = marks.left_out(own)
        normalised[row] = np.sqrt(max(float(alone @ marks.residual[own, 0]), 0.0))
    return PickFit(
        cam_from_local=fitted.pose,
        camera=fitted.camera,
        covariance=covariance,
        residuals_px=np.asarray(pixels - fitted.camera.project(fitted.pose.act(points))),
        normalised=normalised,
        wrong=tuple(i for i in rows if i not in kept),
        doubtful=doubtful,
        consistent=consistent,
        other_pose=consistent and _another(picked, starts, kept, fitted, covariance),
    )


def _explanation(
    picked: _Picked, starts: list[_Start], rows: list[int]
) -> tuple[_Fitted, list[int], tuple[int, ...], bool] | None:
    """Fit, picks believed, picks in doubt, and whether they agree: the fewest wrong picks that explain."""
    everything = _best(picked, starts, rows)
    # Of n picks, k wrong ones are told from right ones if 4 + k of these agree.
    for count in range(min(_MAX_WRONG, (len(rows) - 4) // 2) + 1):
        tries = []
        for left_out in combinations(_suspects(picked, starts, rows, count), count):
            kept = [i for i in rows if i not in left_out]
            fitted = everything if not left_out else _best(picked, starts, kept)
            if fitted is not None and fitted.cost <= chi2.ppf(1 - _CHANCE, 2 * len(kept) - 6):
                tries.append((fitted.cost, left_out, kept, fitted))
        if tries:
            tries.sort(key=lambda t: t[0])
            rivals = [t for t in tries if t[0] < tries[0][0] + _APART] if count else []
            doubtful = sorted({i for t in rivals for i in t[1]}) if len(rivals) > 1 else []
            _, _, kept, fitted = tries[0]
            return fitted, kept, tuple(doubtful), True
    return None if everything is None else (everything, rows, tuple(rows), False)


def _suspects(picked: _Picked, starts: list[_Start], rows: list[int], count: int) -> list[int]:
    """Picks that may be among several wrong ones: the worst under the pose that most agree with."""
    if count < 2:
        return rows
    pose, camera = starts[0]
    off = np.hypot(*(camera.project(pose.act(picked.points)) - picked.pixels).T)
    worst = np.argsort(-np.nan_to_num(off, nan=np.inf))[: count + 2]
    return sorted(int(i) for i in worst)


def _starts(picked: _Picked) -> list[_Start]:
    """Poses by P3P of triples, those that most picks agree with first."""
    factors = (1.0,) if picked.focal_sigma_rel < 0.1 else (1.0, 0.75, 1.35)
    generator = np.random.default_rng(0)
    rows = list(range(len(picked.pixels)))
    triples = list(combinations(rows, 3))
    if len(triples) > _STARTS:
        triples = [triples[i] for i in generator.choice(len(triples), _STARTS, replace=False)]
    found: list[tuple[float, _Start]] = []
    for factor in factors:
        camera = picked.camera.with_focal(factor * picked.camera.focal_px)
        rays = np.column_stack([camera.unproject(picked.pixels), np.ones(len(rows))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for triple in map(list, triples):
            for solution in poselib.p3p(rays[triple], picked.points[triple]):
                if np.isfinite(solution.Rt).all():
                    start = (Rigid3.from_matrix(np.vstack([solution.Rt, [0, 0, 0, 1]])), camera)
                    found.append((picked.rough_cost(start, rows), start))
    found.sort(key=lambda f: f[0])
    return [start for cost, start in found if np.isfinite(cost)]


def _best(picked: _Picked, starts: list[_Start], rows: list[int]) -> _Fitted | None:
    """Adjusted from the start that suits these picks best."""
    likely = starts[: 2 * _TRIED]
    return picked.fitted(min(likely, key=lambda start: picked.rough_cost(start, rows)), rows)


def _another(
    picked: _Picked, starts: list[_Start], kept: list[int], found: _Fitted, covariance: FloatArray
) -> bool:
    """Whether a pose that is clearly elsewhere explains the picks nearly as well."""
    far_m = max(6.0 * float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1])), 1.0)
    tried = [found.pose.center]
    for start in starts[: 8 * _TRIED]:
        center = start[0].center
        if min(float(np.linalg.norm(center - t)) for t in tried) < far_m:
            continue
        tried.append(center)
        other = picked.fitted(start, kept)
        if other is not None:
            apart = float(np.linalg.norm(other.pose.center - found.pose.center))
            if apart > far_m and other.cost <= found.cost + _APART:
                return True
        if len(tried) > _TRIED:
            break
    return False
