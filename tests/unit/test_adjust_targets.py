"""Marks and targets in the adjustment: what they place, and the statistics that find a wrong one."""

from dataclasses import replace

import numpy as np

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, Marks, PointPriors, Targets, Terms, lens_prior
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.precision import linearise
from tests.support.adjusted_block import TRUE, WIDTHS, adjusted_block


def test_a_photo_that_sees_marks_alone_is_placed_by_them() -> None:
    """COLMAP makes no parameters of a photo without points; its covariance is that of a resection."""
    block = adjusted_block(noise_px=0.0)
    rng = np.random.default_rng(3)
    xyz = block.xyz[np.unique(block.point_of[block.photo_of == 2])]
    true = block.cam_from_block[2]
    xy = TRUE.project(true.act(xyz))
    others = block.photo_of != 2
    poses = list(block.cam_from_block)
    poses[2] = Rigid3.exp(rng.normal((0, 0, 0, 0, 0, -2.0), 0.01)) @ true
    block = replace(
        block,
        cam_from_block=tuple(poses),
        point_of=block.point_of[others],
        photo_of=block.photo_of[others],
        xy=block.xy[others],
    )
    marks = Marks(xyz=xyz, photo_of=np.full(len(xyz), 2), xy=xy, sigma_px=0.5)
    terms = Terms(keypoint_px=0.5, lenses=(None,), marks=marks, held_photos=(0, 1))
    problem = Problem(replace(block, cameras=(TRUE,)), terms)
    problem.solve(50, 1e-14)
    found = problem.block()
    assert np.abs((found.cam_from_block[2] @ true.inverse()).log()).max() < 1e-6
    by_pose = linearise(
        [TRUE], np.zeros(1, np.int64), [true], xyz, np.arange(len(xyz)), 0 * marks.photo_of, xy
    )
    rows = by_pose.by_pose.reshape(-1, 6) / 0.5
    np.testing.assert_allclose(
        problem.marginals().pose(2), np.linalg.inv(rows.T @ rows), rtol=1e-3, atol=1e-9
    )


def _with_targets(rng: np.random.Generator, without: int | None = None) -> tuple[Block, Terms, FloatArray]:
    """A block whose first six points are marked in three photos each and surveyed, but for one perhaps."""
    block = adjusted_block(points=80, noise_px=0.3)
    photo_of, point_of = (a.ravel() for a in np.meshgrid(np.arange(3), np.arange(6)))
    seen = [TRUE.project(block.cam_from_block[k].act(block.xyz[:6])) for k in range(3)]
    xy = np.array(seen)[photo_of, point_of] + rng.normal(0, 1.0, (18, 2))
    surveyed = block.xyz[:6] + rng.normal(0, 0.05, (6, 3))
    kept = np.array([i for i in range(6) if i != without])
    targets = Targets(
        point_of=len(block.xyz) + point_of,
        photo_of=photo_of,
        xy=xy,
        sigma_px=1.0,
        survey=PointPriors(
            point_of=len(block.xyz) + kept,
            xyz=surveyed[kept],
            covariance=np.tile(np.eye(3) * 0.05**2, (len(kept), 1, 1)),
        ),
    )
    terms = Terms(keypoint_px=0.3, lenses=(lens_prior(TRUE, WIDTHS),), targets=targets)
    start = block.xyz[:6] + rng.normal(0, 0.1, (6, 3))
    return replace(block, xyz=np.concatenate([block.xyz, start])), terms, surveyed


def test_a_residual_says_what_it_would_be_without_its_observation() -> None:
    block, terms, surveyed = _with_targets(np.random.default_rng(3))
    problem = Problem(block, terms)
    problem.solve(100, 1e-14, 1e9)
    found = problem.target_marginals()
    # Of 18 marks of two and 6 points of three coordinates, less those points, a similarity and the lens.
    redundancy = np.trace(found.marks.covariance, axis1=1, axis2=2).sum()
    redundancy += np.trace(found.survey.covariance, axis1=1, axis2=2).sum()
    assert 54 - 18 - 7 - 8 < redundancy < 54 - 18 - 7 + 0.1
    told = found.survey.of(np.ones((6, 3), bool)).left_out(np.arange(6, 9))[0] * 0.05
    assert np.linalg.norm(told) > np.linalg.norm(found.survey.residual[2] * 0.05)
    block, terms, _ = _with_targets(np.random.default_rng(3), without=2)
    problem = Problem(block, terms)
    problem.solve(100, 1e-14, 1e9)
    again = problem.block().xyz[80 + 2] - surveyed[2]
    np.testing.assert_allclose(told, again, atol=0.003)
    spread = np.sqrt(np.diag(problem.target_marginals().point[2]))
    assert (np.abs(problem.block().xyz[82] - block.xyz[2]) < 4 * spread).all()


def test_a_wrong_mark_has_the_largest_statistic() -> None:
    block, terms, _ = _with_targets(np.random.default_rng(5))
    assert terms.targets is not None
    xy = terms.targets.xy.copy()
    xy[7] += [9.0, -12.0]
    problem = Problem(block, replace(terms, targets=replace(terms.targets, xy=xy)))
    problem.solve(100, 1e-14, 1e9)
    marks = problem.target_marginals().marks
    single = marks.of(np.ones((18, 2), bool))
    alone = [single.left_out(2 * k + np.arange(2))[0] for k in range(18)]
    assert int(np.argmax([a @ v for a, v in zip(alone, marks.residual, strict=True)])) == 7
    np.testing.assert_allclose(alone[7], [-9.0, 12.0], atol=5.0)
    # Without it the others fit each other: a chi-square of as many degrees as their redundancy.
    others = single.left_out(14 + np.arange(2))[1]
    assert (others.residual**2).sum() < 2.0 * np.trace(others.together)
    assert (marks.residual**2).sum() > 4.0 * np.trace(marks.together)
