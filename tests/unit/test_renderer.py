"""The renderer of point clouds against ray casting, closed forms and pycolmap's lenses."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera, pixel_rays
from featuredb.render import renderer, splats
from featuredb.render.cloud import PointCloud
from featuredb.render.loops.draw_loops import project
from featuredb.render.renderer import RenderOptions, render, shaded_relief, visible_nodes
from featuredb.render.splats import BlockPlanes, lens_numbers
from featuredb.simworld.camera.photograph import look_pose
from featuredb.simworld.camera.raster import render as cast_rays
from featuredb.simworld.town.blocks import box, face
from featuredb.simworld.town.scene import Ellipsoids, Faces
from tests.support.clouds import build_cloud

FRAME = LocalFrame(latitude_deg=48.0, longitude_deg=11.0, height_m=500.0)
CAMERA = Camera(model="OPENCV", width=320, height=240, params=(240, 242, 163, 118, -0.08, 0.03, 1e-3, -7e-4))
LENSES = (
    Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=(500, 320, 240)),
    Camera(model="PINHOLE", width=640, height=480, params=(500, 505, 322, 238)),
    Camera(model="SIMPLE_RADIAL", width=640, height=480, params=(500, 320, 240, -0.15)),
    Camera(model="RADIAL", width=640, height=480, params=(500, 320, 240, 0.1, -0.02)),
    Camera(model="OPENCV", width=640, height=480, params=(500, 505, 322, 238, -0.2, 0.05, 1e-3, -2e-3)),
    Camera(
        model="FULL_OPENCV",
        width=640,
        height=480,
        params=(500, 505, 322, 238, 0.2, 0.05, 1e-3, -2e-3, 0.01, 0.3, 0.02, 0.005),
    ),
    Camera(model="SIMPLE_RADIAL_FISHEYE", width=640, height=480, params=(300, 320, 240, 0.03)),
    Camera(model="RADIAL_FISHEYE", width=640, height=480, params=(300, 320, 240, 0.03, -0.004)),
    Camera(
        model="OPENCV_FISHEYE", width=640, height=480, params=(300, 301, 320, 240, 0.02, -0.01, 2e-3, -3e-4)
    ),
)
NO_ELLIPSOIDS = Ellipsoids(
    center=np.zeros((0, 3)),
    radii=np.zeros((0, 3)),
    tint=np.zeros((0, 3)),
    texture_uv=np.zeros((0, 2)),
    object_id=np.zeros(0, np.int32),
)
# Straight down from 20 m: x east, y south in the picture.
DOWN = look_pose((0.0, 0.0, 20.0), 0.0, -90.0)


def lattice(step: float, half: float, z: float, seed: int = 0) -> NDArray[np.float64]:
    """Points of a square lattice at height z, each moved by up to a quarter of a step."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    xy = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.25 * step, 0.25 * step, (x.size, 2))
    return np.column_stack([xy, np.full(len(xy), z)])


def cloud_of(*parts: NDArray[np.float64]) -> PointCloud:
    """A cloud whose intensity tells the part, 50 apart."""
    intensity = np.concatenate([np.full(len(p), 50 * (i + 1), np.uint8) for i, p in enumerate(parts)])
    return build_cloud(FRAME, "unknown", np.concatenate(parts), intensity=intensity)


@pytest.mark.parametrize("camera", LENSES, ids=lambda c: c.model)
def test_the_compiled_projection_is_pycolmaps(camera: Camera) -> None:
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-30, 30, (4000, 2)), rng.uniform(-5, 30, 4000)])
    lens = lens_numbers(camera)
    ours, theirs = np.array([project(*point, lens) for point in points]), camera.project(points)
    assert np.array_equal(np.isnan(ours), np.isnan(theirs))
    seen = np.isfinite(theirs).all(axis=1)
    assert seen.any()
    assert not seen.all()
    seen &= (np.abs(theirs) < 5000).all(axis=1)  # beyond, at the horizon, float64 itself ends
    assert np.abs(ours[seen] - theirs[seen]).max() < 1e-6


@pytest.mark.parametrize(("pitch", "height"), [(-90.0, 25.0), (-40.0, 15.0)])
def test_depth_is_that_of_ray_casting(pitch: float, height: float) -> None:
    block = box(3.0, 4.0, 0.0, (8.0, 6.0, 5.0), 2, yaw_deg=20.0)
    ground = face((-60, -60, 0), (120, 0, 0), (0, 120, 0), "plain", 1)
    scene = Faces.concatenate([ground, block])
    # Points are thrown onto the faces themselves, by their own equations.
    rng = np.random.default_rng(1)
    area = np.linalg.norm(np.cross(scene.edge_s, scene.edge_t), axis=1)
    chosen = rng.choice(len(scene), 14400 * 25, p=area / area.sum())
    s, t = rng.random((2, len(chosen), 1))
    points = scene.origin[chosen] + s * scene.edge_s[chosen] + t * scene.edge_t[chosen]
    pose = look_pose((0.0, -12.0 if pitch > -90 else 0.0, height), 0.0, pitch)
    rendering = render(build_cloud(FRAME, "unknown", points), CAMERA, pose)
    exact = cast_rays(scene, NO_ELLIPSOIDS, CAMERA, pose).depth
    near = np.isfinite(exact) & (exact < 55.0)  # within the ground that has points
    error = np.abs(rendering.depth - exact)[near]
    assert np.isnan(error).mean() < 0.006  # points thrown at random leave some holes wider than is closed
    assert np.nanmedian(error) < 0.01
    # Points are 0.2 m apart; a silhouette may be off by half of that, some two pixels wide here.
    assert (error > 0.3).mean() < 0.03


def test_index_names_the_point_that_a_pixel_shows() -> None:
    cloud = cloud_of(lattice(0.4, 12.0, 0.0))
    rendering = render(cloud, CAMERA, DOWN)
    rows, columns = np.nonzero(rendering.index >= 0)
    pixels = CAMERA.project(DOWN.act(cloud.xyz[rendering.index[rows, columns]]))
    distance = np.hypot(pixels[:, 0] - columns - 0.5, pixels[:, 1] - rows - 0.5)
    spacing_px = 0.4 * CAMERA.focal_px / 20.0
    assert distance.max() < spacing_px
    assert np.median(distance) < 0.45 * spacing_px


def test_holes_of_a_near_surface_show_neither_nothing_nor_what_is_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near, far = lattice(0.45, 3.0, 8.0), lattice(0.05, 16.0, 0.0, seed=1)
    cloud = cloud_of(near, far)
    rendering = render(cloud, CAMERA, DOWN)
    x, y = pixel_rays(CAMERA)
    inside = (np.abs(x * 12.0) < 2.6) & (np.abs(y * 12.0) < 2.6)
    outside = ((np.abs(x * 12.0) > 3.4) | (np.abs(y * 12.0) > 3.4)) & (np.hypot(x, y) < 0.7)
    assert (np.abs(rendering.depth[inside] - 12.0) < 0.05).mean() > 0.985
    assert (np.abs(rendering.depth[outside] - 20.0) < 0.05).mean() > 0.999
    assert (np.abs(rendering.depth[outside] - 20.0) < 0.5).all()
    assert rendering.intensity is not None
    assert (rendering.intensity[inside] == 50).mean() > 0.985
    assert (rendering.intensity[outside] == 100).all()
    monkeypatch.setattr(renderer, "close_holes", lambda surfaces, *_: surfaces)
    bare = render(cloud, CAMERA, DOWN)
    assert (np.abs(bare.depth[inside] - 12.0) < 0.05).mean() < 0.95  # there is something to close


def test_colours_and_intensity_of_closed_holes_are_those_around_them() -> None:
    points = lattice(0.4, 12.0, 0.0)
    # Each channel tells a place: east, north, height, and east plus north.
    east, north = points[:, 0] + 12.0, points[:, 1] + 12.0
    rgb = np.column_stack([10.0 * east, 10.0 * north, np.full(len(points), 77.0)]).astype(np.uint8)
    cloud = build_cloud(FRAME, "unknown", points, rgb=rgb, intensity=(5.0 * (east + north)).astype(np.uint8))
    rendering = render(cloud, CAMERA, DOWN)
    holes = (rendering.index < 0) & rendering.valid
    assert holes.sum() > 1000
    x, y = (grid[holes] for grid in pixel_rays(CAMERA))
    z = rendering.depth[holes]
    ground = DOWN.inverse().act(np.column_stack([x * z, y * z, z]).astype(np.float64))
    inside = (np.abs(ground[:, :2]) < 11.0).all(axis=1)
    expected = np.column_stack([10.0 * (ground[:, :2] + 12.0), np.full(len(ground), 77.0)])[inside]
    assert rendering.rgb is not None
    assert rendering.intensity is not None
    # Half a spacing of 0.4 m, and what rounding to whole numbers takes.
    assert np.abs(rendering.rgb[holes][inside] - expected).max() < 10.0 * 0.4 * 0.75 + 1.0
    off = rendering.intensity[holes][inside] - 0.5 * expected[:, :2].sum(axis=1)
    assert np.abs(off).max() < 5.0 * 2 * 0.4 * 0.75 + 1.0


def test_the_silhouette_of_a_near_surface_stays_where_it_is() -> None:
    near, far = lattice(0.15, 3.0, 8.0), lattice(0.1, 16.0, 0.0, seed=1)
    rendering = render(cloud_of(near, far), CAMERA, DOWN)
    x, _ = pixel_rays(CAMERA)
    shown = np.abs(rendering.depth - 12.0) < 1.0
    width_m = 12.0 * (x[shown].max() - x[shown].min())
    # The lattice ends a step before 3 m on one side; its outermost points reach a quarter of a step further.
    assert width_m == pytest.approx(6.0 - 0.15, abs=0.25)
    assert shown.sum() * (12.0 / CAMERA.focal_px) ** 2 == pytest.approx(5.85**2, rel=0.06)


def test_what_is_not_there_stays_empty() -> None:
    points = lattice(0.1, 12.0, 0.0)
    hole = np.hypot(points[:, 0], points[:, 1]) < 2.0
    rendering = render(cloud_of(points[~hole]), CAMERA, DOWN)
    x, y = pixel_rays(CAMERA)
    radius = 20.0 * np.hypot(x, y)
    assert not rendering.valid[radius < 1.85].any()
    assert rendering.valid[(radius > 2.15) & (radius < 8.0)].all()
    assert (rendering.index[~rendering.valid] == -1).all()


def test_a_slope_has_its_depth_between_the_points_too(monkeypatch: pytest.MonkeyPatch) -> None:
    points = lattice(0.5, 14.0, 0.0)
    points[:, 2] = 0.8 * points[:, 0]
    cloud = cloud_of(points)
    tilted = render(cloud, CAMERA, DOWN)
    monkeypatch.setattr(renderer, "block_planes", lambda *_: BlockPlanes.unknown())
    flat = render(cloud, CAMERA, DOWN)
    x, y = pixel_rays(CAMERA)
    exact = 20.0 / (1.0 + 0.8 * x)  # z = 20 - 0.8 * east, east = x * z
    middle = np.hypot(x, y) < 0.4
    assert np.nanquantile(np.abs(tilted.depth - exact)[middle], 0.95) < 0.01
    assert np.nanquantile(np.abs(flat.depth - exact)[middle], 0.95) > 0.1


def test_distant_detail_is_left_out_and_the_picture_stays_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud = cloud_of(lattice(0.1, 30.0, 0.0))
    far = look_pose((0.0, 0.0, 300.0), 0.0, -90.0)
    rendering = render(cloud, CAMERA, far)
    assert rendering.points_drawn < 0.25 * len(cloud)
    x, y = pixel_rays(CAMERA)
    inside = (np.abs(300.0 * x) < 28.0) & (np.abs(300.0 * y) < 28.0)
    assert rendering.valid[inside].all()
    for module in (renderer, splats):
        monkeypatch.setattr(module, "FINEST_PX", 0.0)
    everything = render(cloud, CAMERA, far)
    assert everything.points_drawn == len(cloud)
    assert np.abs(rendering.depth - everything.depth)[inside].max() < 0.01


def test_culling_keeps_every_node_with_a_point_in_the_picture() -> None:
    rng = np.random.default_rng(5)
    cloud = cloud_of(rng.uniform(-60, 60, (60_000, 3)) * [1, 1, 0.1])
    owner = np.repeat(np.arange(len(cloud.nodes)), cloud.nodes.count)
    for heading, pitch in ((10.0, -90.0), (120.0, -30.0), (250.0, 5.0)):
        pose = look_pose((5.0, -8.0, 12.0), heading, pitch)
        rows = visible_nodes(cloud.nodes, CAMERA, pose, near_m=0.3, finest_px=0.0)
        seen_from = pose.act(cloud.xyz)
        u, v = CAMERA.project(seen_from).T
        with np.errstate(invalid="ignore"):
            shown = (seen_from[:, 2] > 0.3) & (u > 0) & (u < CAMERA.width) & (v > 0) & (v < CAMERA.height)
        assert set(np.unique(owner[shown])) <= set(rows)
        assert len(rows) < len(cloud.nodes)


def test_nothing_in_view_is_an_empty_picture() -> None:
    cloud = build_cloud(FRAME, "unknown", lattice(0.5, 5.0, 0.0), rgb=np.full((400, 3), 9, np.uint8))
    rendering = render(cloud, CAMERA, look_pose((0.0, 0.0, 20.0), 0.0, 60.0))
    assert not rendering.valid.any()
    assert rendering.points_drawn == 0
    assert rendering.rgb is not None
    assert not rendering.rgb.any()
    assert not shaded_relief(rendering).any()


def test_points_beside_the_picture_that_reach_nothing_in_it_are_no_error() -> None:
    beside = lattice(0.1, 0.5, 0.0)
    beside[:, 0] += (CAMERA.width - CAMERA.params[2]) * 20.0 / CAMERA.focal_px + 1.2
    rendering = render(cloud_of(beside), CAMERA, DOWN)
    assert rendering.points_drawn > 0
    assert not rendering.valid.any()


def test_the_picture_does_not_depend_on_threads() -> None:
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-15, 15, (30_000, 2)), rng.uniform(0, 2, 30_000)])
    cloud = cloud_of(points)
    one, three = (render(cloud, CAMERA, DOWN, RenderOptions(threads=n)) for n in (1, 3))
    assert np.array_equal(one.depth, three.depth, equal_nan=True)
    assert np.array_equal(one.index, three.index)
    assert one.intensity is not None
    assert three.intensity is not None
    assert np.array_equal(one.intensity, three.intensity)
    assert one.points_drawn == three.points_drawn
    with pytest.raises(InvalidValueError, match="threads"):
        render(cloud, CAMERA, DOWN, RenderOptions(threads=-1))


def test_half_the_pixels_show_the_same_scene() -> None:
    cloud = cloud_of(lattice(0.2, 12.0, 0.0))
    small = CAMERA.scaled_to(160, 120)
    rendering = render(cloud, small, DOWN, RenderOptions(attributes=False))
    assert rendering.intensity is None
    x, y = pixel_rays(small)
    assert np.abs(rendering.depth[np.hypot(x, y) < 0.5] - 20.0).max() < 0.01


@pytest.mark.parametrize(("east_slope", "azimuth"), [(0.0, 315.0), (0.5, 90.0), (0.5, 270.0), (-0.3, 45.0)])
def test_relief_follows_lamberts_law(
    east_slope: float, azimuth: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = lattice(0.15, 14.0, 0.0)
    points[:, 2] = east_slope * points[:, 0]
    rendering = render(cloud_of(points), CAMERA, DOWN)
    monkeypatch.setattr(renderer, "_LIGHT_AZIMUTH_DEG", azimuth)
    picture = shaded_relief(rendering)
    normal = np.array([-east_slope, 0.0, 1.0]) / np.hypot(1.0, east_slope)
    a, e = np.radians(azimuth), np.radians(45.0)
    lit = normal @ [np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)]
    x, y = pixel_rays(CAMERA)
    middle = np.hypot(x, y) < 0.3
    assert np.median(picture[middle]) == pytest.approx(255 * (0.25 + 0.75 * max(lit, 0.0)), abs=4)


def test_relief_sees_no_slope_across_a_step() -> None:
    """The flat roof and the flat ground are equally bright up to the step; only normals across it are not."""
    cloud = cloud_of(lattice(0.15, 3.0, 8.0), lattice(0.1, 16.0, 0.0, seed=1))
    picture = shaded_relief(render(cloud, CAMERA, DOWN))
    x, y = pixel_rays(CAMERA)
    flat = 255 * (0.25 + 0.75 * np.sin(np.radians(45.0)))
    assert (np.abs(picture[np.hypot(x, y) < 0.6].astype(float) - flat) < 12).mean() > 0.98


def test_a_picture_smaller_than_the_distance_of_points_has_no_relief(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renderer, "point_distance_px", lambda _: 12)
    camera = Camera(model="SIMPLE_PINHOLE", width=16, height=10, params=(12, 8, 5))
    rendering = render(cloud_of(lattice(0.5, 14.0, 0.0)), camera, DOWN)
    assert rendering.valid.any()
    picture = shaded_relief(rendering)
    assert picture.shape == (10, 16)
    assert not picture.any()


def test_a_cloud_without_spacings_is_drawn_by_its_nodes() -> None:
    cloud = cloud_of(lattice(0.3, 12.0, 0.0))
    bare = replace(cloud, spacing_m=None)
    rendering = render(bare, CAMERA, DOWN)
    x, y = pixel_rays(CAMERA)
    assert rendering.valid[np.hypot(x, y) < 0.5].mean() > 0.99
