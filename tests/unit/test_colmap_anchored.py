"""Adjustment with fixed points and lenses: truth is known, gauge and lens are where they should be."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from ingest.colmap.anchored import (
    FixedPoints,
    Lenses,
    adjust_anchored,
    triangulate_posed,
    with_observations,
)
from ingest.colmap.bridge import Model, SfmPhoto, TwoView
from tests.support.new_photos import NewPhotos, take_photos
from tests.support.scenes import CAMERA, box_points, looking_at, random_descriptors, ring

HELD = Lenses(held=[0])
UNMOVED = Sim3.identity()


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lenses start far off, so that nothing would fit at first."""
    monkeypatch.setattr("ingest.colmap.anchored._MAX_ERROR_PX", 60.0)


@pytest.fixture(scope="module")
def scene() -> tuple[NewPhotos, FloatArray]:
    """Photos whose model is in the true frame already, but roughly: poses 20 cm off, points 10 cm."""
    rng = np.random.default_rng(11)
    points = box_points(rng, 120)
    new = take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        ring(6)[:4],
        sfm_from_local=UNMOVED,
        noise_px=0.3,
        point_noise_m=0.1,
        pose_noise_m=0.2,
    )
    return new, points


def fixed_of(new: NewPhotos, points: FloatArray, count: int, photos: tuple[int, ...]) -> FixedPoints:
    """The first points, as the given photos see them."""
    point_of, photo_of, pixels = [], [], []
    for k in photos:
        rows = np.flatnonzero(new.world_of[k] < count)
        point_of.append(new.world_of[k][rows])
        photo_of.append(np.full(len(rows), k))
        pixels.append(new.features[k].features.xy[rows].astype(np.float64))
    return FixedPoints(
        xyz=points[:count],
        point_of=np.concatenate(point_of),
        photo_of=np.concatenate(photo_of),
        pixels=np.concatenate(pixels),
    )


def without(new: NewPhotos, count: int) -> Model:
    """The model without observations of the first points."""
    model = new.model
    world = np.array(
        [new.world_of[k][f] for k, f in zip(model.photo_of.tolist(), model.keypoint_of.tolist(), strict=True)]
    )
    return with_observations(model, world >= count)


def centers_off(model: Model, new: NewPhotos) -> FloatArray:
    return np.linalg.norm(model.centers() - np.array([p.center for p in new.poses]), axis=1)


def test_fixed_points_hold_poses_and_points(scene: tuple[NewPhotos, FloatArray]) -> None:
    new, points = scene
    keypoints = list(new.keypoints().values())
    before = centers_off(new.model, new)
    done = adjust_anchored(without(new, 40), keypoints, fixed_of(new, points, 40, (0, 1, 2, 3)), HELD)
    assert before.max() > 0.15
    assert centers_off(done.model, new).max() < 0.03
    assert done.fixed_kept.all()
    nearest = [np.linalg.norm(points - p, axis=1).min() for p in done.model.xyz]
    assert np.median(nearest) < 0.03


def test_points_that_one_photo_sees_hold_it_too(scene: tuple[NewPhotos, FloatArray]) -> None:
    """Only the first two photos see fixed points, each its own; the others hang on the free ones."""
    new, points = scene
    fixed = fixed_of(new, points, 40, (0, 1))
    own = (fixed.photo_of == 0) == (fixed.point_of % 2 == 0)
    alone = replace(
        fixed, point_of=fixed.point_of[own], photo_of=fixed.photo_of[own], pixels=fixed.pixels[own]
    )
    assert np.bincount(alone.point_of).max() == 1
    done = adjust_anchored(without(new, 40), list(new.keypoints().values()), alone, HELD)
    assert centers_off(done.model, new).max() < 0.08


def test_fixed_points_that_do_not_fit_are_dropped(scene: tuple[NewPhotos, FloatArray]) -> None:
    new, points = scene
    fixed = fixed_of(new, points, 40, (0, 1, 2, 3))
    wrong = fixed.point_of < 5
    pixels = fixed.pixels + np.where(wrong[:, None], 50.0, 0.0)
    done = adjust_anchored(
        without(new, 40), list(new.keypoints().values()), replace(fixed, pixels=pixels), HELD
    )
    assert not done.fixed_kept[wrong].any()
    assert done.fixed_kept[~wrong].mean() > 0.95
    assert centers_off(done.model, new).max() < 0.05


@pytest.mark.usefixtures("wide")
def test_a_free_lens_is_found_and_a_constant_one_stays(scene: tuple[NewPhotos, FloatArray]) -> None:
    new, points = scene
    off = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(870.0, 500.0, 400.0, 0.0))
    model = replace(without(new, 40), cameras=(off,))
    fixed = fixed_of(new, points, 40, (0, 1, 2, 3))
    keypoints = list(new.keypoints().values())
    free = adjust_anchored(model, keypoints, fixed, Lenses()).model.cameras[0]
    assert free.focal_px == pytest.approx(CAMERA.focal_px, abs=2.0)
    assert adjust_anchored(model, keypoints, fixed, HELD).model.cameras[0] == off


def test_without_fixed_points_the_first_photo_stays(scene: tuple[NewPhotos, FloatArray]) -> None:
    new, _ = scene
    done = adjust_anchored(new.model, list(new.keypoints().values()), FixedPoints.none(), HELD)
    first, before = done.model.cam_from_sfm[0], new.model.cam_from_sfm[0]
    assert np.abs((first @ before.inverse()).log()).max() < 1e-9
    truth = np.array([p.center for p in new.poses])
    to_truth = similarity_closed_form(done.model.centers(), truth)
    assert to_truth is not None
    assert np.linalg.norm(to_truth.act(done.model.centers()) - truth, axis=1).max() < 0.03
    assert centers_off(new.model, new).max() > 0.15


def test_points_of_known_poses(scene: tuple[NewPhotos, FloatArray]) -> None:
    new, points = scene
    photos = [
        SfmPhoto(name=str(k), camera_row=k, keypoints=f.features.xy) for k, f in enumerate(new.features)
    ]
    geometries = {}
    for a in range(4):
        for b in range(a + 1, 4):
            _, at_a, at_b = np.intersect1d(new.world_of[a], new.world_of[b], return_indices=True)
            pairs = np.stack([at_a, at_b], axis=1).astype(np.uint32)
            geometries[a, b] = TwoView(
                inliers=pairs,
                config=np.array(2, dtype=np.int64),  # calibrated
                essential=_essential(new.poses[a], new.poses[b]),
                fundamental=np.zeros((3, 3)),
                homography=np.zeros((3, 3)),
            )
    model = triangulate_posed([CAMERA] * 4, photos, new.poses, geometries)
    assert len(model.rows) == 4
    assert len(model.xyz) > 90
    world = np.array(
        [
            new.world_of[int(model.rows[k])][f]
            for k, f in zip(model.photo_of.tolist(), model.keypoint_of.tolist(), strict=True)
        ]
    )
    off = np.linalg.norm(model.xyz[model.point_of] - points[world], axis=1)
    assert np.median(off) < 0.03
    for pose, truth in zip(model.cam_from_sfm, new.poses, strict=True):
        assert np.abs(pose.matrix() - truth.matrix()).max() < 1e-9


def _essential(a: Rigid3, b: Rigid3) -> FloatArray:
    relative = b @ a.inverse()
    x, y, z = relative.translation
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative.rotation


def nadir_line(seed: int) -> NewPhotos:
    """Photos straight down on nearly flat ground: focal length and height are one."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-60, 60, 500), rng.uniform(-25, 25, 500), rng.uniform(0, 1, 500)])
    spots = [np.array([-24.0 + 12.0 * k, 0.0, 0.0]) for k in range(5)]
    return take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        [looking_at(spot + np.array([0.0, -0.1, 40.0]), spot) for spot in spots],
        sfm_from_local=Sim3.identity(),
        noise_px=0.5,
        point_noise_m=0.1,
        pose_noise_m=0.1,
    )


def focal_after(new: NewPhotos, start_px: float, lenses: Lenses) -> float:
    camera = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(start_px, 500.0, 400.0, 0.0))
    model = replace(new.model, cameras=(camera,))
    done = adjust_anchored(model, list(new.keypoints().values()), FixedPoints.none(), lenses)
    return done.model.cameras[0].focal_px


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("known", [Lenses(focal_px={0: CAMERA.focal_px}), Lenses(lent={0: CAMERA})])
def test_over_flat_ground_what_is_known_of_a_lens_decides(known: Lenses) -> None:
    for seed in range(2):
        new = nadir_line(seed)
        free = focal_after(new, 1.1 * CAMERA.focal_px, Lenses())
        held = focal_after(new, 1.1 * CAMERA.focal_px, known)
        assert abs(held / CAMERA.focal_px - 1.0) < 0.005
        assert abs(free / CAMERA.focal_px - 1.0) > 4.0 * abs(held / CAMERA.focal_px - 1.0)


@pytest.mark.usefixtures("wide")
def test_a_wrong_focal_length_of_exif_loses_to_photos_that_know() -> None:
    """Photos from many directions tell the focal length; EXIF names that of another mode of the camera."""
    rng = np.random.default_rng(4)
    points = rng.uniform((-15, -15, 0), (15, 15, 12), (400, 3))
    around = zip(np.arange(6), (8, 25) * 3, strict=True)
    places = [np.array([40 * np.cos(a), 40 * np.sin(a), h]) for a, h in around]
    new = take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        [looking_at(place, np.array([0.0, 0.0, 5.0])) for place in places],
        sfm_from_local=Sim3.identity(),
        noise_px=0.5,
        point_noise_m=0.05,
        pose_noise_m=0.05,
    )
    wrong = Lenses(focal_px={0: 1.3 * CAMERA.focal_px})
    assert focal_after(new, 1.05 * CAMERA.focal_px, wrong) == pytest.approx(CAMERA.focal_px, rel=0.005)
