"""Areas against the maps that they are made of, point by point."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import IncompatibleExtractorError, InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.index.area import build_area
from featuredb.maps.feature_map import FeatureMap
from tests.support.maps import random_map
from tests.support.scenes import CAMERA, EPSG, box_points, random_descriptors, ring, scene_map

COVARIANCE = (1e-2, 2e-3, 0.0, 4e-2, 1e-3, 9e-2)


def a_map(seed: int = 0, count: int = 80, images: int = 5, **more: object) -> FeatureMap:
    rng = np.random.default_rng(seed)
    return scene_map(
        points=box_points(rng, count),
        descriptors=random_descriptors(rng, count),
        poses=ring(images),
        point_covariance=COVARIANCE,
        seed=seed,
        **more,  # type: ignore[arg-type]
    )


def test_points_views_and_reach_against_loops() -> None:
    feature_map = a_map()
    area = build_area([feature_map])
    local = feature_map.frame.enu_from_utm(feature_map.points.utm, EPSG)
    seen = feature_map.observations
    point_row = area.point_row.whole()
    np.testing.assert_array_equal(point_row, np.unique(seen.point_index))
    np.testing.assert_allclose(area.points.whole(), local[point_row], atol=1e-5)
    centers = np.array([i.cam_from_local.center for i in feature_map.images])
    np.testing.assert_allclose(area.image_center, centers, atol=1e-9)
    directions = area.view_direction[np.arange(len(point_row))]
    for row, index in enumerate(point_row):
        viewers = seen.image_id[seen.point_index == index]
        toward = centers[viewers] - local[index]
        distance = np.linalg.norm(toward, axis=1)
        mean = (toward / distance[:, None]).sum(axis=0)
        mean /= np.linalg.norm(mean)
        np.testing.assert_allclose(directions[row], mean, atol=5e-4)
        outermost = np.arccos((toward @ mean / distance).min())
        assert area.view_spread.whole()[row] == pytest.approx(outermost, abs=1e-3)
        assert area.view_distance.whole()[row] == pytest.approx(
            (distance.min() + distance.max()) / 2, rel=5e-4
        )
        total = seen.descriptors[seen.point_index == index].astype(float).sum(axis=0)
        expected = np.clip(512 * total / np.linalg.norm(total), 0, 255)
        assert np.abs(area.descriptors[np.array(row)] - expected).max() <= 0.51
    for image in range(len(centers)):
        own = local[seen.point_index[seen.image_id == image]]
        np.testing.assert_allclose(area.image_scene[image], np.median(own, axis=0), atol=1e-6)
        reach = np.median(np.linalg.norm(own - centers[image], axis=1))
        assert area.image_reach[image] == pytest.approx(reach, abs=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_what_images_see_and_share_against_sets(seed: int) -> None:
    """random_map has points that one image sees twice, and images whose points carry no descriptor."""
    feature_map = random_map(seed, images=7, observations=150)
    area = build_area([feature_map])
    o = feature_map.observations
    sees = {i: set(o.point_index[(o.image_id == i) & o.has_descriptor].tolist()) for i in range(7)}
    covisible = area.covisible.toarray()
    for i in range(7):
        rows = area.points_of_images(np.array([i]))
        assert set(area.point_row[rows].tolist()) == sees[i]
        assert area.image_sights[i] == ((o.image_id == i) & o.has_descriptor).sum()
        for j in range(7):
            assert covisible[i, j] == len(sees[i] & sees[j])
    both = area.points_of_images(np.array([2, 5]))
    assert set(area.point_row[both].tolist()) == sees[2] | sees[5]
    assert (np.diff(both) > 0).all()
    assert len(area.points_of_images(np.zeros(0, dtype=np.intp))) == 0


def test_covariances_in_half_precision() -> None:
    """From a millimetre to a hundred metres, flat ones, nothing at all, and what is no number."""
    rng = np.random.default_rng(8)
    half = rng.normal(size=(8, 3, 3)) * 10.0 ** np.linspace(-3, 2, 8)[:, None, None]
    half[1] = np.outer([0.01, 0.02, 0.03], [1.0, 0.0, 0.0])
    half[2] = 0.0
    true = half @ np.swapaxes(half, 1, 2)
    upper = true[:, *np.triu_indices(3)].astype(np.float32)
    upper[3] = np.nan
    feature_map = a_map()
    feature_map.points.covariance.setflags(write=True)
    feature_map.points.covariance[:8] = upper
    kept = build_area([feature_map]).point_covariance(np.arange(8))
    for i in (0, 1, 2, 4, 5, 6, 7):
        np.testing.assert_allclose(kept[i], true[i], atol=2e-3 * np.abs(true[i]).max())
    np.testing.assert_allclose(kept[3], 65504.0**2 * np.eye(3), atol=1.0)


def test_two_maps_of_two_frames_and_zones_lie_in_one_frame() -> None:
    """The same ground, once in zone 32 and once in zone 33, from frames 40 km and some degrees apart."""
    rng = np.random.default_rng(4)
    points, descriptors, poses = box_points(rng, 50), random_descriptors(rng, 50), ring(4)
    here = LocalFrame(latitude_deg=50.0, longitude_deg=11.99, height_m=200.0)
    away = LocalFrame(latitude_deg=50.3, longitude_deg=12.2, height_m=500.0)
    away_from_here = away.enu_from(here)
    options = {"descriptors": descriptors, "point_covariance": COVARIANCE}
    one = scene_map(points=points, poses=poses, frame=here, epsg=32632, map_id="a", **options)
    two = scene_map(
        points=away_from_here.act(points),
        poses=[pose @ away_from_here.inverse() for pose in poses],
        frame=away,
        epsg=32633,
        map_id="b",
        **options,
    )
    area = build_area([one, two], frame=here)
    assert [len(m.observations) for m in area.maps] == [0, 0]
    first, second = (area.map_of(np.arange(len(area.points))) == i for i in (0, 1))
    assert first.sum() == second.sum() > 30
    np.testing.assert_allclose(
        area.points[np.flatnonzero(first)], area.points[np.flatnonzero(second)], atol=2e-4
    )
    np.testing.assert_allclose(
        area.points[np.flatnonzero(first)], points[area.point_row[np.flatnonzero(first)]], atol=2e-4
    )
    here_seen, there_seen = (area.view_direction[np.flatnonzero(part)] for part in (first, second))
    np.testing.assert_allclose(here_seen, there_seen, atol=1e-3)
    np.testing.assert_allclose(area.image_center[:4], area.image_center[4:], atol=1e-6)
    # Covariances turn with the axes: the east-north one of the far map is not that of this frame's axes.
    turn = away_from_here.rotation.T
    ee, en, eu, nn, nu, uu = COVARIANCE
    full = np.array([[ee, en, eu], [en, nn, nu], [eu, nu, uu]])
    np.testing.assert_allclose(
        area.point_covariance(np.flatnonzero(first))[0], full, atol=1e-3 * np.abs(full).max()
    )
    np.testing.assert_allclose(
        area.point_covariance(np.flatnonzero(second))[0], turn @ full @ turn.T, atol=1e-3 * np.abs(full).max()
    )
    assert np.abs(turn - np.eye(3)).max() > 2e-3  # it has something to turn
    # Images of different maps that look at one place count as sharing.
    assert area.covisible[0, 4] > 0
    assert build_area([one, two]).frame == max((one, two), key=lambda m: len(m.points)).frame


def test_which_images_see_points_of_several_maps() -> None:
    maps = [a_map(0, map_id="a"), a_map(1, map_id="b", east_m=200.0), a_map(2, map_id="c", east_m=400.0)]
    area = build_area(maps)
    rows = np.sort(np.random.default_rng(3).choice(len(area.points), 40, replace=False))
    images, position = area.images_that_see(rows)
    pairs = set(zip(images.tolist(), position.tolist(), strict=True))
    for image in range(len(area.image_map)):
        sees = area.points_of_images(np.array([image]))
        assert {p for i, p in pairs if i == image} == set(np.flatnonzero(np.isin(rows, sees)).tolist())
    assert len(pairs) == len(images)
    counted = area.sums_over_sights(rows, np.ones(len(rows)))
    np.testing.assert_array_equal(counted, np.bincount(images, minlength=len(area.image_map)))
    assert [len(part) for part in area.images_that_see(rows[:0])] == [0, 0]


def test_maps_that_look_elsewhere_do_not_share() -> None:
    area = build_area([a_map(0, map_id="a"), a_map(1, map_id="b", east_m=200.0)])
    assert area.covisible[:5, 5:].nnz == 0


def test_no_maps_and_mixed_extractors_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="at least one map"):
        build_area([])
    with pytest.raises(IncompatibleExtractorError, match="share an extractor"):
        build_area([a_map(0), a_map(1, map_id="b", fingerprint="other")])


def test_a_map_without_descriptors_gives_an_empty_area() -> None:
    area = build_area([random_map(0, observations=0)])
    assert area.points.whole().shape == (0, 3)
    assert area.descriptors.whole().shape == (0, 128)
    assert area.covisible.nnz == 0
    assert (area.image_reach == 0).all()


def test_the_camera_of_a_key_comes_from_the_largest_map() -> None:
    other = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(901.0, 500, 400, 0.0))
    small = a_map(0, images=3, map_id="a", camera_keys=("DJI",))
    large = replace(a_map(1, images=6, map_id="b", camera_keys=("DJI",)), cameras=(other,))
    area = build_area([small, large])
    assert area.camera_for_key("DJI") == other
    assert build_area([small]).camera_for_key("DJI") == CAMERA
    assert area.camera_for_key("GoPro") is None
    assert build_area([a_map(0, camera_keys=("",))]).camera_for_key("") is None


def test_images_of_all_maps_with_one_lens_count_together_and_fuller_models_come_first() -> None:
    lenses = [
        Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(900.0 + k, 500, 400, 0.0))
        for k in range(2)
    ]
    maps = [
        replace(
            a_map(k, images=images, map_id=str(k), camera_keys=("DJI",)),
            cameras=(lenses[lens],),
        )
        for k, (images, lens) in enumerate([(3, 0), (5, 1), (4, 0)])
    ]
    assert build_area(maps).camera_for_key("DJI") == lenses[0]
    assert build_area(maps[:2]).camera_for_key("DJI") == lenses[1]
    fuller = Camera(model="RADIAL", width=1000, height=800, params=(905.0, 500, 400, 0.01, 0.0))
    maps.append(replace(a_map(3, images=2, map_id="3", camera_keys=("DJI",)), cameras=(fuller,)))
    assert build_area(maps).camera_for_key("DJI") == fuller
