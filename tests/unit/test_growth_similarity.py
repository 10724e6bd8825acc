"""The similarity over pixels: truth found, outliers left out, covariance as wide as the errors."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from ingest.growth.place.similarity_fit import (
    Correspondences,
    agreeing_photos,
    correspondence_errors,
    find_correspondences,
    fit_similarity,
    neighbours_factor,
)
from ingest.growth.values import TOLERANCE_PX
from tests.support.localised_photos import localised_photo
from tests.support.new_photos import SFM_FROM_LOCAL, NewPhotos, take_photos
from tests.support.scenes import box_points, random_descriptors, ring

TRUTH = SFM_FROM_LOCAL.inverse()


def world(seed: int, noise_px: float = 0.5, photos: int = 5) -> tuple[NewPhotos, FloatArray]:
    rng = np.random.default_rng(seed)
    points = box_points(rng, 150)
    new = take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        ring(photos),
        noise_px=noise_px,
        point_noise_m=0.0,
        pose_noise_m=0.0,
    )
    return new, points


def correspondences_of(
    new: NewPhotos, points: FloatArray, sigma_m: float = 0.0, seed: int = 0
) -> Correspondences:
    """Every feature is anchored to its world point, which the existing map has with that error."""
    there = points + np.random.default_rng(seed).normal(0, 1, points.shape) * sigma_m
    photo_of = np.concatenate([np.full(len(w), k) for k, w in enumerate(new.world_of)])
    world_of = np.concatenate(new.world_of)
    pixels = np.concatenate([f.features.xy.astype(np.float64) for f in new.features])
    return Correspondences(
        map_ids=("old",),
        photo_of=photo_of,
        feature=np.concatenate([np.arange(len(w)) for w in new.world_of]),
        pixels=pixels,
        points=there[world_of],
        covariance=np.tile(np.eye(3) * max(sigma_m, 1e-4) ** 2, (len(photo_of), 1, 1)),
        map_of=np.zeros(len(photo_of), dtype=np.int64),
        point_of=world_of,
        model_point=np.full(len(photo_of), -1),
        carried=np.zeros(len(photo_of), dtype=np.bool_),
    )


def error_of(sim: Sim3) -> FloatArray:
    """Tangent of the left perturbation that carries the estimate to the truth."""
    return (TRUTH @ sim.inverse()).log()


def test_exact_pixels_give_the_exact_similarity() -> None:
    new, points = world(1, noise_px=0.0)
    correspondences = correspondences_of(new, points)
    start = Sim3.exp(np.array([0.02, 0.01, -0.02, 0.015, 0.4, -0.3, 0.5])) @ TRUTH
    fit = fit_similarity(new.model, start, correspondences)
    error = error_of(fit.local_from_sfm)
    assert np.abs(error[:4]).max() < 1e-5
    assert np.abs(error[4:]).max() < 1e-4  # keypoints are float32
    assert correspondence_errors(new.model, fit.local_from_sfm, correspondences).max() < 1e-2


def test_wrong_correspondences_do_not_move_it() -> None:
    new, points = world(2)
    correspondences = correspondences_of(new, points)
    wrong = np.random.default_rng(0).random(len(correspondences)) < 0.25
    pixels = correspondences.pixels.copy()
    pixels[wrong] += 60.0
    clean = fit_similarity(new.model, TRUTH, correspondences.take(~wrong))
    dirty = fit_similarity(new.model, TRUTH, replace(correspondences, pixels=pixels))
    apart = (clean.local_from_sfm @ dirty.local_from_sfm.inverse()).log()
    sigma = np.sqrt(np.diag(clean.covariance))
    assert (np.abs(apart) < 2.0 * sigma).all()


@pytest.mark.parametrize("sigma_m", [0.0, 0.08])
def test_the_covariance_is_as_wide_as_the_errors(sigma_m: float) -> None:
    """Squared normalised errors of seven parameters: mean 7 by theory, 4.3 to 10.4 in 95 % of 12 runs.

    With errors of the existing points (3 cm in 60 m is about 1 px) the photos that see one point err alike.
    """
    lengths = []
    for seed in range(12):
        new, points = world(50 + seed)
        correspondences = correspondences_of(new, points, sigma_m, seed)
        fit = fit_similarity(new.model, TRUTH, correspondences)
        error = error_of(fit.local_from_sfm)
        lengths.append(float(error @ np.linalg.solve(fit.covariance, error)))
    assert 2.0 < np.mean(lengths) < 11.0, lengths


def test_photos_that_are_bent_alike_widen_the_covariance() -> None:
    """Every photo's pixels are off by an offset of its own: what its correspondences say is one statement."""
    new, points = world(3)
    correspondences = correspondences_of(new, points)
    straight = fit_similarity(new.model, TRUTH, correspondences)
    offsets = np.random.default_rng(1).normal(0, 3.0, (5, 2))
    bent = replace(correspondences, pixels=correspondences.pixels + offsets[correspondences.photo_of])
    fit = fit_similarity(new.model, TRUTH, bent)
    assert straight.neighbours_factor < 3.0
    assert fit.neighbours_factor > 10.0
    error = error_of(fit.local_from_sfm)
    assert error @ np.linalg.solve(fit.covariance, error) < 24.3  # 99.9 % of seven degrees of freedom
    naive = fit.covariance / fit.neighbours_factor
    assert error @ np.linalg.solve(naive, error) > 24.3


def test_what_no_correspondence_holds_is_open_and_stays() -> None:
    """One photo does not tell the scale; points behind all cameras tell nothing at all."""
    new, points = world(6)
    correspondences = correspondences_of(new, points)
    fit = fit_similarity(new.model, TRUTH, correspondences.take(correspondences.photo_of == 0))
    assert np.linalg.eigvalsh(fit.covariance).min() > 0.0
    assert np.sqrt(fit.covariance[0, 0]) > 1.0
    center = new.model.cam_from_sfm[0].center
    assert np.linalg.norm(fit.local_from_sfm.act(center) - TRUTH.act(center)) < 0.5
    away = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e4])) @ TRUTH
    down = fit_similarity(new.model, away, correspondences_behind(new, correspondences))
    np.testing.assert_allclose(down.local_from_sfm.matrix(), away.matrix())
    assert np.sqrt(np.diag(down.covariance)).min() > 1.0


def correspondences_behind(new: NewPhotos, correspondences: Correspondences) -> Correspondences:
    """The same pixels with points a kilometre behind their cameras, wherever these are moved."""
    behind = np.empty_like(correspondences.points)
    for k, pose in enumerate(new.model.cam_from_sfm):
        camera = TRUTH.act_on_pose(pose)
        behind[correspondences.photo_of == k] = camera.inverse().act(np.array([[0.0, 0.0, -1e3]]))
    return replace(correspondences, points=behind + np.array([0.0, 0.0, 1e4]))


def test_neighbours_factor_of_independent_scores_is_about_one() -> None:
    new, points = world(4)
    correspondences = correspondences_of(new, points)
    score = np.random.default_rng(2).normal(size=(len(correspondences), 7))
    assert neighbours_factor(score, np.eye(7), correspondences) < 2.0


def test_photos_agree_by_their_own_correspondences() -> None:
    new, points = world(5)
    correspondences = correspondences_of(new, points)
    pixels = correspondences.pixels.copy()
    pixels[correspondences.photo_of == 2] += 40.0
    off = replace(correspondences, pixels=pixels)
    errors = correspondence_errors(new.model, TRUTH, off)
    agree = agreeing_photos(errors, TOLERANCE_PX, off)
    assert agree == {0, 1, 3, 4}


def test_points_behind_a_camera_never_agree() -> None:
    new, points = world(6)
    correspondences = correspondences_of(new, points)
    correspondences = replace(correspondences, points=correspondences.points + np.array([0.0, 0.0, 500.0]))
    assert np.isinf(correspondence_errors(new.model, TRUTH, correspondences)).any()


def test_anchors_are_carried_along_tracks() -> None:
    """Photo 0 localises; photos that share its tracks are held by the same points; a minority link is not."""
    new, points = world(7)
    rows = np.arange(20)
    world_rows = new.world_of[0][rows]
    photo = localised_photo(
        new.poses[0],
        camera=new.model.cameras[0],
        feature_rows=rows,
        pixels=new.features[0].features.xy[rows].astype(np.float64),
        point_of=world_rows,
        points=points[world_rows],
        point_covariance=np.tile(np.eye(3) * 1e-4, (20, 1, 1)),
    )
    correspondences = find_correspondences(new.model, {0: photo}, list(new.keypoints().values()))
    assert (~correspondences.carried).sum() == 20
    seen_by_others = sum(int(np.isin(w, world_rows).sum()) for w in new.world_of[1:])
    assert correspondences.carried.sum() == seen_by_others
    for photo_of, feature, point in zip(
        correspondences.photo_of.tolist(),
        correspondences.feature.tolist(),
        correspondences.point_of.tolist(),
        strict=True,
    ):
        assert new.world_of[photo_of][feature] == point
