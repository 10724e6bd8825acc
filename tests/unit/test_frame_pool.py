"""Features of renders lifted to the scan: right points, and none where depth is a guess."""

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.render.renderer import Rendering
from ingest.register.frame.features.matching import filled, lift, pool_features
from ingest.register.frame.views import source_image

CAMERA = Camera(model="SIMPLE_RADIAL", width=320, height=240, params=(300.0, 160.0, 120.0, -0.05))
POSE = Rigid3(rotation=so3_exp([0.2, -0.1, 0.5]), translation=np.array([3.0, -2.0, 5.0]))


def rendering(depth: np.ndarray | None = None, hole: bool = False) -> Rendering:
    """A textured plane across the axis, 40 m away, unless told otherwise."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (30, 40)).astype(np.uint8)
    texture = np.kron(coarse, np.ones((8, 8), np.uint8))
    depth = np.full((240, 320), 40.0, np.float32) if depth is None else depth
    index = np.where(np.isfinite(depth), 7, -1).astype(np.int32)
    if hole:
        index[100:140, 100:160] = -1
    return Rendering(
        camera=CAMERA,
        cam_from_local=POSE,
        depth=depth,
        index=index,
        rgb=np.where(np.isfinite(depth)[..., None], texture[..., None], 0).repeat(3, axis=2).astype(np.uint8),
        intensity=None,
        points_drawn=1,
    )


def test_lifted_points_project_back_to_their_pixels() -> None:
    xy = np.random.default_rng(2).uniform((5, 5), (315, 235), (200, 2))
    points, good = lift(rendering(), xy)
    assert good.all()
    np.testing.assert_allclose(CAMERA.project(POSE.act(points)), xy, atol=1e-6)
    np.testing.assert_allclose(POSE.act(points)[:, 2], 40.0, atol=1e-4)


def test_silhouettes_holes_and_voids_are_not_trusted() -> None:
    depth = np.full((240, 320), 40.0, np.float32)
    depth[:, 160:] = 20.0  # a wall's edge at column 160
    depth[:, :20] = np.nan
    xy = np.array([[160.5, 60.5], [159.5, 60.5], [10.5, 60.5], [120.5, 120.5], [250.5, 60.5], [0.5, 60.5]])
    _, good = lift(rendering(depth, hole=True), xy)
    assert good.tolist() == [False, False, False, False, True, False]


def test_pool_leaves_out_the_border_of_what_is_seen() -> None:
    depth = np.full((240, 320), 40.0, np.float32)
    depth[:, :100] = np.nan
    pool = pool_features(rendering(depth), "rgb")
    pixels = CAMERA.project(POSE.act(pool.points))
    assert len(pool) > 100
    assert len(pool.descriptors) == len(pool)
    assert pixels[:, 0].min() > 101.0


def test_empty_parts_are_filled_with_what_surrounds_them() -> None:
    image = np.full((100, 120), 180, np.uint8)
    valid = np.ones((100, 120), bool)
    valid[40:60, 50:70] = False
    image[~valid] = 0
    assert np.abs(filled(image, valid).astype(int) - 180).max() <= 1


def test_source_that_the_scan_lacks_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="intensity"):
        source_image(rendering(), "intensity")
