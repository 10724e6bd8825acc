"""Structure projection of maps whose true place is known: placement, honesty, and every gate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.feature_map import FeatureMap
from ingest.register.structure.projection import project_structure, structure_pairs
from tests.support.scanned_map import (
    FRAME,
    ScannedMap,
    placed_by_similarity,
    plain_cloud,
    scanned_map,
)


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds, and the same answers."""
    monkeypatch.setattr("ingest.register.structure.projection._RENDER_WIDTH_PX", 500)


@pytest.fixture(scope="module")
def world() -> ScannedMap:
    return scanned_map()


def _errors(placed: FeatureMap, world: ScannedMap) -> FloatArray:
    seen = np.unique(placed.observations.point_index)
    return np.asarray(np.linalg.norm(placed.points_local(FRAME) - world.true_points, axis=1)[seen])


def test_one_exact_frame_puts_the_map_back(world: ScannedMap) -> None:
    structure = project_structure(world.feature_map, {4: world.registered(4)}, world.cloud)
    assert structure.accepted, structure.message
    placed = placed_by_similarity(world.feature_map, structure, world.cloud)
    assert _errors(world.feature_map, world).mean() > 8.0
    assert _errors(placed, world).mean() < 0.05
    for image, pose in zip(placed.images, world.true_poses, strict=True):
        assert np.linalg.norm(image.cam_from_local.center - pose.center) < 0.15
        assert image.cam_from_local.angle_to_deg(pose) < 0.15


def test_three_frames_are_better_than_one(world: ScannedMap) -> None:
    """Each frame is off by some centimetres and some hundredths of a degree, its own way."""
    means = []
    for frames in ((4,), (0, 4, 8)):
        rows = []
        for seed in range(5):
            rng = np.random.default_rng(seed)
            registered = {
                k: world.registered(
                    k,
                    error=np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 0.03, 3)]),
                    sigma_deg=0.0286,
                    sigma_m=0.03,
                )
                for k in frames
            }
            structure = project_structure(world.feature_map, registered, world.cloud)
            rows.append(
                _errors(placed_by_similarity(world.feature_map, structure, world.cloud), world).mean()
            )
        means.append(np.mean(rows))
    assert means[1] < means[0]
    assert means[1] < 0.06


def test_covariance_covers_what_frames_are_off_by(world: ScannedMap) -> None:
    squared = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        error = np.concatenate([rng.normal(0, 5e-4, 3), rng.normal(0, 0.03, 3)])
        frame = world.registered(4, error=error, sigma_deg=0.0286, sigma_m=0.03)
        structure = project_structure(world.feature_map, {4: frame}, world.cloud)
        assert structure.new_from_old is not None
        assert structure.covariance is not None
        off = (world.back @ structure.new_from_old.inverse()).log()
        squared.append(float(off @ np.linalg.solve(structure.covariance, off)))
    assert np.mean(np.array(squared) <= chi2.ppf(0.95, 7)) >= 0.8
    assert np.mean(squared) > 0.2 * 7  # not by exaggeration


def test_pairs_move_with_their_frame_as_the_jacobian_says(world: ScannedMap) -> None:
    step = np.array([2e-4, -1e-4, 3e-4, 0.01, 0.02, -0.015])
    source = world.feature_map.points_local(FRAME)
    both = []
    for error in (-0.5 * step, 0.5 * step):
        frame = world.registered(4, error=error)
        both.append(structure_pairs(world.feature_map, source, {4: frame}, world.cloud))
    east = [pairs.source[:, 0] for pairs in both]  # no two points share it
    common, first, second = np.intersect1d(*east, return_indices=True)
    assert len(common) > 100
    moved = both[1].target[second] - both[0].target[first]
    predicted = both[0].by_frame[first] @ step
    assert np.median(np.linalg.norm(moved - predicted, axis=1)) < 0.2 * np.median(
        np.linalg.norm(moved, axis=1)
    )


def test_the_cloud_s_frame_need_not_be_the_map_s(world: ScannedMap) -> None:
    """The scan's local frame lies 3 km away and is tilted by the Earth's curvature."""
    from featuredb.geo.local_frame import LocalFrame

    other = LocalFrame(latitude_deg=48.12, longitude_deg=11.47, height_m=600.0)
    there = other.enu_from(FRAME)
    moved = plain_cloud(there.act(world.cloud.xyz.astype(np.float64)))
    cloud = replace(moved, frame=other)
    frame = world.registered(4)
    pose = frame.cam_from_local
    assert pose is not None
    moved_frame = replace(frame, cam_from_local=pose @ there.inverse())
    structure = project_structure(world.feature_map, {4: moved_frame}, cloud)
    placed = placed_by_similarity(world.feature_map, structure, cloud)
    assert _errors(placed, world).mean() < 0.05
    assert placed.frame == FRAME
    # The covariance is of the map's own frame: near its points it is small, not multiplied by 3 km.
    jacobian = point_jacobian(world.true_points[:50])
    spread = np.einsum("nij,jk,nik->ni", jacobian, placed.placement.covariance, jacobian)
    assert np.sqrt(spread.max()) < 0.3


def test_too_few_points_on_the_scan_are_refused(world: ScannedMap) -> None:
    corner = world.cloud.xyz[(world.cloud.xyz[:, 0] > 12) & (world.cloud.xyz[:, 1] > 12)]
    structure = project_structure(world.feature_map, {4: world.registered(4)}, plain_cloud(corner))
    assert structure.reason == "TOO_FEW_PAIRS"
    assert structure.new_from_old is None


def test_pairs_on_a_strip_are_refused(world: ScannedMap, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = world.feature_map.observations
    # Where x is zero the ground is level along y.
    kept = np.abs(world.true_points[seen.point_index, 0]) < 1.2
    strip = replace(
        world.feature_map,
        observations=replace(seen, **{name: getattr(seen, name)[kept] for name in seen.__dataclass_fields__}),
    )
    monkeypatch.setattr("ingest.register.structure.projection._MIN_PAIRS", 6)
    structure = project_structure(strip, {4: world.registered(4)}, world.cloud)
    assert structure.reason == "NO_SPREAD"


def test_a_map_of_another_size_is_refused() -> None:
    shrunk = scanned_map(placed_by=Sim3(scale=0.8, rotation=np.eye(3), translation=np.zeros(3)))
    structure = project_structure(shrunk.feature_map, {4: shrunk.registered(4)}, shrunk.cloud)
    assert structure.reason == "SCALE"
    assert "22.3%" in structure.message  # log(1 / 0.8)


def test_the_projection_is_repeatable(world: ScannedMap) -> None:
    frames = {k: world.registered(k) for k in (4, 0)}
    first, second = (project_structure(world.feature_map, frames, world.cloud) for _ in range(2))
    assert first.new_from_old is not None
    assert second.new_from_old is not None
    assert np.array_equal(first.new_from_old.matrix(), second.new_from_old.matrix())


def test_identity_is_not_an_answer(world: ScannedMap) -> None:
    """What comes out is the known move, and not merely something that fits."""
    structure = project_structure(world.feature_map, {4: world.registered(4)}, world.cloud)
    assert structure.new_from_old is not None
    off = (structure.new_from_old @ world.back.inverse()).log()
    assert np.abs(off[:4]).max() < 4e-3
    assert np.linalg.norm(structure.new_from_old.act(np.zeros(3)) - world.back.act(np.zeros(3))) < 0.1
    assert np.linalg.norm(Rigid3.identity().act(np.zeros(3)) - world.back.act(np.zeros(3))) > 8.0
