"""The depth filter against planes and steps whose depth is known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import Rendering
from ingest.register.structure.depth_filter import surface_at
from tests.support.scanned_map import plain_cloud

_CAMERA = Camera(model="PINHOLE", width=120, height=90, params=(100.0, 100.0, 60.0, 45.0))
# Camera axes are the local ones: z forward. Depth is the local z.
_POSE = Rigid3.identity()


def _rendering(depth: FloatArray) -> tuple[Rendering, PointCloud]:
    """Depth per pixel, NaN for nothing, with one scan point behind each pixel's centre."""
    row, column = np.indices(depth.shape)
    z = np.where(np.isfinite(depth), depth, 1e5)
    xyz = np.stack([(column + 0.5 - 60) / 100 * z, (row + 0.5 - 45) / 100 * z, z], axis=-1).reshape(-1, 3)
    index = np.arange(xyz.shape[0], dtype=np.int32).reshape(depth.shape)
    return (
        Rendering(
            camera=_CAMERA,
            cam_from_local=_POSE,
            depth=depth.astype(np.float32),
            index=np.where(np.isfinite(depth), index, -1).astype(np.int32),
            rgb=None,
            intensity=None,
            points_drawn=len(xyz),
        ),
        plain_cloud(xyz),
    )


def _plane(slope: float) -> FloatArray:
    """Depth of the plane z = 40 + slope x."""
    column = np.indices((90, 120))[1]
    return 40.0 / (1.0 - slope * (column + 0.5 - 60) / 100)


def _hit(depth: FloatArray) -> NDArray[np.bool_]:
    """Whether the ray of each pixel hits the surface; (h, w) as the picture."""
    row, column = np.indices(depth.shape)
    pixels = np.stack([column + 0.5, row + 0.5], axis=-1).reshape(-1, 2)
    return np.isin(np.arange(len(pixels)), surface_at(*_rendering(depth), pixels).rows).reshape(depth.shape)


@pytest.mark.parametrize("slope", [0.0, 0.5, -0.8])
def test_hits_lie_on_a_tilted_plane(slope: float) -> None:
    rendering, cloud = _rendering(_plane(slope))
    pixels = np.random.default_rng(0).uniform((10, 10), (110, 80), (50, 2))
    hits = surface_at(rendering, cloud, pixels)
    assert len(hits.rows) == len(pixels)
    # The closed form: ray (x, y, 1) t meets z = 40 + slope x.
    x, y = ((pixels - (60, 45)) / 100).T
    t = 40.0 / (1.0 - slope * x)
    assert np.abs(hits.points - np.column_stack([x * t, y * t, t])).max() < 2e-4  # float32 points
    assert hits.sigma_ray_m.max() < 1e-3
    normal = np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    assert np.abs(hits.normals - normal).max() < 1e-3


def test_pixels_along_a_silhouette_are_left_out_and_the_rest_kept() -> None:
    depth = _plane(0.0)
    depth[:, 60:] = 30.0
    good = _hit(depth)
    assert not good[:, 58:62].any()
    assert good[3:-3, 10:50].all()
    assert good[3:-3, 70:110].all()


def test_a_steep_plane_is_no_silhouette() -> None:
    assert _hit(_plane(1.0))[8:-8, 8:-8].all()


def test_nothing_beyond_the_far_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    rendering, cloud = _rendering(_plane(0.0))
    monkeypatch.setattr("ingest.register.structure.depth_filter._MAX_DEPTH_M", 39.0)
    assert not len(surface_at(rendering, cloud, np.array([[60.0, 45.0]])).rows)


def test_closed_holes_are_not_depths() -> None:
    rendering, cloud = _rendering(_plane(0.0))
    index = rendering.index.copy()
    index[40:50, 50:70] = -1  # closed from the surroundings: depth without a point
    closed = Rendering(
        camera=_CAMERA,
        cam_from_local=_POSE,
        depth=rendering.depth,
        index=index,
        rgb=None,
        intensity=None,
        points_drawn=0,
    )
    hits = surface_at(closed, cloud, np.array([[60.0, 45.0], [20.0, 20.0]]))
    assert hits.rows.tolist() == [1]


def test_grazing_surfaces_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rendering, cloud = _rendering(_plane(0.5))
    assert len(surface_at(rendering, cloud, np.array([[60.0, 45.0]])).rows)
    # The plane is seen at 26.6 degrees straight ahead.
    monkeypatch.setattr("ingest.register.structure.depth_filter._MAX_GRAZING_DEG", 20.0)
    assert not len(surface_at(rendering, cloud, np.array([[60.0, 45.0]])).rows)


def test_pixels_at_the_border_have_no_window() -> None:
    rendering, cloud = _rendering(_plane(0.0))
    outside = np.array([[1.0, 45.0], [-5.0, 45.0], [119.9, 89.9], [500.0, 45.0]])
    assert not len(surface_at(rendering, cloud, outside).rows)
