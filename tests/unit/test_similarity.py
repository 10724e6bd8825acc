"""Similarity between paired points: closed forms, outliers, and a covariance that covers its errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from ingest.register.structure.similarity import (
    Pairs,
    ransac_similarity,
    refine_similarity,
)

_TRUE = Sim3(scale=1.03, rotation=so3_exp([0.02, -0.03, 0.4]), translation=np.array([3.0, -8.0, 11.0]))


def _pairs(
    rng: np.random.Generator,
    count: int = 200,
    *,
    sigma: float = 0.05,
    frames: int = 1,
    frame_sigma: float = 0.0,
    cell_sigma: float = 0.0,
) -> Pairs:
    """Pairs of _TRUE; errors of their own, shared by a frame (a shift), and shared by 20 neighbours."""
    target = np.column_stack([rng.uniform(-40, 40, (count, 2)), rng.normal(0, 3, count)])
    frame_of = np.arange(count) % frames
    cell_of = np.arange(count) // 20
    by_frame = np.zeros((count, 3, 6))
    by_frame[:, :, 3:] = -np.eye(3)
    shift = rng.normal(0, frame_sigma, (frames, 3))
    noise = rng.normal(0, sigma, (count, 3)) + rng.normal(0, cell_sigma, (cell_of.max() + 1, 3))[cell_of]
    return Pairs(
        frame_of=frame_of,
        source=_TRUE.inverse().act(target),
        target=target + noise + shift[frame_of],
        covariance=np.tile(np.eye(3) * sigma**2, (count, 1, 1)),
        by_frame=by_frame,
        cell_of=cell_of,
        frame_covariance=np.tile(np.diag([1e-12] * 3 + [max(frame_sigma, 1e-6) ** 2] * 3), (frames, 1, 1)),
    )


def _error(sim: Sim3) -> FloatArray:
    return (_TRUE @ sim.inverse()).log()


@pytest.mark.parametrize("outliers", [200, 30, 0])
def test_ransac_finds_the_similarity_among_outliers(outliers: int) -> None:
    rng = np.random.default_rng(1)
    pairs = _pairs(rng, 300, sigma=0.02)
    target = pairs.target.copy()
    wrong = rng.permutation(300)[:outliers]
    target[wrong] += rng.normal(0, 20, (outliers, 3))
    found = ransac_similarity(pairs.source, target, np.full(300, 0.3))
    assert found is not None
    right = np.setdiff1d(np.arange(300), wrong)
    assert np.linalg.norm(found.act(pairs.source[right]) - pairs.target[right], axis=1).mean() < 0.3


def test_exact_pairs_give_the_exact_similarity() -> None:
    pairs = _pairs(np.random.default_rng(2), sigma=1e-9)
    pairs = replace(pairs, covariance=np.tile(np.eye(3) * 0.05**2, (len(pairs), 1, 1)))
    start = Sim3.exp([0.01, 0.01, 0.0, -0.02, 0.3, -0.2, 0.1]) @ _TRUE
    assert np.abs(_error(refine_similarity(start, pairs).target_from_source)).max() < 1e-6


def test_outliers_lose_their_weight() -> None:
    rng = np.random.default_rng(3)
    pairs = _pairs(rng, 300)
    target = pairs.target.copy()
    target[:60] += [0.0, 0.0, 2.0]
    fit = refine_similarity(_TRUE, replace(pairs, target=target))
    assert not fit.inliers[:60].any()
    assert fit.inliers[60:].mean() > 0.95
    assert np.abs(fit.target_from_source.act(pairs.source) - _TRUE.act(pairs.source)).max() < 0.05
    # Least squares over all pairs is where the outliers pull: the test would see a fit without weights.
    plain = similarity_closed_form(pairs.source, target)
    assert plain is not None
    assert np.abs(plain.act(pairs.source) - _TRUE.act(pairs.source)).max() > 0.2


@pytest.mark.parametrize(
    ("frames", "frame_sigma", "cell_sigma"), [(1, 0.0, 0.0), (1, 0.2, 0.0), (3, 0.2, 0.0), (3, 0.1, 0.08)]
)
def test_covariance_covers_the_errors(frames: int, frame_sigma: float, cell_sigma: float) -> None:
    """Squared Mahalanobis errors of 80 draws: no smaller share below chi-square's 90 % point than 80 %."""
    inside, total = 0, 0.0
    for seed in range(80):
        pairs = _pairs(
            np.random.default_rng(seed), frames=frames, frame_sigma=frame_sigma, cell_sigma=cell_sigma
        )
        fit = refine_similarity(_TRUE, pairs)
        error = _error(fit.target_from_source)
        squared = float(error @ np.linalg.solve(fit.covariance, error))
        inside += squared <= chi2.ppf(0.9, 7)
        total += squared / 7
    assert inside / 80 >= 0.8
    # And it does not hide behind exaggeration.
    assert total / 80 > 0.3


def test_a_frame_s_pose_error_does_not_average_out_over_its_pairs() -> None:
    few = refine_similarity(_TRUE, _pairs(np.random.default_rng(0), 200, frame_sigma=0.2))
    many = refine_similarity(_TRUE, _pairs(np.random.default_rng(0), 2000, frame_sigma=0.2))
    for fit in (few, many):
        assert np.sqrt(np.diag(fit.covariance)[4:]).min() >= 0.19


def test_a_poor_frame_does_not_outvote_a_good_one() -> None:
    """Frame 0 is off by half a metre, and says that it may be; frame 1 is good to a centimetre."""
    pairs = _pairs(np.random.default_rng(5), 300, frames=2)
    target = pairs.target.copy()
    target[pairs.frame_of == 0] += [0.5, 0.0, 0.0]
    covariance = np.stack([np.diag([1e-12] * 3 + [s**2] * 3) for s in (0.5, 0.01)])
    fit = refine_similarity(_TRUE, replace(pairs, target=target, frame_covariance=covariance))
    assert np.abs(fit.target_from_source.act(pairs.source) - _TRUE.act(pairs.source)).mean() < 0.03
