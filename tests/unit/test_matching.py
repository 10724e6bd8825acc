"""2D-3D matches against the correspondences that made the scene."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.features.features import Features
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.descriptor_index import DescriptorIndex
from reloc.localise.candidates import Cluster, IndexedArea
from reloc.localise.matching import (
    EXPECTED_DEG,
    POSSIBLE_DEG,
    ClusterMatcher,
    Matches,
    guided_matches,
    visible_points,
)
from reloc.localise.options import PointMatchOptions
from tests.support.scenes import (
    CAMERA,
    box_points,
    indexed,
    looking_at,
    pixels_inside,
    query_features,
    random_descriptors,
    ring,
    scene_map,
)

OPTIONS = PointMatchOptions()


def match_cluster(features: Features, cluster: Cluster, options: PointMatchOptions) -> Matches:
    return ClusterMatcher(features, cluster, options).matches(len(features))


POSE = looking_at(np.array([38.0, 22.0, 33.0]), np.array([0.0, 0.0, 3.0]))
RNG = np.random.default_rng(0)
POINTS, DESCRIPTORS = box_points(RNG, 200), random_descriptors(RNG, 200)


def whole(area: IndexedArea) -> Cluster:
    return Cluster(
        area=area.area,
        images=np.arange(len(area.area.image_map)),
        points=np.arange(len(area.area.points), dtype=np.int32),
        score=np.inf,
    )


def photo(seed: int = 1) -> tuple[Features, np.ndarray]:
    """Features of a photo by POSE, and which point each of them shows."""
    rng = np.random.default_rng(seed)
    pixels, inside = pixels_inside(CAMERA, POSE, POINTS)
    rows = np.flatnonzero(inside)
    return query_features(rng, pixels[rows], DESCRIPTORS[rows]), rows


def one_map(**changes: object) -> IndexedArea:
    options = {"points": POINTS, "descriptors": DESCRIPTORS, "poses": ring(6)} | changes
    return indexed(scene_map(**options))  # type: ignore[arg-type]


def test_every_feature_finds_its_point() -> None:
    features, truth = photo()
    area = one_map()
    matches = match_cluster(features, whole(area), OPTIONS)
    assert len(matches) == len(features) > 150
    np.testing.assert_array_equal(area.area.point_row[matches.point], truth[matches.feature])


def test_the_ratio_test_refuses_what_is_there_twice() -> None:
    """Half of the points have a twin with the same look elsewhere in the same map."""
    twins = DESCRIPTORS.copy()
    twins[100:] = DESCRIPTORS[:100]
    features, _ = photo()
    area = one_map(descriptors=twins)
    matches = match_cluster(features, whole(area), OPTIONS)
    assert len(matches) <= 2  # noise makes a few differ
    lenient = match_cluster(features, whole(area), replace(OPTIONS, ratio=1.01))
    assert len(lenient) > 50  # it is the ratio that refuses


def test_a_broken_track_does_not_compete_with_itself() -> None:
    points = np.concatenate([POINTS, POINTS[:80] + 0.01])
    descriptors = np.concatenate([DESCRIPTORS, DESCRIPTORS[:80]])
    area = one_map(points=points, descriptors=descriptors)
    features, truth = photo()
    matches = match_cluster(features, whole(area), OPTIONS)
    found = area.area.point_row[matches.point]
    assert len(matches) == len(features)
    np.testing.assert_array_equal(np.where(found >= 200, found - 200, found), truth[matches.feature])


def test_a_second_map_of_the_place_does_not_disturb_the_first() -> None:
    features, _ = photo()
    first = scene_map(points=POINTS, descriptors=DESCRIPTORS, poses=ring(6), map_id="a")
    second = scene_map(points=POINTS + 0.7, descriptors=DESCRIPTORS, poses=ring(6), map_id="b", seed=5)
    alone = match_cluster(features, whole(indexed(first)), OPTIONS)
    area = indexed(first, second)
    both = match_cluster(features, whole(area), OPTIONS)
    of_first = area.area.map_of(both.point) == 0
    np.testing.assert_array_equal(np.sort(both.feature[of_first]), np.sort(alone.feature))
    assert (~of_first).sum() == len(alone)


def test_one_to_one_in_features_points_and_places() -> None:
    """The photo has each keypoint twice (two orientations), and twice more nearby, of the same look."""
    features, _ = photo()
    order = np.tile(np.arange(len(features)), 3)
    many = features.take(order)
    shifted = many.xy.copy()
    shifted[2 * len(features) :] += 6.0
    many = replace(many, xy=shifted)
    matches = match_cluster(many, whole(one_map()), OPTIONS)
    assert len(np.unique(matches.point)) == len(matches) == len(features)
    assert len(np.unique(many.xy[matches.feature].round(1), axis=0)) == len(matches)


def test_more_features_are_matched_as_if_they_had_come_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two maps of one place; the neighbours of a feature are looked for once in each."""
    first, second = (scene_map(points=POINTS, descriptors=DESCRIPTORS, poses=ring(6), map_id=m) for m in "ab")
    features, _ = photo()
    cluster = whole(indexed(first, second))
    asked: list[int] = []
    honest = DescriptorIndex.search

    def counted(index: DescriptorIndex, query: np.ndarray, k: int) -> np.ndarray:
        asked.append(len(query))
        return honest(index, query, k)

    monkeypatch.setattr(DescriptorIndex, "search", counted)
    matcher = ClusterMatcher(features, cluster, OPTIONS)
    for count in (20, 90, 50, len(features), len(features) + 10):
        at_once = match_cluster(features.take(np.arange(min(count, len(features)))), cluster, OPTIONS)
        asked.clear()
        matches = matcher.matches(count)
        for name in ("feature", "point"):
            np.testing.assert_array_equal(getattr(matches, name), getattr(at_once, name))
        expected = {20: [20, 20], 90: [70, 70], len(features): [len(features) - 90] * 2}.get(count, [])
        assert asked == expected


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_and_few_features(count: int) -> None:
    area = one_map()
    features, _ = photo()
    few = replace(whole(area), points=np.arange(count, dtype=np.int32))
    assert len(match_cluster(features, few, OPTIONS)) <= count
    assert len(match_cluster(features.take(np.arange(count)), whole(area), OPTIONS)) == count
    points = np.arange(count, dtype=np.int32)
    assert len(guided_matches(features, area.area, points, CAMERA, POSE, OPTIONS)) <= count


def test_guided_matches_are_near_their_projection_and_look_alike() -> None:
    features, truth = photo()
    area = one_map()
    points = np.arange(len(area.area.points), dtype=np.int32)
    turned = Rigid3.exp([0, 0.002, 0, 0, 0, 0]) @ POSE  # 1.8 pixels
    matches = guided_matches(features, area.area, points, CAMERA, turned, OPTIONS)
    pixels = CAMERA.project(turned.act(area.area.points[matches.point]))
    gap = np.linalg.norm(pixels - features.xy[matches.feature], axis=1)
    assert gap.max() < OPTIONS.guided_radius_rel * CAMERA.width
    np.testing.assert_array_equal(area.area.point_row[matches.point], truth[matches.feature])
    assert len(matches) > 0.9 * len(features)
    difference = features.descriptors[matches.feature].astype(float) - area.area.descriptors[matches.point]
    assert np.linalg.norm(difference, axis=1).max() < OPTIONS.guided_max_distance
    far = Rigid3.exp([0, 0.02, 0, 0, 0, 0]) @ POSE  # 18 pixels
    astray = guided_matches(features, area.area, points, CAMERA, far, OPTIONS)
    assert len(astray) < 0.05 * len(features)
    strict = replace(OPTIONS, guided_max_distance=1.0)
    assert len(guided_matches(features, area.area, points, CAMERA, POSE, strict)) == 0


def test_visible_points_against_a_loop() -> None:
    area = one_map(poses=ring(6)[:2]).area
    rows = np.arange(len(area.points))
    for pose in (POSE, looking_at(np.array([-40.0, -15.0, 30.0]), np.zeros(3)), ring(6)[0]):
        found = set(visible_points(area, rows, CAMERA, pose).tolist())
        _, inside = pixels_inside(CAMERA, pose, area.points.whole())
        for row in rows:
            toward = pose.center - area.points[np.array(row)]
            toward /= np.linalg.norm(toward)
            off_deg = np.degrees(np.arccos(np.clip(toward @ area.view_direction[np.array([row])][0], -1, 1)))
            cone_deg = np.degrees(float(area.view_spread[np.array(row)])) + 30.0
            assert (row in found) == bool(inside[row] and off_deg <= cone_deg)
    # The two cameras of the map look from the east: from the west nothing is known, nor from below.
    assert len(visible_points(area, rows, CAMERA, ring(6)[0])) > 100
    west = looking_at(np.array([-45.0, -10.0, 20.0]), np.zeros(3))
    below = looking_at(np.array([5.0, 0.0, -40.0]), np.zeros(3))
    for pose in (west, below):
        assert pixels_inside(CAMERA, pose, area.points.whole())[1].sum() > 100
        assert len(visible_points(area, rows, CAMERA, pose)) == 0


def test_points_are_matched_from_farther_aside_than_they_are_expected() -> None:
    """From 50 degrees beside the map's views nothing must be found, and what is found may count."""
    first = ring(6)[0]
    area = one_map(poses=[first]).area
    rows = np.arange(len(area.points))

    def beside(angle_deg: float) -> Rigid3:
        turn = np.radians(angle_deg)
        turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        return looking_at(turned @ first.center, np.zeros(3))

    known = len(visible_points(area, rows, CAMERA, first))
    for angle_deg, expected, possible in ((15.0, 0.8, 0.8), (62.0, 0.0, 0.5), (130.0, 0.0, 0.0)):
        found = [
            len(visible_points(area, rows, CAMERA, beside(angle_deg), beyond))
            for beyond in (EXPECTED_DEG, POSSIBLE_DEG)
        ]
        assert found[0] >= expected * known
        assert found[1] >= possible * known
        if angle_deg > 60.0:
            assert found[0] < 0.1 * known
        if angle_deg > 120.0:
            assert found[1] == 0


def test_nothing_behind_the_camera_is_visible() -> None:
    area = one_map().area
    back = Rigid3.exp([0, np.pi, 0, 0, 0, 0]) @ POSE
    np.testing.assert_allclose(back.center, POSE.center, atol=1e-9)
    assert len(visible_points(area, np.arange(len(area.points)), CAMERA, back)) == 0
    features, _ = photo()
    points = np.arange(len(area.points), dtype=np.int32)
    assert len(guided_matches(features, area, points, CAMERA, back, OPTIONS)) == 0
