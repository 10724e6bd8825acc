"""A similarity from marked control points, robust against wrong marks and wrong coordinates.

A wrong mark spoils some of a point's hypotheses but not all, a wrong coordinate all of them. Least trimmed
squares (Rousseeuw, 1984) over samples of hypotheses finds the similarity that most points agree on. Where
heights are unknown only horizontal distances count; tilt and height come from elsewhere (`Vertical`).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.adjust.terms import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import rotation_to_up, so3_exp
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from ingest.register.control.marks import Control, intersect, on_ground, shown

_MOST_PAIRS = 45  # of one point's marks: all of ten
# By the median length of a normal vector in the plane and in space.
_SIGMA_OF_MEDIAN = {2: 1.0 / 1.1774, 3: 1.0 / 1.5382}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Vertical:
    """What is known of tilt and height besides the control points.

    Attributes:
        up_block: (3,) unit vector, the vertical in the block's frame.
        tilt_covariance: (2, 2) square radians, of the east and north components of what it becomes.
        anchor_block: (3,) a place in the block's frame.
        anchor_up_m: its height in the local frame; sigma_up_m: standard deviation.
        source: where all this is from, for people.
    """

    up_block: FloatArray
    tilt_covariance: FloatArray
    anchor_block: FloatArray
    anchor_up_m: float
    sigma_up_m: float
    source: str

    def moved(self, target_from_block: Sim3) -> "Vertical":
        """The same of a block that has moved."""
        return replace(
            self,
            up_block=target_from_block.rotation @ self.up_block,
            anchor_block=target_from_block.act(self.anchor_block),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hypothesis:
    """A place (3,) of a point in the block, and the rows of the marks that say so."""

    point: int
    xyz: FloatArray
    marks: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlFit:
    """The similarity that most points agree on.

    Attributes:
        local_from_block: the similarity.
        chosen: of each point that has hypotheses. inliers: whether it takes part.
        sigma_m: robust standard deviation of a coordinate.
    """

    local_from_block: Sim3
    chosen: tuple[Hypothesis, ...]
    inliers: NDArray[np.bool_]
    sigma_m: float


# Marks further from the common intersection disagree. A person marks to one to three pixels, a block may be
# bent by a few; wrong targets are tens to hundreds off.
_MAX_MARK_ERROR_PX = 12.0
_OUTLIER_SIGMAS = 3.5  # points further out are left out; 3.5 keeps 99.8 % of honest ones in the plane
_MIN_SIGMA_M = 0.02  # survey and marks are not better than that, so smaller residuals never make outliers
_ROUNDS = 6  # of choosing and fitting; two or three settle
_SAMPLES = 1500  # of hypotheses
_SEED = 0  # of the samples


def hypotheses(block: Block, control: Control) -> list[Hypothesis]:
    """Every place that the marks of a point, or some of them, point to."""
    found: list[Hypothesis] = []
    for point in range(len(control.names)):
        rows = control.marks_of(point)
        places: dict[tuple[int, ...], FloatArray] = {}
        for pair in itertools.islice(itertools.combinations(rows, 2), _MOST_PAIRS):
            consensus = _consensus(block, control, rows, pair)
            if consensus is not None:
                marks, xyz = consensus
                places.setdefault(marks, xyz)
        for row in rows.tolist():
            ground = on_ground(block, int(control.photo_of[row]), control.xy[row])
            if ground is not None:
                places[(row,)] = ground
        found += [Hypothesis(point=point, xyz=xyz, marks=marks) for marks, xyz in places.items()]
    return found


def _consensus(
    block: Block, control: Control, rows: NDArray[np.int64], pair: Sequence[int]
) -> tuple[tuple[int, ...], FloatArray] | None:
    """All marks that agree with a pair, and their intersection; None where the pair does not agree itself."""
    xyz = intersect(block, control, np.array(pair))
    if xyz is None:
        return None
    errors = np.linalg.norm(shown(block, control.photo_of[rows], xyz) - control.xy[rows], axis=1)
    agreeing = rows[errors <= _MAX_MARK_ERROR_PX]  # not behind a camera, where it is NaN
    if not set(pair) <= set(agreeing.tolist()):
        return None
    of_all = intersect(block, control, agreeing)
    return None if of_all is None else (tuple(agreeing.tolist()), of_all)


def fit_similarity(
    found: Sequence[Hypothesis], surveyed: FloatArray, vertical: Vertical | None
) -> ControlFit | None:
    """The similarity that most points agree on, or None where no sample gives one.

    Args:
        surveyed: (n, 3) local frame, up NaN where unknown.
        vertical: None where the surveyed heights say which way is up.
    """
    xyz = np.array([h.xyz for h in found])
    usable, point = np.unique([h.point for h in found], return_inverse=True)
    surveyed = surveyed[usable]
    sim = _least_trimmed(xyz, point, surveyed, vertical)
    if sim is None:
        return None
    for _ in range(_ROUNDS):
        lengths = _distances(sim, xyz, surveyed[point])
        sigma = _sigma(_per_point(lengths, point, len(surveyed)), surveyed, vertical)
        chosen = _choose(found, point, lengths, _OUTLIER_SIGMAS * sigma)
        inliers = lengths[chosen] <= _OUTLIER_SIGMAS * sigma
        sim = _similarity(xyz[chosen][inliers], surveyed[inliers], vertical) or sim
    return ControlFit(
        local_from_block=sim, inliers=inliers, chosen=tuple(found[int(i)] for i in chosen), sigma_m=sigma
    )


def _distances(sim: Sim3, xyz: FloatArray, surveyed: FloatArray) -> FloatArray:
    """(n,) of placed from surveyed points, in plan where a height is unknown."""
    return np.asarray(np.linalg.norm(np.nan_to_num(surveyed - sim.act(xyz)), axis=1))


def _per_point(lengths: FloatArray, point: NDArray[np.int64], count: int) -> FloatArray:
    """Smallest length of each point's hypotheses (count,)."""
    best = np.full(count, np.inf)
    np.minimum.at(best, point, lengths)
    return best


def _least_trimmed(
    xyz: FloatArray, point: NDArray[np.int64], surveyed: FloatArray, vertical: Vertical | None
) -> Sim3 | None:
    """Of similarities through few hypotheses, the one whose better half of points fits best."""
    size = 3 if vertical is None else 2
    usable = np.flatnonzero(np.isfinite(surveyed[point, 2])) if vertical is None else np.arange(len(xyz))
    count = len(np.unique(point))
    kept = (count + size + 1) // 2

    def cost(sim: Sim3) -> float:
        lengths = _per_point(_distances(sim, xyz, surveyed[point]), point, len(surveyed))
        return float((np.sort(lengths)[:kept] ** 2).sum())

    samples = _samples(usable, point, size)
    sims = (_similarity(xyz[rows], surveyed[point[rows]], vertical) for rows in samples)
    return min((sim for sim in sims if sim is not None), key=cost, default=None)


def _samples(usable: NDArray[np.int64], point: NDArray[np.int64], size: int) -> list[NDArray[np.int64]]:
    """Random sets of hypotheses of different points."""
    generator = np.random.default_rng(_SEED)
    names = np.unique(point[usable])
    if len(names) < size:
        return []
    samples = []
    for _ in range(_SAMPLES):
        chosen = generator.choice(names, size, replace=False)
        samples.append(np.array([generator.choice(usable[point[usable] == p]) for p in chosen]))
    return samples


def _similarity(xyz: FloatArray, surveyed: FloatArray, vertical: Vertical | None) -> Sim3 | None:
    """The similarity of points (n, 3) by least squares, where a vertical is given the best that keeps it.

    None where the points coincide.
    """
    if vertical is None:
        known = np.isfinite(surveyed[:, 2])
        return similarity_closed_form(xyz[known], surveyed[known])
    level = rotation_to_up(vertical.up_block)
    source, target = (xyz @ level.T)[:, :2] @ [1, 1j], surveyed[:, :2] @ [1, 1j]
    around, wanted = source - source.mean(), target - target.mean()
    if np.abs(around).max() < 1e-12 or np.abs(wanted).max() < 1e-6:
        return None
    turn = np.vdot(around, wanted) / np.vdot(around, around)
    rotation = so3_exp([0.0, 0.0, np.angle(turn)]) @ level
    scale = float(abs(turn))
    shift = target.mean() - turn * source.mean()
    up = vertical.anchor_up_m - scale * (rotation @ vertical.anchor_block)[2]
    return Sim3(scale=scale, rotation=rotation, translation=np.array([shift.real, shift.imag, up]))


def _sigma(lengths: FloatArray, surveyed: FloatArray, vertical: Vertical | None) -> float:
    """Robust standard deviation of one coordinate, with the degrees of freedom of the fit."""
    axes = 3 if np.isfinite(surveyed[:, 2]).all() else 2
    equations = int(np.isfinite(surveyed).sum())
    parameters = 7 if vertical is None else 4
    freedom = max(equations - parameters, 1)
    spread = float(np.median(lengths)) * _SIGMA_OF_MEDIAN[axes] * (equations / freedom) ** 0.5
    return float(max(spread, _MIN_SIGMA_M))


def _choose(
    found: Sequence[Hypothesis], point: NDArray[np.int64], lengths: FloatArray, limit_m: float
) -> NDArray[np.int64]:
    """For each point the hypothesis of most marks within the limit, the nearest if none is."""
    near = lengths <= limit_m
    marks = np.array([len(hypothesis.marks) for hypothesis in found])
    order = np.lexsort((lengths, np.where(near, -marks, 0), ~near, point))
    return order[np.unique(point[order], return_index=True)[1]]
