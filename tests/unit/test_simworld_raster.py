"""The renderer's geometry against independent routes: pycolmap's lens, brute-force rays, marker centroids."""

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera, pixel_rays
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import look_pose
from featuredb.simworld.camera.raster import render
from featuredb.simworld.camera.shading import Look
from featuredb.simworld.town.blocks import box, face
from featuredb.simworld.town.scene import SKY_ID, TEXTURES, Ellipsoids, Faces, Scene
from featuredb.simworld.town.texture import Texture
from featuredb.simworld.town.town import make_town

CAMERAS = (
    Camera(model="OPENCV", width=320, height=240, params=(240, 242, 163, 118, -0.08, 0.03, 0.001, -0.0007)),
    Camera(model="SIMPLE_RADIAL", width=241, height=321, params=(260, 120.5, 160.5, 0.06)),
    Camera(model="OPENCV_FISHEYE", width=320, height=240, params=(150, 150, 160, 120, 0.02, -0.01, 0, 0)),
)
NOTHING = Ellipsoids(
    center=np.zeros((0, 3)),
    radii=np.zeros((0, 3)),
    tint=np.zeros((0, 3)),
    texture_uv=np.zeros((0, 2)),
    object_id=np.zeros(0, np.int32),
)


@pytest.fixture(scope="module")
def town() -> Scene:
    return make_town(3, size_m=(200.0, 180.0))


def centres(camera: Camera) -> NDArray[np.float64]:
    """Pixel centres (h * w, 2), row by row."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return np.column_stack([x.ravel(), y.ravel()])


def cast(
    faces: Faces, ellipsoids: Ellipsoids, origin: NDArray[np.float64], ray: NDArray[np.float64]
) -> tuple[float, int]:
    """Parameter along `ray` of the first hit from `origin` and its object: Moeller-Trumbore over all faces,
    and the quadratic of every ellipsoid, in float64 and in the local frame."""
    p = np.cross(ray, faces.edge_t)
    determinant = np.einsum("ij,ij->i", faces.edge_s, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_origin = origin - faces.origin
        s = np.einsum("ij,ij->i", to_origin, p) / determinant
        q = np.cross(to_origin, faces.edge_s)
        t = q @ ray / determinant
        z = np.einsum("ij,ij->i", faces.edge_t, q) / determinant
    inside = (s >= 0) & (t >= 0) & np.where(faces.triangle, s + t <= 1, (s <= 1) & (t <= 1))
    hit = inside & (determinant > 0) & (z > 0.1)
    best, found = np.inf, SKY_ID
    if hit.any():
        i = int(np.flatnonzero(hit)[np.argmin(z[hit])])
        best, found = float(z[i]), int(faces.object_id[i])
    for i in range(len(ellipsoids)):
        d, w = ray / ellipsoids.radii[i], (origin - ellipsoids.center[i]) / ellipsoids.radii[i]
        a, b, c = d @ d, d @ w, w @ w - 1
        if b * b >= a * c and 0.1 < (z1 := (-b - np.sqrt(b * b - a * c)) / a) < best:
            best, found = float(z1), int(ellipsoids.object_id[i])
    return best, found


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("supersample", [1, 2])
def test_rays_are_those_of_the_lens(camera: Camera, supersample: int) -> None:
    x, y = pixel_rays(camera, supersample)
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, x.shape[0], 400), rng.integers(0, x.shape[1], 400)
    i[:4], j[:4] = [0, 0, -1, -1], [0, -1, 0, -1]
    rows, columns = i % x.shape[0], j % x.shape[1]
    wanted = camera.unproject(np.column_stack([columns + 0.5, rows + 0.5]) / supersample)
    found = np.column_stack([x[i, j], y[i, j]])
    # 1e-6 of the focal length is less than a thousandth of a pixel.
    np.testing.assert_allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_depth_and_objects_of_a_town_equal_brute_force_rays(camera: Camera, town: Scene) -> None:
    rng = np.random.default_rng(5)
    near_tree = town.ellipsoids.center[10] + [9.0, 4.0, 3.0]
    poses = (
        look_pose((5, -8, 65), 40, -60),
        look_pose(near_tree, 250, -12, 7),
        look_pose((0, 0, 60), 0, -90),
    )
    pixels = centres(camera)
    checked = 0
    for cam_from_local in poses:
        rendered = render(town.faces, town.ellipsoids, camera, cam_from_local)
        for index in rng.integers(0, len(pixels), 60):
            row, column = divmod(int(index), camera.width)
            neighbours = rendered.object_id[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
            if len(np.unique(neighbours)) > 1:
                continue  # on an edge float32 and float64 may disagree about who is hit
            ray_cam = np.append(camera.unproject(pixels[index])[0], 1.0)
            depth, found = cast(
                town.faces, town.ellipsoids, cam_from_local.center, cam_from_local.rotation.T @ ray_cam
            )
            assert rendered.object_id[row, column] == found
            if found != SKY_ID:
                assert rendered.depth[row, column] == pytest.approx(depth, rel=2e-5)
            else:
                assert np.isinf(rendered.depth[row, column])
            checked += 1
    assert checked > 100


def test_a_camera_among_walls_sees_past_the_near_plane(town: Scene) -> None:
    camera = CAMERAS[0]
    cam_from_local = look_pose((0.0, 0.0, float(town.plan.height(0.0)) + 1.7), 15, -5)
    rendered = render(town.faces, town.ellipsoids, camera, cam_from_local)
    pixels = centres(camera)
    checked = 0
    for index in range(0, len(pixels), 997):
        row, column = divmod(index, camera.width)
        block = rendered.object_id[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if len(np.unique(block)) == 1:
            ray = cam_from_local.rotation.T @ np.append(camera.unproject(pixels[index])[0], 1.0)
            depth, found = cast(town.faces, town.ellipsoids, cam_from_local.center, ray)
            assert (rendered.object_id[row, column], rendered.depth[row, column]) == (
                found,
                pytest.approx(depth, rel=1e-4),
            )
            checked += 1
    assert checked > 40


def flat_look(colours: dict[str, int]) -> Look:
    """Textures of one grey level each; black where none is given."""
    grey = {n: np.full((16, 16, 3), colours.get(n, 0), np.uint8) for n in (*TEXTURES, "detail")}
    textures = tuple(Texture.from_image(grey[n], 0.05) for n in TEXTURES)
    return Look(
        textures=textures, detail=Texture.from_image(grey["detail"], 0.05), to_sun=np.array([0.0, 0.0, 1.0])
    )


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
@pytest.mark.parametrize("at", [(-5.0, 3.0), (0.0, 0.0), (7.0, -6.5)])
def test_markers_appear_where_the_camera_projects_them(camera: Camera, at: tuple[float, float]) -> None:
    cam_from_local = look_pose((2.0, -3.0, 30.0), 33, -84, 4)
    ground = face((-200, -200, 0), (400, 0, 0), (0, 400, 0), "plain", 1)
    corner, side = np.array([*at, 1.0]), 1.3
    marker = face(corner, (side, 0, 0), (0, side, 0), "car", 2)
    picture = render(
        Faces.concatenate([ground, marker]),
        NOTHING,
        camera,
        cam_from_local,
        look=flat_look({"plain": 40, "car": 240}),
        supersample=2,
    )
    assert picture.rgb is not None
    weight = picture.rgb[..., 0].astype(float) - 40.0
    assert weight.sum() > 0
    centroid = (centres(camera) * weight.reshape(-1, 1)).sum(axis=0) / weight.sum()
    # The projected outline's centroid by the shoelace formula, with bent edges followed in steps.
    f = np.linspace(0, 1, 40, endpoint=False)
    steps = np.concatenate(
        [np.c_[f, 0 * f], np.c_[0 * f + 1, f], np.c_[1 - f, 0 * f + 1], np.c_[0 * f, 1 - f]]
    )
    outline = camera.project(cam_from_local.act(corner + side * np.c_[steps, 0 * steps[:, :1]]))
    following = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * following[:, 1] - following[:, 0] * outline[:, 1]
    wanted = ((outline + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    np.testing.assert_allclose(centroid, wanted, atol=0.06)
    # Coverage, too: supersampled edges carry the right share of light.
    assert weight.sum() / 200.0 == pytest.approx(abs(cross.sum()) / 2, rel=0.04)


def test_textures_are_averaged_not_sampled() -> None:
    """A pattern finer than a pixel becomes its mean; sampling it would make false structure."""
    rng = np.random.default_rng(2)
    chequers = np.repeat(rng.integers(0, 2, (512, 512, 1), dtype=np.uint8) * 255, 3, axis=2)
    look = flat_look({})
    textures = list(look.textures)
    textures[TEXTURES.index("plain")] = Texture.from_image(chequers, 0.01)
    look = Look(textures=tuple(textures), detail=look.detail, to_sun=look.to_sun)
    ground = face((-200, -200, 0), (400, 0, 0), (0, 400, 0), "plain", 1)
    picture = render(
        ground, NOTHING, CAMERAS[0], look_pose((0, 0, 40), 0, -90), look=look, supersample=2
    )  # 17 cm a pixel, 17 texels
    assert picture.rgb is not None
    # Texels are 0 or 255 (deviation 127); averaging 16 x 16 of them leaves 8, and interpolation less.
    assert picture.rgb.mean() == pytest.approx(127.5, abs=2.0)
    assert 2.0 < picture.rgb.std() < 9.0


def test_back_faces_and_what_lies_behind_are_not_drawn() -> None:
    camera = CAMERAS[0]
    cube = box(0.0, 0.0, 0.0, (2.0, 2.0, 2.0), 7)
    above, below = look_pose((0, 0, 10), 0, -90), look_pose((0, 0, -10), 0, -90)
    seen = render(cube, NOTHING, camera, above)
    assert seen.depth[120, 160] == pytest.approx(8.0, rel=1e-6)
    assert (render(cube, NOTHING, camera, below).object_id == SKY_ID).all()
    inside = render(cube, NOTHING, camera, look_pose((0, 0, 1), 0, -90))
    assert (inside.object_id == SKY_ID).all()


def test_poses_look_where_they_say() -> None:
    east_level = look_pose((1.0, 2.0, 3.0), 90, 0)
    np.testing.assert_allclose(east_level.center, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(east_level.rotation, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)
    down_top_north = look_pose((0, 0, 0), 0, -90)
    np.testing.assert_allclose(down_top_north.rotation, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    # Rolled clockwise by 90 degrees the camera's right is where down was.
    rolled = look_pose((0, 0, 0), 90, 0, 90)
    np.testing.assert_allclose(rolled.rotation[0], east_level.rotation[1], atol=1e-12)
    assert isinstance(rolled, Rigid3)


def test_faces_of_wrong_shape_are_refused() -> None:
    good = box(0, 0, 0, (1, 1, 1), 1)
    columns = {name: getattr(good, name) for name in Faces.__dataclass_fields__}
    with pytest.raises(InvalidValueError, match=r"Faces\.uv"):
        Faces(**{**columns, "uv": good.uv[:, :4]})
