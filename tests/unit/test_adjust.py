"""The adjustment: it finds the minimum of what it says, and its covariances are those of what it finds."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.adjust.marginals import Marginals
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import (
    Block,
    CenterPriors,
    Marks,
    Orientations,
    PointPriors,
    Terms,
    lens_prior,
    whole_lens,
)
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.precision import linearise
from tests.support.adjusted_block import TRUE, WIDTHS, adjusted_block, adjusted_terms


def _cost(block: Block, terms: Terms) -> float:
    """The objective written out, independently of Ceres."""
    assert terms.marks is not None
    assert terms.points is not None
    assert terms.centers is not None
    lens = block.cameras[0]
    seen = [
        block.cam_from_block[p].act(block.xyz[i]) for i, p in zip(block.point_of, block.photo_of, strict=True)
    ]
    known = [
        block.cam_from_block[p].act(x) for x, p in zip(terms.marks.xyz, terms.marks.photo_of, strict=True)
    ]
    squared = [
        (((block.xy - lens.project(np.array(seen))) / terms.keypoint_px) ** 2).sum(axis=1),
        (((terms.marks.xy - lens.project(np.array(known))) / terms.marks.sigma_px) ** 2).sum(axis=1),
        _mahalanobis(block.xyz[terms.points.point_of] - terms.points.xyz, terms.points.covariance),
        _mahalanobis(block.centers()[terms.centers.photo_of] - terms.centers.xyz, terms.centers.covariance),
    ]
    prior = terms.lenses[0]
    assert prior is not None
    off = np.array(lens.params) - np.array(prior.mean.params)
    return sum(float(np.log1p(s).sum()) for s in squared) + float(
        off @ np.linalg.solve(prior.covariance, off)
    )


def _mahalanobis(off: FloatArray, covariance: FloatArray) -> FloatArray:
    return np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[:, :, None])[:, :, 0])


def test_no_direction_lowers_the_cost_of_what_is_found() -> None:
    block, rng = adjusted_block(noise_px=0.5), np.random.default_rng(1)
    terms = adjusted_terms(block, replace(TRUE, params=(1000.0, 1000.0, 600.0, 450.0, 0.0, 0.0, 0.0, 0.0)))
    problem = Problem(block, terms)
    problem.solve(50, 1e-12)
    found = problem.block()
    least = _cost(found, terms)
    assert least < _cost(block, terms)
    for attempt in range(30):
        step = rng.normal(0, 1, 3) * 1e-3
        moved, poses, params = found.xyz.copy(), list(found.cam_from_block), np.array(found.cameras[0].params)
        if attempt % 3 == 0:
            moved[rng.integers(len(moved))] += step
        elif attempt % 3 == 1:
            photo = int(rng.integers(8))
            poses[photo] = Rigid3.exp(np.concatenate([step * 1e-2, step])) @ poses[photo]
        else:
            params *= 1.0 + rng.normal(0, 1e-3, len(params))
        other = replace(
            found,
            xyz=moved,
            cam_from_block=tuple(poses),
            cameras=(replace(found.cameras[0], params=tuple(params)),),
        )
        assert _cost(other, terms) >= least


@pytest.mark.parametrize(("robust", "focal_px"), [(True, 1008.3), (False, 995.0)])
def test_a_prior_lets_go_unless_the_lens_is_known_for_certain(robust: bool, focal_px: float) -> None:
    """Known points say 1010 px; 990 px within 1 px were told, which a robust prior takes for a mistake."""
    block = adjusted_block(noise_px=0.5)
    told = replace(TRUE, params=(990.0, 989.5, *TRUE.params[2:]))
    terms = Terms(
        keypoint_px=0.5,
        lenses=(lens_prior(told, replace(WIDTHS, focal_rel=1e-3), robust=robust),),
        marks=Marks(xyz=block.xyz[block.point_of], photo_of=block.photo_of, xy=block.xy, sigma_px=0.5),
    )
    problem = Problem(block, terms)
    problem.solve(100, 1e-12)
    assert problem.block().cameras[0].focal_px == pytest.approx(focal_px, abs=1.0)


def test_the_whole_lens_is_found_through_a_plain_prior() -> None:
    block = adjusted_block(points=200, noise_px=0.2)
    terms = adjusted_terms(
        block, replace(TRUE, params=(1000.0, 1000.0, 600.0, 450.0, 0.0, 0.0, 0.0, 0.0)), 0.2
    )
    problem = Problem(block, terms)
    problem.solve(50, 1e-12)
    off = np.array(problem.block().cameras[0].params) - np.array(TRUE.params)
    sigma = np.sqrt(np.diag(problem.marginals().lens(0)))
    assert (np.abs(off) < 4 * sigma).all()
    assert np.abs(off[:4]).max() < 3.0


def test_an_adjustment_that_was_stopped_on_its_way_says_so(caplog: pytest.LogCaptureFixture) -> None:
    block = adjusted_block(points=200, noise_px=0.2)
    wrong = replace(block, cameras=(replace(TRUE, params=(1500.0, 1500.0, *TRUE.params[2:])),))
    problem = Problem(wrong, adjusted_terms(block, TRUE))
    with caplog.at_level("INFO", logger="featuredb.adjust"):
        problem.solve(2, 1e-12)
        assert "stopped on its way after 2 steps" in caplog.text
        caplog.clear()
        problem.solve(500, 1e-6)
        assert not caplog.text


def test_a_focal_length_that_is_far_off_loses_to_photos_that_know() -> None:
    """EXIF of a cropped photo: 30 % off, 15 of its sigmas."""
    block = adjusted_block(points=200, noise_px=0.2)
    wrong = replace(TRUE, params=(1300.0, 1300.0, *TRUE.params[2:]))
    problem = Problem(block, replace(adjusted_terms(block, wrong, 0.2), dilution=50.0))
    problem.solve(50, 1e-12)
    assert problem.block().cameras[0].focal_px == pytest.approx(TRUE.focal_px, rel=0.01)


def test_positions_that_are_known_exactly_outweigh_what_the_lens_model_leaves_over() -> None:
    """A distortion that is held at zero bends the block; diluted, it stays where its positions are."""
    bent = replace(TRUE, params=(*TRUE.params[:4], 0.0, 0.0, 0.0, 0.0))
    block = replace(adjusted_block(points=200, noise_px=0.2), cameras=(bent,))
    off = []
    for dilution in (1.0, 1000.0):
        terms = replace(
            adjusted_terms(block, bent, 0.2), lenses=(None,), marks=None, points=None, dilution=dilution
        )
        problem = Problem(block, terms)
        problem.solve(50, 1e-12)
        off.append(float(np.linalg.norm(problem.block().centers() - block.centers(), axis=1).max()))
    assert off[1] < 0.3 * off[0]


def test_covariances_hold_what_draws_scatter() -> None:
    """Sixty draws of all measurements: errors of pose and lens over their covariance are chi-square."""
    squares: list[tuple[float, float]] = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        block = adjusted_block(seed=7, noise_px=0.0)
        true_lens = np.array(TRUE.params)
        terms = adjusted_terms(block, TRUE)
        assert terms.marks is not None
        assert terms.points is not None
        assert terms.centers is not None
        prior = terms.lenses[0]
        assert prior is not None
        mean = replace(TRUE, params=tuple(rng.multivariate_normal(true_lens, prior.covariance)))
        terms = replace(
            terms,
            keypoint_px=0.05,
            lenses=(replace(prior, mean=mean),),
            marks=replace(terms.marks, xy=terms.marks.xy + rng.normal(0, 1.0, terms.marks.xy.shape)),
            points=replace(
                terms.points,
                xyz=terms.points.xyz + np.outer(rng.normal(0, 0.05, len(terms.points.xyz)), [0.0, 0.0, 1.0]),
            ),
            centers=replace(terms.centers, xyz=terms.centers.xyz + rng.normal(0, 0.05, (8, 3))),
        )
        seen = replace(block, xy=block.xy + rng.normal(0, 0.05, block.xy.shape))
        problem = Problem(seen, terms)
        problem.solve(60, 1e-12)
        squares.append(_squares(problem, block, problem.marginals()))
    pose, lens = np.mean(squares, axis=0)
    # Of normal residuals the robust weights leave about half: the covariances are on the safe side. Six and
    # eight degrees of freedom; the mean of 60 scatters by 0.45 and 0.52.
    assert 2.5 < pose < 7.0
    assert 3.0 < lens < 9.5


def _squares(problem: Problem, truth: Block, found: Marginals) -> tuple[float, float]:
    adjusted = problem.block()
    error = (truth.cam_from_block[5] @ adjusted.cam_from_block[5].inverse()).log()
    off = np.array(truth.cameras[0].params) - np.array(adjusted.cameras[0].params)
    return (
        float(error @ np.linalg.solve(found.pose(5), error)),
        float(off @ np.linalg.solve(found.lens(0), off)),
    )


def test_points_move_with_poses_and_lenses_as_is_said() -> None:
    """Against points that are intersected anew after a pose and a lens have changed by little."""
    block, px = adjusted_block(), 0.5
    problem = Problem(block, Terms(keypoint_px=px, lenses=(lens_prior(TRUE, WIDTHS),)))
    found, (rows, moved, information) = problem.marginals(), problem.points_by_shared()
    np.testing.assert_array_equal(rows, np.arange(len(block.xyz)))
    change = np.zeros(len(found.shared))
    change[found.pose_start[3] + np.arange(6)] = [2e-5, -1e-5, 3e-5, 4e-4, -2e-4, 3e-4]
    change[found.lens_start[0] + np.arange(4)] = [0.02, -0.01, 0.03, 0.02]
    poses = list(block.cam_from_block)
    poses[3] = Rigid3.exp(change[found.pose_start[3] + np.arange(6)]) @ poses[3]
    lens = np.array(TRUE.params) + change[found.lens_start[0] + np.arange(8)]
    camera = replace(TRUE, params=tuple(lens))
    linear = linearise([camera], block.camera_of, poses, block.xyz, block.point_of, block.photo_of, block.xy)
    expected = np.zeros_like(block.xyz)
    for k in range(len(block.xyz)):
        seen = linear.point_of == k
        by_point = linear.by_point[seen].reshape(-1, 3)
        expected[k] = np.linalg.lstsq(by_point, linear.residual[seen].ravel(), rcond=None)[0]
        np.testing.assert_allclose(information[k], by_point.T @ by_point / px**2, rtol=1e-2, atol=1.0)
    np.testing.assert_allclose((moved @ change).reshape(-1, 3), expected, atol=0.02 * np.abs(expected).max())


def test_a_point_behind_all_cameras_breaks_no_covariance() -> None:
    """No residual depends on it: as if it were not there."""
    block = whole_lens(adjusted_block())
    xyz = block.xyz.copy()
    xyz[-1, 2] = 500.0
    behind = replace(block, xyz=xyz)
    rest = block.point_of != len(xyz) - 1
    without = replace(
        block,
        xyz=xyz[:-1],
        point_of=block.point_of[rest],
        photo_of=block.photo_of[rest],
        xy=block.xy[rest],
    )
    found, expected = (Problem(one, adjusted_terms(one, TRUE)).marginals() for one in (behind, without))
    np.testing.assert_allclose(found.pose(1), expected.pose(1), rtol=1e-4, atol=1e-12)


def test_what_is_held_stays_and_has_no_covariance() -> None:
    block = adjusted_block(noise_px=0.5)
    terms = replace(adjusted_terms(block, TRUE), lenses=(None,), held_photos=(3,))
    problem = Problem(block, terms)
    problem.solve(20, 1e-9)
    found, covariance = problem.block(), problem.marginals()
    assert found.cameras == block.cameras
    np.testing.assert_allclose(found.cam_from_block[3].matrix(), block.cam_from_block[3].matrix(), atol=1e-12)
    assert not covariance.pose(3).any()
    assert not covariance.lens(0).any()
    assert np.linalg.norm(found.cam_from_block[4].center - block.cam_from_block[4].center) > 0


def test_points_go_where_their_priors_want_them() -> None:
    block = adjusted_block()
    up = PointPriors(
        point_of=np.arange(60),
        xyz=block.xyz + np.array([0.0, 0.0, 0.4]),
        covariance=np.tile(np.eye(3) * 1e-6, (60, 1, 1)),
    )
    problem = Problem(block, replace(adjusted_terms(block, TRUE), marks=None, points=up))
    problem.solve(50, 1e-12)
    assert np.median(problem.block().xyz[:, 2] - block.xyz[:, 2]) == pytest.approx(0.4, abs=0.01)


def test_a_whole_lens_is_the_same_lens() -> None:
    rays = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (50, 3))
    lenses = (
        Camera(model="SIMPLE_RADIAL", width=800, height=600, params=(700.0, 401.0, 299.0, 0.02)),
        Camera(model="RADIAL", width=800, height=600, params=(700.0, 401.0, 299.0, 0.02, -0.01)),
        Camera(model="PINHOLE", width=800, height=600, params=(700.0, 710.0, 401.0, 299.0)),
    )
    for lens in lenses:
        whole = whole_lens(replace(adjusted_block(), cameras=(lens,))).cameras[0]
        assert whole.model == "OPENCV"
        np.testing.assert_allclose(whole.project(rays), lens.project(rays), atol=1e-9)
    fisheye = Camera.from_focal(800, 600, 400.0, "OPENCV_FISHEYE")
    assert whole_lens(replace(adjusted_block(), cameras=(fisheye,))).cameras == (fisheye,)


def test_orientations_turn_a_block_that_nothing_else_holds() -> None:
    """A tilt of five degrees that is known to one, from positions that know it to far less."""
    block = adjusted_block(points=100)
    turn = Rigid3.exp([np.radians(5.0), 0.0, 0.0, 0.0, 0.0, 0.0]).rotation
    covariance = np.diag([np.radians(1.0) ** 2, np.radians(1.0) ** 2, 100.0])
    terms = Terms(
        keypoint_px=0.3,
        lenses=(None,),
        centers=CenterPriors(
            photo_of=np.arange(8), xyz=block.centers(), covariance=np.tile(np.eye(3) * 1e4, (8, 1, 1))
        ),
        orientations=Orientations(
            photo_of=np.arange(8),
            cam_from_block=np.array([pose.rotation @ turn.T for pose in block.cam_from_block]),
            covariance=np.tile(covariance, (8, 1, 1)),
        ),
    )
    problem = Problem(block, terms)
    problem.solve(200, 1e-14, 1e9)
    up = problem.block().cam_from_block[0].rotation.T @ block.cam_from_block[0].rotation @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, turn @ [0.0, 0.0, 1.0], atol=1e-4)
