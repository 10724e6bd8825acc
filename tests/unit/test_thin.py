"""K-cover thinning: what every image keeps, which points are chosen, what stays as it was."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import build_area
from featuredb.maps.feature_map import FeatureMap, MapImage, MapObservations, MapPoints, Placement
from featuredb.maps.thin import (
    described_points_of_images,
    k_cover,
    thin_map,
)
from tests.support.maps import random_map
from tests.support.planar_map import EASTING, EPSG, HEIGHT, NORTHING, planar_map, view

_CAMERA = Camera(model="PINHOLE", width=1000, height=1000, params=(900.0, 900.0, 500.0, 500.0))


def seen_map(
    sightings: list[tuple[int, int, float, float]], sigma_m: list[float] | None = None
) -> FeatureMap:
    """A map of (point, image, x, y); images 30 m up in a row, points on a grid of 1 m."""
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    n = 1 + max(s[0] for s in sightings)
    variance = np.square(np.array(sigma_m or [0.01] * n), dtype=np.float64) / 3.0
    local = np.column_stack([np.arange(n) % 10, np.arange(n) // 10, np.zeros(n)]).astype(np.float64)
    point, image = (np.array([s[k] for s in sightings]) for k in (0, 1))
    m = len(sightings)
    return FeatureMap(
        map_id="seen", name="seen", epsg=EPSG, height_datum="ellipsoidal", frame=frame, cameras=(_CAMERA,),
        images=tuple(
            MapImage(image_id=k, name=str(k), sha256=f"{k:064x}", camera_id=0,
                     cam_from_local=view(5.0 * k, 0.0, 30.0, 0.0, 0.0))
            for k in range(1 + int(image.max()))
        ),
        points=MapPoints(
            utm=frame.utm_from_enu(local, EPSG), rgb=np.zeros((n, 3), np.uint8),
            track_length=np.bincount(point, minlength=n).astype(np.int32),
            error_px=np.zeros(n, np.float32),
            covariance=(variance[:, None] * np.array([1.0, 0, 0, 1, 0, 1])).astype(np.float32),
        ),
        observations=MapObservations(
            point_index=point.astype(np.int64), image_id=image.astype(np.int32),
            xy=np.array([s[2:] for s in sightings], np.float32), scale=np.ones(m, np.float32),
            angle=np.zeros(m, np.float32), has_descriptor=np.ones(m, np.bool_),
            descriptors=np.full((m, 128), 45, np.uint8),
        ),
        placement=Placement(method="gcp", local_from_sfm=Sim3.identity(), covariance=np.eye(7) * 1e-6,
                            residual_rms_m=0.0),
        extractor_fingerprint="test",
    )  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), cover=st.integers(15, 60))
def test_every_image_keeps_the_cover_or_all_it_had(seed: int, cover: int) -> None:
    before = random_map(seed, points=120, images=5, observations=600)
    after = thin_map(before, cover)
    had, has = described_points_of_images(before), described_points_of_images(after)
    assert (has >= np.minimum(had, cover)).all()
    assert (has <= had).all()


def test_one_point_that_all_images_see_serves_where_many_would() -> None:
    # Points 0 to 14 are seen by images 0, 1, 2 each; 15 to 74 by one image each.
    shared = [(p, i, 60.0 * p + 30, 100.0) for p in range(15) for i in range(3)]
    alone = [(15 + 20 * i + p, i, 40.0 * p + 30, 800.0) for i in range(3) for p in range(20)]
    chosen = k_cover(seen_map(shared + alone), 15)
    assert np.flatnonzero(chosen).tolist() == list(range(15))


def test_points_spread_over_the_image() -> None:
    # 200 points crowd one corner, 20 lie elsewhere; all seen by both images.
    rng = np.random.default_rng(1)
    xy = np.vstack([rng.uniform(0, 100, (200, 2)), rng.uniform(100, 1000, (20, 2))])
    chosen = k_cover(seen_map([(p, i, *xy[p]) for p in range(220) for i in (0, 1)]), 20)
    assert chosen[200:].sum() >= 17, "one in the corner, the others elsewhere"
    assert chosen.sum() == 20


def test_a_precise_point_goes_before_a_vague_one() -> None:
    sigma = [0.5, 0.01] * 20
    chosen = k_cover(seen_map([(p, i, 500.0, 500.0) for p in range(40) for i in (0, 1)], sigma), 20)
    assert np.flatnonzero(chosen).tolist() == list(range(1, 40, 2))


def test_views_that_stay_are_the_outermost_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("featuredb.maps.thin._MAX_VIEWS", 3)
    # Images 0 and 1 see 20 points each and need them all; the ten others see all 40 and can spare half.
    sightings = [(p, p // 20, 20.0 * p, 500.0) for p in range(40)]
    sightings += [(p, i, 20.0 * p, 500.0) for p in range(40) for i in range(2, 12)]
    thin = thin_map(seen_map(sightings), 20)
    seen = thin.observations
    kept = seen.image_id[seen.has_descriptor & (seen.point_index == 0)]
    assert len(kept) == 3
    assert {0, 11} <= set(kept.tolist()), "the outermost cameras of the row"
    assert described_points_of_images(thin).min() == 20


@pytest.fixture(scope="module")
def field() -> FeatureMap:
    return planar_map()


def test_nothing_moves_and_the_area_holds_the_chosen_points_only(field: FeatureMap) -> None:
    before = field
    after = thin_map(before, 40)
    np.testing.assert_array_equal(after.points.utm, before.points.utm)
    np.testing.assert_array_equal(after.observations.xy, before.observations.xy)
    assert after.placement is before.placement
    assert after.images == before.images
    kept = after.observations.has_descriptor
    np.testing.assert_array_equal(after.observations.descriptors[kept], before.observations.descriptors[kept])
    assert not after.observations.descriptors[~kept].any()
    chosen = np.unique(after.observations.point_index[kept])
    np.testing.assert_array_equal(build_area([after]).point_row.whole(), chosen)
    assert len(chosen) < 0.5 * len(before.points)
    assert after.provenance["thinned"]["points"] == len(chosen)


def test_thinning_again_changes_nothing_and_thinner_does(field: FeatureMap) -> None:
    once = thin_map(field, 60)
    assert thin_map(once, 60) is once
    thinner = thin_map(once, 20)
    assert thinner.observations.has_descriptor.sum() < once.observations.has_descriptor.sum()


def test_covers_that_could_never_answer_are_refused(field: FeatureMap) -> None:
    with pytest.raises(InvalidValueError, match="at least 15"):
        thin_map(field, 10)
