"""Ageing of points: what counts say about a point, and what localised photos say about counts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import betabinom

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import extract
from featuredb.geometry.camera import Camera
from featuredb.index.area import build_area
from featuredb.index.descriptor_index import build_index
from featuredb.maps.ageing import (
    AgeOptions,
    Sighting,
    age_map,
    aged_points,
    count_sightings,
    rate_distribution,
)
from featuredb.maps.feature_map import FeatureMap
from reloc.candidates import IndexedArea
from reloc.localise import localise_features
from reloc.options import LocaliseOptions
from reloc.result import LocaliseRequest
from reloc.sightings import SightingOptions, expected_points, sightings_of
from tests.support.maps import random_map
from tests.support.planar_map import CAMERA, field_texture, planar_map, render, view


def test_distribution_of_rates_is_recovered() -> None:
    rng = np.random.default_rng(4)
    n = rng.integers(5, 60, 5000)
    seen = np.asarray(betabinom.rvs(n, 2.0, 5.0, random_state=rng), dtype=np.int64)
    a, b = rate_distribution(n, seen)
    assert a == pytest.approx(2.0, rel=0.12)
    assert b == pytest.approx(5.0, rel=0.12)


def test_points_that_are_gone_are_aged_and_living_ones_are_not() -> None:
    rng = np.random.default_rng(5)
    rates = rng.beta(4.0, 8.0, 2000)
    rates[:60] = 0.0
    expected = np.full(2000, 80)
    aged = aged_points(expected, rng.binomial(expected, rates))
    assert aged[:60].mean() > 0.95
    worth_it = rates >= rates.mean() / 3.0
    assert aged[worth_it].mean() < 0.01
    # Fifty sources without a hit are where it begins at these rates.
    expected = np.full(2000, 30)
    assert not aged_points(expected, rng.binomial(expected, rates)).any()


def test_few_misses_age_nothing() -> None:
    rng = np.random.default_rng(6)
    expected = np.concatenate([np.full(500, 40), np.full(5, 5)])
    seen = np.concatenate([rng.binomial(40, rng.beta(4.0, 8.0, 500)), np.zeros(5, np.int64)])
    assert not aged_points(expected, seen)[-5:].any(), "five misses of places seen in a third of the photos"


def test_seen_once_more_keeps_a_point_that_misses_alone_would_age() -> None:
    rng = np.random.default_rng(7)
    expected = np.full(500, 70)
    seen = rng.binomial(70, rng.beta(4.0, 8.0, 500))
    seen[:2] = 0, 6
    assert aged_points(expected, seen)[:2].tolist() == [True, False]


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="seen <= expected"):
        aged_points(np.array([3]), np.array([4]))
    with pytest.raises(InvalidValueError, match="not expected"):
        Sighting(map_id="m", write_id="w", source="s", expected=np.array([1]), seen=np.array([2]))


def test_many_photos_of_one_source_count_once() -> None:
    def one(source: str, seen: list[int]) -> Sighting:
        return Sighting(
            map_id="m", write_id="w", source=source, expected=np.array([0, 1]), seen=np.array(seen, np.int64)
        )

    burst = [one("ann, 1 May", []), one("ann, 1 May", [1]), one("ann, 1 May", [])]
    expected, seen, sources = count_sightings([*burst, one("bob, 2 May", [1])], 3)
    assert (expected.tolist(), seen.tolist(), sources) == ([2, 2, 0], [0, 2, 0], 2)


def test_too_few_sources_change_nothing() -> None:
    feature_map = random_map(1)
    rows = np.arange(len(feature_map.points))
    never = [
        Sighting(map_id="map-1", write_id="w", source=str(k), expected=rows, seen=np.zeros(0, np.int64))
        for k in range(9)
    ]
    assert age_map(feature_map, never, AgeOptions(least_sources=10)) is feature_map


def test_a_map_loses_the_descriptors_of_aged_points_only() -> None:
    feature_map = random_map(1, points=300, observations=1500)
    rng = np.random.default_rng(9)
    rates = rng.beta(6.0, 6.0, 300)
    rates[:10] = 0.0
    rows = np.arange(300)
    found = [
        Sighting(
            map_id="map-1", write_id="w", source=str(k), expected=rows, seen=rows[rng.random(300) < rates]
        )
        for k in range(40)
    ]
    after = age_map(feature_map, found)
    lost = feature_map.observations.has_descriptor & ~after.observations.has_descriptor
    of_gone = feature_map.observations.has_descriptor & (feature_map.observations.point_index < 10)
    assert (lost & of_gone).sum() >= 0.9 * of_gone.sum()
    assert (lost & ~of_gone).sum() <= 0.02 * lost.size
    assert len(after.points) == 300
    assert after.provenance["aged"]["sources"] == 40


@pytest.fixture(scope="module")
def field() -> FeatureMap:
    return planar_map()


def test_localised_photos_tell_what_they_found(field: FeatureMap) -> None:
    # Forty places look otherwise now than the map remembers.
    rng = np.random.default_rng(8)
    gone = rng.choice(len(field.points), 40, replace=False)
    seen = field.observations
    other = np.isin(seen.point_index, gone)
    descriptors = seen.descriptors.copy()
    cells = descriptors[other].reshape(-1, 16, 8)
    descriptors[other] = np.roll(cells, 4, axis=2).reshape(-1, 128)  # dark where it was bright
    changed = replace(field, observations=replace(seen, descriptors=descriptors))
    area = build_area([changed])
    indexed = [IndexedArea(area=area, index=build_index(area.descriptors))]
    found = []
    for k in range(4):
        east, north = rng.uniform(-12, 12, 2)
        pose = view(float(east), float(north), 45.0, rng.uniform(0, 8), rng.uniform(0, 360))
        features = extract(render(field_texture(1), pose, seed=100 + k), LocaliseOptions().extractor)
        localised = localise_features(features, LocaliseRequest(camera=CAMERA), indexed)
        found += sightings_of(localised, features, f"source {k}", {"field": "w"})
    expected, hits, sources = count_sightings(found, len(field.points))
    assert sources == 4
    rest = np.setdiff1d(np.arange(len(field.points)), gone)
    assert expected[gone].sum() > 40
    assert hits[gone].sum() <= 0.02 * expected[gone].sum()
    assert hits[rest].sum() > 0.3 * expected[rest].sum()


def test_a_photo_that_was_not_localised_says_nothing(field: FeatureMap) -> None:
    area = build_area([field])
    indexed = [IndexedArea(area=area, index=build_index(area.descriptors))]
    features = extract(render(field_texture(99), view(0, 0, 45.0, 0, 0)), LocaliseOptions().extractor)
    localised = localise_features(features, LocaliseRequest(camera=CAMERA), indexed)
    assert localised.best is None
    assert sightings_of(localised, features, "somebody", {"field": "w"}) == []


def test_expected_are_points_seen_from_known_sides_at_known_distances(field: FeatureMap) -> None:
    area = build_area([field])
    usual = view(0.0, 0.0, 45.0, 5.0, 0.0)
    rows = expected_points(area, CAMERA, usual, SightingOptions())
    assert len(rows) > 200
    pixels = CAMERA.project(usual.act(area.points[rows]))
    assert (pixels > 0.03 * 640 - 1e-6).all()
    for unusual in (view(0.0, 0.0, 90.0, 5.0, 0.0), view(0.0, -60.0, 30.0, 60.0, 0.0)):
        assert len(expected_points(area, CAMERA, unusual, SightingOptions())) < 0.1 * len(rows)
    wide = Camera(model="PINHOLE", width=640, height=480, params=(60.0, 60.0, 320.0, 240.0))
    assert len(expected_points(area, wide, usual, SightingOptions())) >= len(rows)
