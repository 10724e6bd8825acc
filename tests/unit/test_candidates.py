"""Where a photo may belong: reach of the prior, votes, clusters."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.features.features import Features
from featuredb.index.area import build_area
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from reloc.localise.candidates import (
    IndexedArea,
    _nearest,
    _Reach,
    find_clusters,
    images_in_reach,
    indexed_together,
)
from reloc.localise.matching import ClusterMatcher
from reloc.localise.options import CandidateOptions, LocaliseOptions
from reloc.localise.search import most_matched
from tests.support.scenes import (
    CAMERA,
    box_points,
    indexed,
    looking_at,
    noisy,
    pixels_inside,
    query_features,
    random_descriptors,
    ring,
    scene_map,
)

VOTING = CandidateOptions(single_cluster_points=0)


def prior_at(area: IndexedArea, east_m: float, north_m: float, sigma_m: float = 5.0) -> GeoPrior:
    lat, lon, h = area.area.frame.geodetic_from_enu(np.array([east_m, north_m, 0.0]))
    return GeoPrior(
        latitude_deg=float(lat),
        longitude_deg=float(lon),
        height_m=float(h) + 40.0,
        sigma_horizontal_m=sigma_m,
        sigma_vertical_m=10.0,
    )


def place(seed: int, east_m: float = 0.0, images: int = 8, map_id: str | None = None) -> FeatureMap:
    rng = np.random.default_rng(seed)
    return scene_map(
        points=box_points(rng, 300),
        descriptors=random_descriptors(rng, 300),
        poses=ring(images),
        east_m=east_m,
        map_id=map_id or f"place-{seed}",
    )


def photo_of(seed: int) -> Features:
    """Features of a photo of `place(seed)`, from a new camera, with as many that belong to nothing."""
    rng = np.random.default_rng(seed)
    points, descriptors = box_points(rng, 300), random_descriptors(rng, 300)
    pixels, inside = pixels_inside(CAMERA, looking_at(np.array([30.0, 40.0, 30.0]), np.zeros(3)), points)
    other = np.random.default_rng(seed + 1000)
    return query_features(
        other,
        np.concatenate([pixels[inside], other.uniform(0, 800, (200, 2))]),
        np.concatenate([descriptors[inside], random_descriptors(other, 200)]),
    )


def test_reach_of_a_prior_ends_where_the_options_say() -> None:
    area = indexed(place(0))
    options = CandidateOptions(prior_sigmas=3.0, prior_reach=2.0)
    reach = area.area.image_reach
    east = area.area.image_center[:, 0].max()
    i = int(np.argmax(area.area.image_center[:, 0]))
    limit = east + 3.0 * 5.0 + 2.0 * reach[i]
    assert images_in_reach(area.area, prior_at(area, limit - 0.5, 0.0), options)[i]
    assert not images_in_reach(area.area, prior_at(area, limit + 0.5, 0.0), options)[i]
    assert images_in_reach(area.area, None, options).all()
    # Height says nothing: drones' heights are off by tens of metres.
    low = replace(prior_at(area, limit - 0.5, 0.0), height_m=None)
    assert images_in_reach(area.area, low, options)[i]


@pytest.mark.parametrize("far", ["antipode", "quarter"])
def test_a_prior_on_the_other_side_of_the_earth_is_out_of_reach(far: str) -> None:
    """Straight below the frame, horizontal distances come back to zero."""
    area = indexed(place(0))
    frame = area.area.frame
    prior = GeoPrior(
        latitude_deg=-frame.latitude_deg if far == "antipode" else frame.latitude_deg - 89.0,
        longitude_deg=frame.longitude_deg - 180.0 if far == "antipode" else frame.longitude_deg,
        height_m=None,
        sigma_horizontal_m=10.0,
        sigma_vertical_m=10.0,
    )
    assert not images_in_reach(area.area, prior, CandidateOptions()).any()
    assert find_clusters([area], photo_of(0), prior, CandidateOptions()) == []


def test_a_prior_keeps_only_the_images_near_it() -> None:
    """Two places 1,200 m apart in one area."""
    area = indexed(place(0, map_id="a"), place(1, east_m=1200.0, map_id="b"))
    (cluster,) = find_clusters([area], photo_of(0), prior_at(area, 1200.0, 10.0), CandidateOptions())
    assert (area.area.image_map[cluster.images] == 1).all()
    assert (area.area.map_of(cluster.points) == 1).all()
    assert len(cluster.images) == 8
    # Beyond a prior that was tried in vain is all the rest.
    (other,) = find_clusters([area], photo_of(0), None, CandidateOptions(), prior_at(area, 1200.0, 10.0))
    assert (area.area.image_map[other.images] == 0).all()
    wide = replace(prior_at(area, 600.0, 10.0), sigma_horizontal_m=900.0)
    assert find_clusters([area], photo_of(0), None, CandidateOptions(), wide) == []


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_votes_prefer_the_right_place(seed: int) -> None:
    """Three places in one area, and again as three areas; each photo is of one of them."""
    maps = [place(i, east_m=400.0 * i) for i in range(3)]
    together = find_clusters([indexed(*maps)], photo_of(seed), None, VOTING)
    assert (together[0].area.image_map[together[0].images] == seed).all()
    assert together[0].score > 2 * together[-1].score
    apart = find_clusters([indexed(m) for m in maps], photo_of(seed), None, VOTING)
    assert apart[0].area.maps[0].map_id == f"place-{seed}"


def test_look_alikes_get_fewer_votes_than_the_place_itself() -> None:
    """A second place shares half of its descriptors with the first."""
    rng = np.random.default_rng(0)
    points, descriptors = box_points(rng, 300), random_descriptors(rng, 300)
    other = random_descriptors(np.random.default_rng(9), 300)
    other[::2] = descriptors[::2]
    maps = [
        scene_map(points=points, descriptors=d, poses=ring(8), map_id=name, east_m=east)
        for d, name, east in ((other, "like", 0.0), (descriptors, "true", 500.0))
    ]
    clusters = find_clusters([indexed(*maps)], photo_of(0), None, VOTING)
    assert (clusters[0].area.image_map[clusters[0].images] == 1).all()


def test_no_small_area_is_lost_among_many() -> None:
    """More areas than the shortlist holds: the votes choose, whatever the order."""
    areas = [indexed(place(i, east_m=2000.0 * i, images=4)) for i in range(6)]
    for seed in (0, 5):
        clusters = find_clusters(areas, photo_of(seed), None, CandidateOptions(shortlist=3))
        assert len(clusters) == 3
        assert clusters[0].area.maps[0].map_id == f"place-{seed}"
        assert np.isfinite([c.score for c in clusters]).all()
    # Few that have few points are all tried; of more points the photo's own come first.
    few = find_clusters(areas[:3], photo_of(2), None, CandidateOptions())
    assert [c.score for c in few] == [np.inf] * 3
    more = find_clusters(areas[:3], photo_of(2), None, CandidateOptions(single_cluster_points=400))
    assert len(more) == 3
    assert more[0].area.maps[0].map_id == "place-2"
    assert more[1].score < 0.5 * more[0].score


def test_a_small_area_does_not_push_aside_the_clusters_of_a_large_one() -> None:
    large = indexed(*[place(i, east_m=250.0 * i) for i in range(3)])
    small = [indexed(place(10 + i, images=3)) for i in range(3)]
    options = CandidateOptions(single_cluster_points=400)
    clusters = find_clusters([*small, large], photo_of(2), None, options)
    assert clusters[0].area is large.area
    assert (large.area.image_map[clusters[0].images] == 2).all()


def test_clusters_are_bounded_and_always_the_same() -> None:
    area = indexed(place(0, images=30))
    options = replace(VOTING, max_cluster_images=6, shortlist=4)
    first, again = (find_clusters([area], photo_of(0), None, options) for _ in range(2))
    assert len(first) == 4
    assert [c.score for c in first] == sorted((c.score for c in first), reverse=True)
    for one, other in zip(first, again, strict=True):
        assert 1 <= len(one.images) <= 6
        np.testing.assert_array_equal(one.images, other.images)
        np.testing.assert_array_equal(one.points, area.area.points_of_images(one.images))
    assert len({tuple(c.images) for c in first}) == 4


def test_no_features_and_no_areas() -> None:
    nothing = photo_of(0).take(np.zeros(0, dtype=int))
    assert find_clusters([], photo_of(0), None, CandidateOptions()) == []
    clusters = find_clusters([indexed(place(0))], nothing, None, VOTING)
    assert all(c.score <= 0 for c in clusters)


def test_of_many_places_those_that_match_best_are_tried() -> None:
    """Votes had the photo's own place last; a few of its features matched against each put it first."""
    maps = [place(i, east_m=400.0 * i) for i in range(6)]
    area = indexed(*maps)
    options = LocaliseOptions(candidates=replace(VOTING, shortlist=6, max_clusters=3, shortlist_features=150))
    clusters = find_clusters([area], photo_of(4), None, options.candidates)
    last = sorted(clusters, key=lambda c: c.score)
    tries = [ClusterMatcher(photo_of(4), cluster, options.matching) for cluster in last]
    chosen = most_matched(tries, options)
    assert len(chosen) == 2
    assert (area.area.image_map[chosen[0].cluster.images] == 4).all()
    assert most_matched(tries[:2], options) == tries[:2]


@pytest.mark.parametrize("seed", range(40))
def test_the_nearest_points_in_reach_against_all_of_them(seed: int) -> None:
    """Several areas of several maps and two extractors, some without points, as wholes and in parts."""
    rng = np.random.default_rng(seed)
    asked = random_descriptors(rng, 40)
    areas, east_m = [], 0.0
    for k in range(int(rng.integers(2, 6))):
        maps = []
        for m in range(int(rng.integers(1, 4))):
            count = int(rng.choice([0, 30, 200]))
            east_m += 300.0
            own = random_descriptors(rng, count)
            shown = min(count, 10)
            own[:shown] = noisy(rng, asked[rng.integers(0, len(asked), shown)], 3.0)
            maps.append(
                scene_map(
                    points=box_points(rng, count),
                    descriptors=own,
                    poses=ring(4),
                    east_m=east_m,
                    map_id=f"{k}-{m}",
                    fingerprint=f"extractor-{k % 2}",
                )
            )
        areas.append(build_area(maps))
    reach = []
    for one in indexed_together(areas):
        if rng.random() < 0.3:  # nothing of it is in reach
            continue
        count = len(one.area.points)
        some = np.sort(rng.choice(count, int(rng.integers(0, count + 1)), replace=False))
        points = None if rng.random() < 0.5 else some.astype(np.int32)
        reach.append(_Reach(indexed=one, images=np.arange(1), some=points))
    reach = [reach[i] for i in rng.permutation(len(reach))]
    part, row, squared = _nearest(reach, asked, 5)
    found, true_nearest = [], []
    for i in range(len(asked)):
        there = np.isfinite(squared[i])
        pairs = list(zip(part[i][there].tolist(), row[i][there].tolist(), strict=True))
        assert len(set(pairs)) == len(pairs)
        true: dict[tuple[int, int], float] = {}
        for p, r in enumerate(reach):
            base = r.area.descriptors[r.points].astype(np.float64)
            distance = ((base - asked[i].astype(np.float64)) ** 2).sum(axis=1)
            true |= {(p, int(at)): float(d) for at, d in zip(r.points, distance, strict=True)}
        assert [true[pair] for pair in pairs] == squared[i][there].tolist()
        if true:
            true_nearest.append(min(true.values()))
            found.append(min((true[pair] for pair in pairs), default=np.inf))
    close = np.array(true_nearest) < 120.0**2  # that of the feature itself
    if close.any():
        assert np.mean(np.array(found)[close] == np.array(true_nearest)[close]) > 0.9


def test_an_index_is_kept_where_its_areas_are_the_same() -> None:
    areas = [build_area([place(k, 3000.0 * k)]) for k in range(3)]
    first = indexed_together(areas)
    counts = [len(area.points) for area in areas]
    assert [one.first for one in first] == [0, counts[0], counts[0] + counts[1]]
    again = indexed_together(areas, first)
    assert all(one is other for one, other in zip(first, again, strict=True))
    fewer = indexed_together(areas[:2], first)
    assert fewer[0].index is fewer[1].index is not first[0].index
    assert len(fewer[0].index) == counts[0] + counts[1]
