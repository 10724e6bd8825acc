"""How photos agree on a lens, and covariances that follow from it, on draws of a block."""

from dataclasses import replace

import numpy as np
import pytest

import featuredb.adjust.problem as adjust
from featuredb.adjust.lens_agreement import Weighted, lens_disagreement
from featuredb.adjust.marginals import Marginals
from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, CenterPriors, LensWidths, Terms, lens_prior
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3

WIDTHS = LensWidths(focal_rel=0.02, aspect_rel=0.001, center_rel=0.01, radial=0.05, tangential=0.003)
TRUE = Camera(
    model="OPENCV", width=1200, height=900, params=(1010.0, 1009.5, 608.0, 446.0, 0.03, -0.01, 5e-4, -3e-4)
)
PHOTOS, NOISE_PX, POSITION_M = 16, 0.3, 0.05


def drawn(seed: int, wrong_per_photo: float = 0.0, points: int = 80) -> Block:
    """The truth, with pixels as photos saw it.

    Args:
        wrong_per_photo: of each photo's own radial coefficient.
    """
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-8, -6, -2], [8, 6, 2], (points, 3))
    poses, pixels = [], []
    for k in range(PHOTOS):
        center = np.array([6 * np.cos(k), 6 * np.sin(k), 18.0 + 3 * (k % 2)])
        turn = Rigid3.exp(np.concatenate([rng.normal(0, 0.08, 3), np.zeros(3)])).rotation
        rotation = turn @ np.diag([1.0, -1.0, -1.0])
        poses.append(Rigid3(rotation=rotation, translation=-rotation @ center))
        bent = TRUE.params[4] + wrong_per_photo * rng.normal()
        lens = replace(TRUE, params=(*TRUE.params[:4], bent, *TRUE.params[5:]))
        pixels.append(lens.project(poses[-1].act(xyz)) + rng.normal(0.0, NOISE_PX, (points, 2)))
    return Block(
        names=tuple(map(str, range(PHOTOS))),
        cameras=(TRUE,),
        camera_of=np.zeros(PHOTOS, np.int64),
        cam_from_block=tuple(poses),
        xyz=xyz,
        point_of=np.tile(np.arange(points), PHOTOS),
        photo_of=np.repeat(np.arange(PHOTOS), points),
        xy=np.concatenate(pixels),
    )


def solved(truth: Block, seed: int, dilution: float) -> Problem:
    """Adjusted by positions and a prior of the lens, both drawn as wide as they say."""
    rng = np.random.default_rng((seed, 1))
    prior = lens_prior(TRUE, WIDTHS)
    mean = replace(TRUE, params=tuple(rng.multivariate_normal(TRUE.params, prior.covariance)))
    terms = Terms(
        keypoint_px=NOISE_PX,
        dilution=dilution,
        lenses=(replace(prior, mean=mean),),
        centers=CenterPriors(
            photo_of=np.arange(PHOTOS),
            xyz=truth.centers() + rng.normal(0.0, POSITION_M, (PHOTOS, 3)),
            covariance=np.tile(np.eye(3) * POSITION_M**2, (PHOTOS, 1, 1)),
        ),
    )
    problem = Problem(truth, terms)
    problem.solve(60, 1e-12)
    return problem


def squares(problem: Problem, truth: Block, found: Marginals, photo: int = 5) -> tuple[float, float]:
    """Of pose and lens over their covariances."""
    adjusted = problem.block()
    error = (truth.cam_from_block[photo] @ adjusted.cam_from_block[photo].inverse()).log()
    off = np.array(TRUE.params) - np.array(adjusted.cameras[0].params)
    return (
        float(error @ np.linalg.solve(found.pose(photo), error)),
        float(off @ np.linalg.solve(found.lens(0), off)),
    )


def test_covariances_are_of_the_noise_whatever_the_priors_count() -> None:
    """Priors count fifty times; errors are as wide as the covariances say, not as the normal matrix does."""
    right, by_weights = [], []
    for seed in range(20):
        truth = drawn(seed)
        problem = solved(truth, seed, dilution=50.0)
        found, weighted = problem.honest_marginals()
        right.append(squares(problem, truth, found))
        by_weights.append(squares(problem, truth, weighted))
    pose, lens = np.mean(right, axis=0)
    # Six and eight degrees of freedom, less what the robust loss leaves on the safe side.
    assert 3.0 < pose < 8.0
    assert 3.0 < lens < 10.5
    assert np.mean(by_weights, axis=0)[0] > 2.0 * pose


def disagreements(problem: Problem, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Of each lens."""
    values: list[FloatArray] = []

    def kept(weighted: Weighted) -> FloatArray:
        values.append(lens_disagreement(weighted))
        return values[-1]

    monkeypatch.setattr(adjust, "lens_disagreement", kept)
    problem.honest_marginals()
    return [float(value) for value in values[0]]


def test_photos_whose_lens_differs_disagree(monkeypatch: pytest.MonkeyPatch) -> None:
    """A distortion that changes from photo to photo, by a pixel or two in the corners."""
    none, some, much = (
        disagreements(solved(drawn(3, wrong), 3, 50.0), monkeypatch)[0] for wrong in (0.0, 0.01, 0.03)
    )
    assert none < 1.5
    assert 1.5 * none < some < much / 1.5


def test_a_lens_of_two_photos_is_as_others_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two photos cannot disagree; a lens of one photo must not look better known than one of many."""
    truth = drawn(4)
    alone = replace(truth, cameras=(TRUE, TRUE), camera_of=(np.arange(PHOTOS) < 2).astype(np.int64))
    prior = lens_prior(TRUE, WIDTHS)
    problem = Problem(
        alone, Terms(keypoint_px=NOISE_PX, dilution=50.0, lenses=(prior, prior), held_photos=(0, 3))
    )
    many, two = disagreements(problem, monkeypatch)
    assert two > many
