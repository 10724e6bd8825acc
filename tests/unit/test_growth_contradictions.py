"""Photos whose own localisation is elsewhere than the refined reconstruction are named, others are not."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from ingest.colmap.bridge import Model
from ingest.growth import gates
from ingest.growth.place.refine import contradicting_photos
from ingest.growth.place.similarity_fit import FittedSimilarity
from ingest.growth.values import LocalisedPhoto
from tests.support.localised_photos import localised_photo
from tests.support.posed_models import model_of

LOCALISED = np.diag([1e-3] * 3 + [0.05, 0.1, 0.2]) ** 2
REFINED = np.diag([5e-4] * 3 + [0.02, 0.08, 0.05]) ** 2


def fit_of(spread: float = 1.0, neighbours_factor: float = 1.0) -> FittedSimilarity:
    return FittedSimilarity(
        local_from_sfm=Sim3.identity(),
        covariance=np.eye(7) * 1e-8,
        spread=spread,
        neighbours_factor=neighbours_factor,
    )


def posed(count: int) -> tuple[Model, list[Rigid3]]:
    rng = np.random.default_rng(3)
    poses = [
        Rigid3(rotation=so3_exp(rng.normal(0, 1, 3)), translation=rng.normal(0, 30, 3)) for _ in range(count)
    ]
    return replace(model_of(*[range(5)] * count), cam_from_sfm=tuple(poses)), poses


def drawn(rng: np.random.Generator, pose: Rigid3, scale: float = 1.0) -> LocalisedPhoto:
    """The photo, localised at the pose with errors of both covariances times the scale."""
    own, refined = (scale * np.linalg.cholesky(c) @ rng.normal(size=6) for c in (LOCALISED, REFINED))
    # The refined pose's covariance is that of exp(d) cam_from_local, in axes of the camera.
    turn, move = own[:3] + pose.rotation.T @ refined[:3], own[3:] + pose.rotation.T @ refined[3:]
    rotation = pose.rotation @ so3_exp(-turn)
    center = pose.center + move
    at = Rigid3(rotation=rotation, translation=-rotation @ center)
    return localised_photo(at, covariance=LOCALISED)


def found(scale: float, fit: FittedSimilarity, spread: FloatArray | None = None) -> float:
    """Share of 600 photos that contradict."""
    model, poses = posed(600)
    rng = np.random.default_rng(7)
    photos = {k: drawn(rng, pose, scale) for k, pose in enumerate(poses)}
    spread = np.tile(REFINED, (600, 1, 1)) if spread is None else spread
    return len(contradicting_photos(model, photos, spread, [fit])) / 600


def test_honest_photos_hardly_ever_contradict() -> None:
    """Three sigmas are exceeded by 0.27 % of honest photos: by 7 of 600 in one of ten million tries."""
    assert found(1.0, fit_of()) < 7 / 600


def test_photos_five_times_further_off_do() -> None:
    assert found(5.0, fit_of()) > 0.9


def test_poses_that_share_errors_of_points_are_as_uncertain_as_the_fit_says() -> None:
    assert found(5.0, fit_of(spread=2.0, neighbours_factor=40.0)) < 7 / 600


def test_the_larger_of_both_fits_counts() -> None:
    model, poses = posed(50)
    rng = np.random.default_rng(7)
    photos = {k: drawn(rng, pose, 5.0) for k, pose in enumerate(poses)}
    spread = np.tile(REFINED, (50, 1, 1))
    alone = contradicting_photos(model, photos, spread, [fit_of()])
    before = fit_of(spread=2.0, neighbours_factor=40.0)
    assert len(alone) > 40
    assert not contradicting_photos(model, photos, spread, [before, fit_of()])


def test_without_a_covariance_of_its_own_a_pose_is_taken_as_exact() -> None:
    assert found(1.0, fit_of(), np.full((600, 6, 6), np.nan)) > 7 / 600


def test_only_photos_that_are_asked_are_named_and_with_figures() -> None:
    model, poses = posed(3)
    away = Rigid3(
        rotation=poses[1].rotation, translation=poses[1].translation + poses[1].rotation @ [0, 3, 0]
    )
    spread = np.tile(REFINED, (3, 1, 1))
    named = contradicting_photos(model, {1: localised_photo(away)}, spread, [fit_of()])
    assert list(named) == [1]
    assert "3.00 m and 0.00 degrees" in named[1][1]
    assert contradicting_photos(model, {}, spread, [fit_of()]) == {}


@pytest.mark.parametrize("sigmas", [1.0, 6.0])
def test_the_limit_is_that_of_so_many_sigmas(sigmas: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gates, "SIGMAS", sigmas)
    model, poses = posed(400)
    rng = np.random.default_rng(9)
    photos = {k: drawn(rng, pose) for k, pose in enumerate(poses)}
    named = contradicting_photos(model, photos, np.tile(REFINED, (400, 1, 1)), [fit_of()])
    expected = {1.0: 0.317, 6.0: 0.0}[sigmas]
    assert len(named) / 400 == pytest.approx(expected, abs=0.08)
