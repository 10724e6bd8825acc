"""Small random FeatureMaps, consistent in themselves, for tests of what lies above the value types."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import (
    FeatureMap,
    GeoPrior,
    MapImage,
    MapObservations,
    MapPoints,
    Placement,
)
from featuredb.maps.unplaced_map import NoPlace, OwnFrame, OwnPoints, UnplacedMap

EPSG = 32632
EASTING, NORTHING, HEIGHT = 456_800.0, 5_429_300.0, 120.0


def random_map(
    seed: int = 0,
    *,
    map_id: str | None = None,
    points: int = 60,
    images: int = 4,
    observations: int = 200,
    extent_m: float = 700.0,
    parents: tuple[str, ...] = (),
    fingerprint: str = "rootsift-test",
) -> FeatureMap:
    """A map of random content around (EASTING, NORTHING) that spans a few tiles.

    Observations are projections of their points only in number and reference, not in geometry: what looks at
    geometry builds a real scene instead (featuredb.simworld).
    """
    rng = np.random.default_rng(seed)
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    local = rng.uniform(-0.5, 0.5, (points, 3)) * [extent_m, extent_m, 40.0]
    cameras = (
        Camera(model="SIMPLE_RADIAL", width=1600, height=1200, params=(1234.5678901234567, 800, 600, 0.01)),
        Camera(model="OPENCV", width=800, height=600, params=(700, 701, 400, 300, 0.1, 0.01, 1e-3, 1e-4)),
    )
    return FeatureMap(
        map_id=map_id or f"map-{seed}",
        name=f"random map {seed}",
        epsg=EPSG,
        height_datum="unknown",
        frame=frame,
        cameras=cameras,
        camera_keys=("DJI FC6310 1600x1200 8.8", ""),
        images=tuple(_image(rng, i, extent_m) for i in range(images)),
        points=MapPoints(
            utm=frame.utm_from_enu(local, EPSG),
            rgb=rng.integers(0, 256, (points, 3), dtype=np.uint8),
            track_length=rng.integers(2, 30, points, dtype=np.int32),
            error_px=rng.gamma(2.0, 0.3, points).astype(np.float32),
            covariance=rng.normal(0, 0.01, (points, 6)).astype(np.float32),
        ),
        observations=_observations(rng, points, images, observations),
        placement=Placement(
            method="map" if parents else "gps",
            local_from_sfm=Sim3.exp(rng.normal(0, 1, 7)),
            covariance=_covariance(rng, 7),
            residual_rms_m=float(rng.gamma(2.0, 0.5)),
            evidence={"photos": images, "gates": {"line": False}, "residuals_m": [0.1, 1 / 3]},
        ),
        extractor_fingerprint=fingerprint,
        generation=1 if parents else 0,
        parents=parents,
        source="random",
        licence="CC0-1.0",
        provenance={"seed": seed, "options": {"min_track_length": 3}},
    )


def assert_same_map(a: FeatureMap, b: FeatureMap) -> None:
    """Bit for bit the same, status apart."""
    for name in (
        "map_id", "name", "epsg", "height_datum", "frame", "cameras", "camera_keys", "extractor_fingerprint",
        "generation", "parents", "source", "licence", "provenance",
    ):  # fmt: skip
        assert getattr(a, name) == getattr(b, name), name
    for one, other in ((a.points, b.points), (a.observations, b.observations)):
        for name in type(one).__slots__:
            left, right = getattr(one, name), getattr(other, name)
            assert left.dtype == right.dtype, name
            np.testing.assert_array_equal(left, right, err_msg=name)
    assert len(a.images) == len(b.images)
    for left, right in zip(a.images, b.images, strict=True):
        _assert_same_image(left, right)
    assert a.placement.method == b.placement.method
    assert a.placement.residual_rms_m == b.placement.residual_rms_m
    assert a.placement.evidence == b.placement.evidence
    np.testing.assert_array_equal(a.placement.covariance, b.placement.covariance)
    assert a.placement.local_from_sfm.scale == b.placement.local_from_sfm.scale
    np.testing.assert_array_equal(a.placement.local_from_sfm.matrix(), b.placement.local_from_sfm.matrix())


def _assert_same_image(a: MapImage, b: MapImage) -> None:
    for name in ("image_id", "name", "sha256", "camera_id", "capture_time", "owner", "licence"):
        assert getattr(a, name) == getattr(b, name), name
    np.testing.assert_array_equal(a.cam_from_local.matrix(), b.cam_from_local.matrix())
    assert (a.covariance is None) == (b.covariance is None)
    if a.covariance is not None and b.covariance is not None:
        np.testing.assert_array_equal(a.covariance, b.covariance)
    assert (a.gps is None) == (b.gps is None)
    if a.gps is not None and b.gps is not None:
        for name in GeoPrior.__slots__:
            assert getattr(a.gps, name) == getattr(b.gps, name), name


def _image(rng: np.random.Generator, image_id: int, extent_m: float) -> MapImage:
    pose = Rigid3.exp(np.concatenate([rng.normal(0, 1, 3), rng.uniform(-extent_m / 2, extent_m / 2, 3)]))
    taken = datetime(2024, 6, 1, 10, 0, 0, 123456) + timedelta(seconds=image_id)
    zones = (None, UTC, timezone(timedelta(hours=2)))
    return MapImage(
        image_id=image_id,
        name=f"flight/DJI_{image_id:04d}.JPG",
        sha256=rng.bytes(32).hex(),
        camera_id=image_id % 2,
        cam_from_local=pose,
        covariance=_covariance(rng, 6) if image_id % 2 else None,
        capture_time=taken.replace(tzinfo=zones[image_id % 3]) if image_id % 4 else None,
        gps=None
        if image_id % 3 == 2
        else GeoPrior(
            latitude_deg=49.0134 + rng.normal(0, 1e-4),
            longitude_deg=8.4044 + rng.normal(0, 1e-4),
            height_m=None if image_id % 2 else 151.25,
            sigma_horizontal_m=3.0,
            sigma_vertical_m=7.0,
        ),
        owner="A. Pilot",
        licence="CC-BY-4.0",
    )


def _observations(rng: np.random.Generator, points: int, images: int, count: int) -> MapObservations:
    if points == 0 or images == 0:
        count = 0
    has_descriptor = rng.random(count) < 0.6
    descriptors = rng.integers(0, 256, (count, 128), dtype=np.uint8)
    return MapObservations(
        point_index=rng.integers(0, max(points, 1), count),
        image_id=rng.integers(0, max(images, 1), count).astype(np.int32),
        xy=rng.uniform(0, 1000, (count, 2)).astype(np.float32),
        scale=rng.gamma(2.0, 3.0, count).astype(np.float32),
        angle=rng.uniform(0, 360, count).astype(np.float32),
        has_descriptor=has_descriptor,
        descriptors=np.where(has_descriptor[:, None], descriptors, np.uint8(0)),
    )


def _covariance(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    half = rng.normal(0, 0.1, (size, size))
    return half @ half.T


def random_unplaced_map(seed: int = 0, *, map_id: str | None = None) -> UnplacedMap:
    """A map without a place, of the content of `random_map`."""
    placed = random_map(seed, map_id=map_id)
    return replace(without_place(placed), source="random", licence="CC0-1.0", provenance={"seed": seed})


def without_place(placed: FeatureMap, own_from_local: Sim3 | None = None) -> UnplacedMap:
    """The map as it would be if nobody knew its place; covariances stay as they are."""
    move = own_from_local or Sim3.identity()
    return UnplacedMap(
        map_id=placed.map_id,
        name=placed.name,
        frame=OwnFrame(metric=False, upright=own_from_local is None),
        cameras=placed.cameras,
        camera_keys=placed.camera_keys,
        images=tuple(
            replace(image, cam_from_local=move.act_on_pose(image.cam_from_local)) for image in placed.images
        ),
        points=OwnPoints(
            xyz=move.act(placed.points_local()), **placed.points.columns(np.arange(len(placed.points)))
        ),
        observations=placed.observations,
        no_place=NoPlace(
            reason_code="TOO_FEW",
            reason="no photo has GPS",
            ways=("place it by picks",),
            evidence={"with_gps": 0},
        ),
        extractor_fingerprint=placed.extractor_fingerprint,
        source=placed.source,
        licence=placed.licence,
        provenance=placed.provenance,
    )
