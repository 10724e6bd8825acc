"""Adjustment by a scan: it mends a lens that a similarity cannot, and refuses what contradicts the photos."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import LensWidths, Terms, lens_prior
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from ingest.colmap.precision import linearise
from ingest.register.block import block_of_map, map_of_block
from ingest.register.frame_registration import FrameRegistration
from ingest.register.structure.adjustment import LidarAdjustment, adjust_to_scan, placed_map
from ingest.register.structure.projection import StructurePlacement, project_structure
from tests.support.scanned_map import (
    CAMERA,
    FRAME,
    ScannedMap,
    placed_by_similarity,
    plain_cloud,
    scanned_map,
)

_ADJUSTMENT = "ingest.register.structure.adjustment"
_STIFF = LensWidths(focal_rel=1e-6, aspect_rel=0.002, center_rel=1e-6, radial=1e-6, tangential=1e-6)
_LONG = 1.15  # how much longer the wrong lens is


@pytest.fixture(scope="module")
def world() -> ScannedMap:
    return scanned_map()


@pytest.fixture(scope="module")
def wrong_lens(world: ScannedMap) -> ScannedMap:
    """The same map with a focal length 15 % too long, as nadir photos let it: adjusted without a scan.

    Heights and camera heights stretch with the focal length; the reprojection errors hardly tell.
    """
    truth = block_of_map(world.feature_map).moved(world.back)
    middle = np.array([1.0, 1.0, _LONG])
    stretched = replace(
        truth,
        cameras=(CAMERA.with_focal(CAMERA.focal_px * _LONG),),
        cam_from_block=tuple(
            Rigid3(rotation=p.rotation, translation=-p.rotation @ (p.center * middle))
            for p in truth.cam_from_block
        ),
        xyz=truth.xyz * middle,
    )
    held = LensWidths(focal_rel=1e-6, aspect_rel=1e-6, center_rel=1e-6, radial=0.1, tangential=0.1)
    terms = Terms(keypoint_px=0.5, lenses=(lens_prior(stretched.cameras[0], held),))
    problem = Problem(stretched, terms)
    problem.solve(30, 1e-5)
    settled = problem.block().moved(world.back.inverse())
    wrong = map_of_block(
        world.feature_map, settled, FRAME, world.feature_map.placement, world.feature_map.height_datum
    )
    return replace_map(world, wrong)


def replace_map(world: ScannedMap, feature_map: FeatureMap) -> ScannedMap:
    return replace(world, feature_map=feature_map)


def _registered_by_its_lens(
    world: ScannedMap, image: int, seed: int, correspondences: int = 150
) -> FrameRegistration:
    """A frame registered through the map's wrong lens: its pose is the one that fits its correspondences."""
    found = world.registered(image, correspondences=correspondences, seed=seed)
    lens = world.feature_map.cameras[0]
    pose, none = found.cam_from_local, np.zeros(len(found.pixels), np.int64)
    assert pose is not None
    for _ in range(20):
        linear = linearise(
            (lens,), none[:1], [pose], found.points_local, np.arange(len(none)), none, found.pixels
        )
        jacobian = linear.by_pose.reshape(-1, 6)
        pose = Rigid3.exp(np.linalg.lstsq(jacobian, linear.residual.ravel(), rcond=None)[0]) @ pose
    return replace(found, cam_from_local=pose, camera=lens)


def _heights_off(feature_map: FeatureMap, world: ScannedMap) -> FloatArray:
    return np.array(
        [
            i.cam_from_local.center[2] - p.center[2]
            for i, p in zip(feature_map.images, world.true_poses, strict=True)
        ]
    )


def _adjusted(
    world: ScannedMap, frames: tuple[int, ...], correspondences: int = 150
) -> tuple[StructurePlacement, LidarAdjustment]:
    registered = {
        k: _registered_by_its_lens(world, k, seed, correspondences) for seed, k in enumerate(frames)
    }
    structure = project_structure(world.feature_map, registered, world.cloud)
    assert structure.accepted, structure.message
    return structure, adjust_to_scan(world.feature_map, structure, registered, world.cloud)


def test_the_fixture_is_as_treacherous_as_it_says(wrong_lens: ScannedMap) -> None:
    block = block_of_map(wrong_lens.feature_map)
    residual = linearise(
        block.cameras,
        block.camera_of,
        block.cam_from_block,
        block.xyz,
        block.point_of,
        block.photo_of,
        block.xy,
    ).residual
    assert np.median(np.linalg.norm(residual, axis=1)) < 1.0


@pytest.mark.parametrize("frames", [(4,), (0, 4, 8)])
@pytest.mark.evaluation
def test_the_scan_mends_the_lens(wrong_lens: ScannedMap, frames: tuple[int, ...]) -> None:
    structure, adjustment = _adjusted(wrong_lens, frames)
    assert adjustment.accepted, adjustment.message
    by_similarity = placed_by_similarity(wrong_lens.feature_map, structure, wrong_lens.cloud)
    by_scan = placed_map(wrong_lens.feature_map, structure, wrong_lens.cloud, adjustment)
    # The similarity lays the points on the ground and leaves the cameras metres too high.
    assert np.abs(_heights_off(by_similarity, wrong_lens)).min() > 3.0
    assert np.abs(_heights_off(by_scan, wrong_lens)).max() < 0.5
    assert by_scan.cameras[0].focal_px == pytest.approx(CAMERA.focal_px, rel=0.01)
    seen = np.unique(by_scan.observations.point_index)
    errors = np.linalg.norm(by_scan.points_local(FRAME) - wrong_lens.true_points, axis=1)[seen]
    assert np.median(errors) < 0.06
    after = adjustment.figures["after"]
    assert after["reprojection_median_px"] < 1.0
    assert after["surface_median_m"] < adjustment.figures["before"]["surface_median_m"]


def test_the_adjusted_map_keeps_what_is_not_geometry(world: ScannedMap) -> None:
    structure, adjustment = _adjusted(world, (4,))
    before = world.feature_map
    after = placed_map(before, structure, world.cloud, adjustment)
    assert after.map_id == before.map_id
    assert after.frame == before.frame
    assert after.height_datum == world.cloud.height_datum
    assert after.placement.method == "lidar"
    assert after.placement.evidence["replaces"] == "gps"
    assert after.generation == 0
    assert [i.sha256 for i in after.images] == [i.sha256 for i in before.images]
    assert np.array_equal(after.observations.xy, before.observations.xy)


def test_a_right_lens_stays(world: ScannedMap) -> None:
    structure, adjustment = _adjusted(world, (0, 4, 8))
    assert adjustment.accepted, adjustment.message
    after = placed_map(world.feature_map, structure, world.cloud, adjustment)
    assert after.cameras[0].focal_px == pytest.approx(CAMERA.focal_px, rel=0.005)
    for image, pose in zip(after.images, world.true_poses, strict=True):
        assert np.linalg.norm(image.cam_from_local.center - pose.center) < 0.3


def test_no_scan_under_the_map_is_refused(world: ScannedMap) -> None:
    registered = {4: world.registered(4, correspondences=150)}
    structure = project_structure(world.feature_map, registered, world.cloud)
    away = plain_cloud(world.cloud.xyz + np.array([900.0, 0.0, 0.0]))
    assert adjust_to_scan(world.feature_map, structure, registered, away).reason == "NO_SCAN"


def test_frames_that_contradict_the_map_are_refused(world: ScannedMap) -> None:
    """Each fits its own correspondences; two have them a metre and a half further apart than the map."""
    right = {k: world.registered(k, correspondences=150) for k in (0, 4, 8)}
    structure = project_structure(world.feature_map, right, world.cloud)
    apart = {0: -0.75, 4: 0.0, 8: 0.75}
    pulled = {
        k: replace(r, points_local=r.points_local + np.array([apart[k], apart[k], 0.0]))
        for k, r in right.items()
    }
    adjustment = adjust_to_scan(world.feature_map, structure, pulled, world.cloud)
    assert adjustment.reason == "CONTROL"
    assert not adjustment.accepted
    assert adjustment.figures["own"]["own_px"] == pytest.approx(0.5, rel=0.2)


def test_frames_that_lie_elsewhere_are_refused(world: ScannedMap) -> None:
    """Each agrees with its own correspondences, 3.6 m off its own way: one map cannot have all."""
    error = np.array([0.0, 0.0, 0.0, 3.0, 2.0, 0.0])
    elsewhere = {}
    for k in (0, 4, 8):
        found, true = world.registered(k, error=error, correspondences=150), world.true_poses[k]
        assert found.cam_from_local is not None
        moved = (found.cam_from_local.inverse() @ true).act(found.points_local)
        elsewhere[k] = replace(found, points_local=moved)
    structure = project_structure(world.feature_map, elsewhere, world.cloud)
    assert structure.accepted, structure.message  # a similarity cannot tell: maps bend
    assert adjust_to_scan(world.feature_map, structure, elsewhere, world.cloud).reason == "CONTROL"


def test_a_bent_map_is_straightened(world: ScannedMap) -> None:
    """1.6 m at 20 m, as much as no similarity explains."""
    points = world.feature_map.points_local(FRAME)
    points[:, 2] += 0.004 * (points[:, 0] ** 2 + points[:, 1] ** 2)
    utm = FRAME.utm_from_enu(points, world.feature_map.epsg)
    bent = replace(world.feature_map, points=replace(world.feature_map.points, utm=utm))
    registered = {4: world.registered(4, correspondences=150)}
    structure = project_structure(bent, registered, world.cloud)
    adjustment = adjust_to_scan(bent, structure, registered, world.cloud)
    assert adjustment.accepted, adjustment.message
    after = placed_map(bent, structure, world.cloud, adjustment)
    seen = np.unique(after.observations.point_index)
    assert np.median(np.linalg.norm(after.points_local(FRAME) - world.true_points, axis=1)[seen]) < 0.05
    for image, pose in zip(after.images, world.true_poses, strict=True):
        assert np.linalg.norm(image.cam_from_local.center - pose.center) < 0.15


def test_coarse_correspondences_that_agree_are_no_contradiction(world: ScannedMap) -> None:
    """Pieces of a sparse scan's intensities: off by five pixels each, in a photo of 1,200."""
    rng = np.random.default_rng(5)
    right = {k: world.registered(k, correspondences=60) for k in (0, 4, 8)}
    coarse = {k: replace(r, pixels=r.pixels + rng.normal(0.0, 5.0, r.pixels.shape)) for k, r in right.items()}
    structure = project_structure(world.feature_map, coarse, world.cloud)
    adjustment = adjust_to_scan(world.feature_map, structure, coarse, world.cloud)
    assert adjustment.accepted, adjustment.message
    after = placed_map(world.feature_map, structure, world.cloud, adjustment)
    for image, pose in zip(after.images, world.true_poses, strict=True):
        assert np.linalg.norm(image.cam_from_local.center - pose.center) < 0.3


def test_bending_the_photos_to_the_scan_is_refused(
    world: ScannedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Waves that are not there, and tracks that are hardly trusted: the map bends, and its photos tell."""
    registered = {k: world.registered(k, correspondences=150) for k in (0, 4, 8)}
    structure = project_structure(world.feature_map, registered, world.cloud)
    xyz = world.cloud.xyz.astype(np.float64)
    xyz[:, 2] += 0.4 * np.sin(xyz[:, 0] / 2.0) * np.sin(xyz[:, 1] / 2.0)
    monkeypatch.setattr(f"{_ADJUSTMENT}._MIN_SIGMA_REL", 0.05)
    adjustment = adjust_to_scan(world.feature_map, structure, registered, plain_cloud(xyz))
    assert adjustment.reason == "REPROJECTION"


def test_an_adjustment_that_does_not_gain_is_refused(
    world: ScannedMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control that pulls the map off the scan: correspondences all 2 m too high."""
    registered = {k: world.registered(k, correspondences=150) for k in (0, 4, 8)}
    structure = project_structure(world.feature_map, registered, world.cloud)
    up = np.array([0.0, 0.0, 2.0])
    high = {k: replace(r, points_local=r.points_local + up) for k, r in registered.items()}
    monkeypatch.setattr(f"{_ADJUSTMENT}._REACH_M", 5.0)
    monkeypatch.setattr(f"{_ADJUSTMENT}._MIN_SURFACE_M", 5.0)
    assert adjust_to_scan(world.feature_map, structure, high, world.cloud).reason == "SURFACE"


def test_a_lens_that_folds_is_refused(world: ScannedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """A barrel so strong that the polynomial turns back inside the picture."""
    folding = Camera(model="RADIAL", width=1200, height=900, params=(1000.0, 600.0, 450.0, -0.9, 0.0))
    assert folding.tan_of_fold < 0.75  # the corner is at 0.75
    bad = replace(world.feature_map, cameras=(folding,))
    registered = {4: world.registered(4, correspondences=150)}
    structure = project_structure(world.feature_map, registered, world.cloud)
    monkeypatch.setattr(f"{_ADJUSTMENT}.lens_prior_of", lambda camera, *_: lens_prior(camera, _STIFF))
    monkeypatch.setattr(f"{_ADJUSTMENT}._ROUNDS", 1)
    monkeypatch.setattr(f"{_ADJUSTMENT}._STEPS", 1)
    assert adjust_to_scan(bad, structure, registered, world.cloud).reason == "LENS"


def test_the_placement_s_similarity_is_next_to_the_truth(world: ScannedMap) -> None:
    structure, adjustment = _adjusted(world, (0, 4, 8))
    after = placed_map(world.feature_map, structure, world.cloud, adjustment)
    assert np.abs(Sim3.log(after.placement.local_from_sfm)[:4]).max() < 0.01


@pytest.mark.parametrize("correspondences", [20, 150])
def test_the_covariances_cover_the_cameras(wrong_lens: ScannedMap, correspondences: int) -> None:
    """One frame's correspondences leave the lens' doubt in every camera: it is in the poses' covariances."""
    structure, adjustment = _adjusted(wrong_lens, (4,), correspondences)
    assert adjustment.accepted, adjustment.message
    assert structure.covariance is not None
    after = placed_map(wrong_lens.feature_map, structure, wrong_lens.cloud, adjustment)
    squared = []
    for image, true in zip(after.images, wrong_lens.true_poses, strict=True):
        assert image.covariance is not None
        to_center = -image.cam_from_local.rotation.T
        shape = to_center @ image.covariance[3:, 3:] @ to_center.T
        off = image.cam_from_local.center - true.center
        squared.append(off @ np.linalg.solve(shape + structure.covariance[4:, 4:], off))
        assert np.sqrt(np.trace(shape)) < 1.0  # and still decimetres
    assert np.median(squared) < 6.3  # 90 % of a chi-square of three
    assert max(squared) < 16.3  # 99.9 %
