"""Pictures that are parts of photos, with the key of the camera or without: their own lens is found."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.adjust.terms import whole_camera
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.maps.lens_uncertainty import LensUncertainty
from reloc.localise.localise import Localised, localise_features
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseRequest
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

POSE = looking_at(np.array([38.0, 22.0, 33.0]), np.array([0.0, 0.0, 3.0]))
_SIFT = LocaliseOptions().extractor.fingerprint
W, H = CAMERA.width, CAMERA.height
ZOOMED = CAMERA.with_focal(1.5 * CAMERA.focal_px)
# The upper left of a photo, at the photo's size.
CUT = Camera(
    model="PINHOLE",
    width=W,
    height=H,
    params=(1.4 * CAMERA.focal_px, 1.4 * CAMERA.focal_px, 1.4 * W / 2, 1.4 * H / 2),
)
KNOWN = LensUncertainty(
    focal_rel=0.003,
    aspect=1e-4,
    center_rel=(0.002, 0.002),
    radial=(0.002, 0.002),
    tangential=(1e-4, 1e-4),
    dilution=50.0,
)


def asked(lens: Camera, points: FloatArray, key: str | None, seed: int = 0) -> Localised:
    """A picture of a map's points by this lens, as of the map's camera by its key."""
    rng = np.random.default_rng(seed)
    descriptors = random_descriptors(rng, len(points))
    made = scene_map(
        points=points, descriptors=descriptors, poses=ring(8), camera_keys=("phone",), fingerprint=_SIFT
    )
    lent = (whole_camera(CAMERA),)
    made = replace(made, cameras=lent, provenance=made.provenance | KNOWN.as_provenance())
    pixels, inside = pixels_inside(lens, POSE, points)
    rows = np.flatnonzero(inside)[:300]
    features = query_features(
        rng, pixels[rows] + rng.normal(0.0, 0.5, (len(rows), 2)), descriptors[rows], fingerprint=_SIFT
    )
    return localise_features(features, LocaliseRequest(camera_key=key), [indexed(made)])


def off_m(found: Localised) -> float:
    assert found.best is not None, found.result.detail
    return float(np.linalg.norm(found.best.pose.cam_from_local.center - POSE.center))


@pytest.mark.parametrize("key", ["phone", None])
@pytest.mark.parametrize("lens", [ZOOMED, CUT], ids=["zoomed", "cut"])
def test_a_part_of_a_photo_is_placed_by_its_own_lens(lens: Camera, key: str | None) -> None:
    for seed in range(3):
        found = asked(lens, box_points(np.random.default_rng(seed), 1500), key, seed)
        assert off_m(found) < 0.4
        assert found.result.pose is not None
        assert found.result.pose.camera_source == "estimated"
        assert ("cropped or zoomed" in found.result.detail) or lens is ZOOMED


def test_a_zoomed_photo_of_flat_ground_has_the_bound_of_an_unknown_lens() -> None:
    """The lens of the map fits as well, from another height, but for the rest of the picture's relief."""
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-40.0, 40.0, (1500, 2)), rng.normal(0.0, 1.0, 1500)])
    found = asked(ZOOMED, ground, "phone")
    assert found.result.pose is not None
    assert found.result.pose.camera_source == "estimated"
    assert found.uncertainty is not None
    spread = np.sqrt(np.trace(found.uncertainty.covariance[3:, 3:]))
    assert off_m(found) < 3.0 * spread


def test_a_whole_photo_keeps_the_lens_that_the_map_lends() -> None:
    """Also where the map's lens is off by what the map says of it."""
    for seed in range(10):
        points = box_points(np.random.default_rng(seed), 1500)
        for factor in (1.0, 1.003):
            found = asked(CAMERA.with_focal(factor * CAMERA.focal_px), points, "phone", seed)
            assert found.result.pose is not None
            assert found.result.pose.camera_source == "map"
