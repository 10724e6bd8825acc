"""What is said of a reconstruction's bending, against independent runs with noise."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from featuredb.adjust.terms import whole_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian, similarity_closed_form
from ingest.colmap.anchored import FixedPoints, Lenses, adjust_anchored
from ingest.colmap.bridge import Model, with_observations
from ingest.growth.place import drift
from ingest.growth.place.drift import PhotoSpread, photo_covariances, shared_turn, turning_covariance
from ingest.growth.place.refine import loose_photos
from tests.support.new_photos import NewPhotos, take_photos
from tests.support.scenes import CAMERA, box_points, looking_at, random_descriptors

SURE, GIVEN, FREE = Lenses(held=[0]), Lenses(lent={0: whole_camera(CAMERA)}), Lenses()
EXIF = Lenses(focal_px={0: CAMERA.focal_px})
COUNT = 40  # world points that the existing map has; they lie in the west
PHOTOS = 6


def walk(seed: int) -> tuple[NewPhotos, FloatArray, FixedPoints]:
    """Photos that walk 60 m east; only the first two see existing points."""
    world = np.random.default_rng(5)
    points = np.concatenate([box_points(world, 120) + np.array([30.0 * k, 0.0, 0.0]) for k in range(4)])
    poses = [
        looking_at(np.array([18.0 * k, -40.0, 25.0]), np.array([18.0 * k, 0.0, 3.0])) for k in range(PHOTOS)
    ]
    new = take_photos(
        np.random.default_rng(seed),
        points,
        random_descriptors(world, len(points)),
        poses,
        sfm_from_local=Sim3.identity(),
        noise_px=0.5,
        point_noise_m=0.02,
        pose_noise_m=0.02,
    )
    point_of, photo_of, pixels = [], [], []
    for k in (0, 1):
        rows = np.flatnonzero(new.world_of[k] < COUNT)
        point_of.append(new.world_of[k][rows])
        photo_of.append(np.full(len(rows), k))
        pixels.append(new.features[k].features.xy[rows].astype(np.float64))
    fixed = FixedPoints(
        xyz=points[:COUNT],
        point_of=np.concatenate(point_of),
        photo_of=np.concatenate(photo_of),
        pixels=np.concatenate(pixels),
    )
    return new, points, fixed


def spread_of(
    model: Model,
    keypoints: Sequence[FloatArray],
    fixed: FixedPoints,
    kept: NDArray[np.bool_],
    lenses: Lenses,
) -> PhotoSpread:
    return photo_covariances(model, keypoints, fixed, kept, lenses)


def center_covariances(model: Model, spread: PhotoSpread) -> FloatArray:
    """(k, 3, 3) of the photos' centres, from those of their poses."""
    turns = np.array([pose.rotation for pose in model.cam_from_sfm])
    return np.asarray(np.swapaxes(turns, 1, 2) @ spread.poses[:, 3:, 3:] @ turns)


def mean_turn(found: Sequence[Rigid3], true: Sequence[Rigid3], lens: Camera = CAMERA) -> FloatArray:
    """(3,) mean rotation about the local axes by which what the photos see is off, of poses and lens."""
    (fx, fy, cx, cy), (_, _, *middle) = whole_camera(lens).params[:4], whole_camera(CAMERA).params[:4]
    by_lens = np.array([-(cy - middle[1]) / fy, (cx - middle[0]) / fx, 0.0])
    turns = [t.rotation.T @ ((f @ t.inverse()).log()[:3] + by_lens) for f, t in zip(found, true, strict=True)]
    return np.asarray(np.mean(turns, axis=0))


def test_centres_are_off_as_far_as_is_said() -> None:
    """Mean squared normalised error of three coordinates is 3; the far end is several times less sure."""
    lengths, sigmas = [], []
    for seed in range(10):
        new, _, fixed = walk(seed)
        model = new.model
        world = np.array(
            [
                new.world_of[k][f]
                for k, f in zip(model.photo_of.tolist(), model.keypoint_of.tolist(), strict=True)
            ]
        )
        free = with_observations(model, (world >= COUNT) | (model.photo_of > 1))
        keypoints = list(new.keypoints().values())
        done = adjust_anchored(free, keypoints, fixed, SURE)
        said = spread_of(done.model, keypoints, fixed, done.fixed_kept, SURE)
        spread = center_covariances(done.model, said)
        off = done.model.centers() - np.array([p.center for p in new.poses])
        lengths.append([float(e @ np.linalg.solve(c, e)) for e, c in zip(off, spread, strict=True)])
        sigmas.append(np.sqrt(np.linalg.eigvalsh(spread)[:, -1]))
    assert 1.5 < np.mean(lengths) < 6.0, np.mean(lengths, axis=0)
    assert np.mean(sigmas, axis=0)[-1] > 3.0 * np.mean(sigmas, axis=0)[0]


def test_a_lens_that_may_be_off_widens_it() -> None:
    new, _, fixed = walk(1)
    keypoints = list(new.keypoints().values())
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    narrow = spread_of(new.model, keypoints, fixed, kept, SURE)
    wide = spread_of(new.model, keypoints, fixed, kept, GIVEN)
    for a, b in ((wide.poses, narrow.poses), (wide.shown, narrow.shown)):
        assert (np.trace(a, axis1=1, axis2=2) > np.trace(b, axis1=1, axis2=2)).all()


def test_what_photos_show_is_off_as_far_as_is_said() -> None:
    """Mean squared normalised errors of the three coordinates and turns of what each photo shows are 3."""
    shifts, turns, bounds = [], [], []
    for seed in range(10):
        new, points, fixed = walk(seed)
        model, keypoints = new.model, list(new.keypoints().values())
        seen_of = zip(model.photo_of.tolist(), model.keypoint_of.tolist(), strict=True)
        world = np.array([new.world_of[k][f] for k, f in seen_of])
        taking_part = (world >= COUNT) | (model.photo_of > 1)
        done = adjust_anchored(with_observations(model, taking_part), keypoints, fixed, SURE)
        said = spread_of(done.model, keypoints, fixed, done.fixed_kept, SURE)
        bounds.append(said.bounds_m())
        true_of = np.full(len(done.model.xyz), -1)
        for k, f, p in zip(done.model.photo_of, done.model.keypoint_of, done.model.point_of, strict=True):
            true_of[p] = new.world_of[int(k)][int(f)]
        for k in range(2, PHOTOS):  # which show new points alone
            rows = np.unique(done.model.point_of[done.model.photo_of == k])
            source, target = points[true_of[rows]], done.model.xyz[rows]
            lies = similarity_closed_form(source - said.middles[k], target - said.middles[k])
            assert lies is not None
            error = lies.log()
            for of, part in ((shifts, slice(4, 7)), (turns, slice(1, 4))):
                of.append(float(error[part] @ np.linalg.solve(said.shown[k][part, part], error[part])))
    assert 1.0 < np.mean(shifts) < 6.0, shifts
    assert 1.0 < np.mean(turns) < 6.0, turns
    assert np.mean(bounds, axis=0)[-1] > 3.0 * np.mean(bounds, axis=0)[0]


@pytest.mark.parametrize(
    ("spread_m", "told"), [((9.0, 7.0, 3.0), True), ((9.0, 7.0, 0.0), True), ((9.0, 0.0, 0.0), False)]
)
def test_places_on_a_line_do_not_tell_how_they_are_turned(
    spread_m: tuple[float, float, float], told: bool
) -> None:
    places = np.random.default_rng(3).normal(size=(30, 3)) * spread_m
    moved = sparse.csr_matrix(np.random.default_rng(4).normal(size=(90, 5)))
    found = drift._similarity(places, np.tile(1e4 * np.eye(3), (30, 1, 1)), moved)
    assert np.isfinite(found).all() == told
    assert np.isnan(found).all() != told


def test_a_similaritys_covariance_grows_until_it_holds_the_far_end(monkeypatch: pytest.MonkeyPatch) -> None:
    new, _, fixed = walk(2)
    keypoints = list(new.keypoints().values())
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    tiny, ample = np.diag([1e-10] * 4 + [1e-8] * 3), np.eye(7)
    arguments = (new.model, keypoints, fixed, kept, GIVEN)
    spread = spread_of(*arguments)
    more = spread.lacks_m2(tiny).max()
    assert more > 1e-4
    wider = tiny + np.diag([0.0] * 4 + [more] * 3)
    assert spread.lacks_m2(wider).max() < 1e-9
    assert spread.lacks_m2(ample).max() == 0.0
    monkeypatch.setattr(drift, "_LEAST_PX", 5.0)
    assert spread_of(*arguments).lacks_m2(tiny).max() > 2.0 * more
    assert more == pytest.approx(np.square(spread.bounds_m() / 1.96).max(), rel=0.01)


def test_a_similaritys_covariance_turns_until_it_holds_every_piece() -> None:
    """What is added turns about the middle of what they show, holds the pieces' directions, and is nothing
    where they are held already."""
    new, _, fixed = walk(2)
    keypoints = list(new.keypoints().values())
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    spread = spread_of(new.model, keypoints, fixed, kept, GIVEN)
    tiny, ample = np.diag([1e-10] * 4 + [1e-8] * 3), np.eye(7)
    more = turning_covariance(tiny, spread)
    for turn in spread.shown[:, 1:4, 1:4]:
        assert np.linalg.eigvalsh(tiny[1:4, 1:4] + more[1:4, 1:4] - turn)[0] > -1e-12
    assert more[1:4, 1:4].trace() > 0.9 * max(np.trace(spread.shown[:, 1:4, 1:4], axis1=1, axis2=2))
    middle = point_jacobian(spread.middles.mean(axis=0))
    np.testing.assert_allclose(middle @ more @ middle.T, 0.0, atol=1e-12)
    end = point_jacobian(new.model.centers()[-1])
    assert (end @ more @ end.T).trace() > 1e-6
    assert not turning_covariance(ample, spread).any()


def test_what_lenses_turn_is_told_apart_from_what_pixels_do() -> None:
    """Where lenses are true nothing is shared; where not, it is what they add to the pieces' directions."""
    new, _, fixed = walk(2)
    keypoints = list(new.keypoints().values())
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    narrow = spread_of(new.model, keypoints, fixed, kept, SURE)
    wide = spread_of(new.model, keypoints, fixed, kept, FREE)
    np.testing.assert_allclose(
        wide.lens_turns,
        wide.shown[:, 1:4, 1:4] - narrow.shown[:, 1:4, 1:4],
        atol=1e-3 * wide.shown[:, 1:4, 1:4].max(),
    )
    assert np.abs(shared_turn(narrow)).max() < 1e-3 * np.abs(shared_turn(wide)).max()
    turn = shared_turn(wide)
    most = np.trace(wide.lens_turns, axis1=1, axis2=2).max()
    assert (turn @ turn.T)[1:4, 1:4].trace() == pytest.approx(most, rel=1e-6)
    middle = point_jacobian(wide.middles.mean(axis=0))
    np.testing.assert_allclose(middle @ turn, 0.0, atol=1e-12)
    none = spread_of(new.model, keypoints, fixed, np.zeros_like(kept), FREE)
    assert not shared_turn(none).any()


def test_what_a_lens_has_changed_by_since_it_was_lent_is_not_shared() -> None:
    """Lenses that differ from the lent one by its prior: the far end turns as is said of this alone."""
    turned = []
    for seed in range(12):
        new, _, fixed = walk(seed)
        model = new.model
        true = whole_camera(CAMERA)
        (prior,) = Lenses(lent={0: true}).priors((true,))
        assert prior is not None
        off = np.random.default_rng(100 + seed).multivariate_normal(np.zeros(8), prior.covariance)
        lent = Lenses(lent={0: replace(true, params=tuple(np.array(true.params) + off))})
        world = np.array(
            [
                new.world_of[k][f]
                for k, f in zip(model.photo_of.tolist(), model.keypoint_of.tolist(), strict=True)
            ]
        )
        free = with_observations(
            replace(model, cameras=(lent.lent[0],)), (world >= COUNT) | (model.photo_of > 1)
        )
        keypoints = list(new.keypoints().values())
        done = adjust_anchored(free, keypoints, fixed, lent)
        said = spread_of(done.model, keypoints, fixed, done.fixed_kept, lent)
        alone = said.shown[-1, 1:4, 1:4] - said.lens_turns[-1]
        assert np.trace(said.lens_turns[-1]) > 0.0
        turn = mean_turn(done.model.cam_from_sfm[1:], new.poses[1:], done.model.cameras[0])
        turned.append(float(turn @ np.linalg.solve(alone, turn)))
    assert 1.5 < np.mean(turned) < 6.0, turned


def test_an_exif_focal_length_narrows_a_lens_of_its_own() -> None:
    new, _, fixed = walk(3)
    keypoints = list(new.keypoints().values())
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    arguments = (new.model, keypoints, fixed, kept)
    sigmas = [
        np.sqrt(np.linalg.eigvalsh(center_covariances(new.model, spread))[-1, -1])
        for spread in (
            spread_of(*arguments, lenses)
            for lenses in (
                GIVEN,
                EXIF,
                FREE,
            )
        )
    ]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    none = spread_of(*arguments[:-1], np.zeros_like(kept), GIVEN)
    assert np.isnan(none.poses).all()  # nothing holds it
    assert np.isnan(none.bounds_m()).all()
    assert np.isnan(none.lacks_m2(np.eye(7))).all()
    assert not turning_covariance(np.eye(7), none).any()


@pytest.mark.parametrize(
    ("relief_m", "lenses", "told"),
    [(0.6, FREE, False), (25.0, FREE, True), (0.6, GIVEN, True), (0.6, EXIF, False)],
    ids=["flat", "towers", "flat, lens lent", "flat, EXIF"],
)
def test_a_flat_place_from_above_does_not_tell_a_lens_that_no_map_lends(
    relief_m: float, lenses: Lenses, told: bool
) -> None:
    """2,000 observations of a fifth of a pixel say centimetres; what a lens model leaves over is decimetres.

    EXIF to 2 % is 0.8 m at 40 m. What the photos show lies where it is.
    """
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-25, 25, 2000), rng.uniform(-20, 20, 2000), np.zeros(2000)])
    points[:, 2] = rng.uniform(0, relief_m, 2000)
    poses = [looking_at(np.array([3.0 * k, -1.0, 40.0]), np.array([3.0 * k, 0.0, 0.0])) for k in range(2)]
    new = take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        poses,
        sfm_from_local=Sim3.identity(),
        noise_px=0.2,
        point_noise_m=0.01,
        pose_noise_m=0.0,
    )
    fixed = FixedPoints(
        xyz=points,
        point_of=np.concatenate(new.world_of),
        photo_of=np.repeat([0, 1], [len(w) for w in new.world_of]),
        pixels=np.concatenate(list(new.keypoints().values())),
    )
    kept = np.ones(len(fixed.point_of), dtype=np.bool_)
    spread = spread_of(new.model, list(new.keypoints().values()), fixed, kept, lenses)
    height_m = 1.96 * np.sqrt(center_covariances(new.model, spread)[:, 2, 2])
    assert (height_m < 0.5).tolist() == [told, told]
    assert loose_photos(spread, 0.5) == {}
