"""Camera: projection of every model against formulas written out here, inversion, resizing, refusals."""

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import SUPPORTED_MODELS, Camera

PARAMS: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (1300.0, 810.0, 590.0),
    "PINHOLE": (1300.0, 1310.0, 810.0, 590.0),
    "SIMPLE_RADIAL": (1300.0, 810.0, 590.0, -0.1),
    "RADIAL": (1300.0, 810.0, 590.0, -0.1, 0.02),
    "OPENCV": (1300.0, 1310.0, 810.0, 590.0, -0.1, 0.02, 1e-3, -2e-3),
    "FULL_OPENCV": (1300.0, 1310.0, 810.0, 590.0, 0.2, 0.02, 1e-3, -2e-3, 0.01, 0.25, 0.01, 0.002),
    "SIMPLE_RADIAL_FISHEYE": (700.0, 810.0, 590.0, -0.03),
    "RADIAL_FISHEYE": (700.0, 810.0, 590.0, -0.03, 0.004),
    "OPENCV_FISHEYE": (700.0, 710.0, 810.0, 590.0, -0.03, 0.004, 0.001, -0.0005),
}


def camera(model: str) -> Camera:
    return Camera(model=model, width=1600, height=1200, params=PARAMS[model])


def textbook_projection(model: str, point: FloatArray) -> FloatArray:
    """Brown's distortion (OpenCV's documentation) or Kannala and Brandt's fisheye, one point."""
    p = PARAMS[model]
    one_focal = model.startswith("SIMPLE") or model in ("RADIAL", "RADIAL_FISHEYE")
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if one_focal else p[:4]
    k = list(p[3:] if one_focal else p[4:])
    u, v = point[0] / point[2], point[1] / point[2]
    r = float(np.hypot(u, v))
    if model.endswith("FISHEYE"):
        theta = np.arctan(r)
        bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
        return np.array([fx * u * bent / r + cx, fy * v * bent / r + cy])
    tangential = np.zeros(2)
    radial = 1.0
    if model in ("OPENCV", "FULL_OPENCV"):
        p1, p2 = k[2:4]
        tangential = np.array(
            [2 * p1 * u * v + p2 * (r**2 + 2 * u**2), p1 * (r**2 + 2 * v**2) + 2 * p2 * u * v]
        )
        if model == "FULL_OPENCV":
            radial = 1 / (1 + k[5] * r**2 + k[6] * r**4 + k[7] * r**6)
            k = [k[0], k[1], k[4]]
        else:
            k = k[:2]
    radial *= 1 + sum(c * r ** (2 * i + 2) for i, c in enumerate(k))
    return np.array([fx * (u * radial + tangential[0]) + cx, fy * (v * radial + tangential[1]) + cy])


def rays(rng: np.random.Generator, n: int) -> FloatArray:
    """Points in front of the camera within its picture, depth 1..100."""
    direction = np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.45, 0.45, n), np.ones(n)])
    return np.asarray(direction * rng.uniform(1, 100, (n, 1)), dtype=np.float64)


def test_every_supported_model_has_an_example() -> None:
    assert set(PARAMS) == set(SUPPORTED_MODELS)


@pytest.mark.parametrize("model", SUPPORTED_MODELS)
def test_project_follows_the_textbook(model: str) -> None:
    points = rays(np.random.default_rng(1), 50)
    expected = np.array([textbook_projection(model, point) for point in points])
    np.testing.assert_allclose(camera(model).project(points), expected, atol=1e-8)


@pytest.mark.parametrize("model", SUPPORTED_MODELS)
def test_unproject_inverts_project(model: str) -> None:
    points = rays(np.random.default_rng(2), 200)
    rays_again = camera(model).unproject(camera(model).project(points))
    np.testing.assert_allclose(rays_again, points[:, :2] / points[:, 2:], atol=1e-7)


@pytest.mark.parametrize("model", SUPPORTED_MODELS)
def test_points_behind_the_camera_are_nan(model: str) -> None:
    pixels = camera(model).project([[0.1, 0.1, -1.0], [0.1, 0.1, 1.0], [0.1, 0.1, 0.0]])
    assert np.isnan(pixels[[0, 2]]).all()
    assert np.isfinite(pixels[1]).all()


def test_optical_axis_meets_the_principal_point() -> None:
    np.testing.assert_allclose(camera("OPENCV").project([0.0, 0.0, 7.0]), [[810.0, 590.0]])
    np.testing.assert_allclose(camera("PINHOLE").unproject([810.0, 590.0]), [[0.0, 0.0]])


@pytest.mark.parametrize(
    ("model", "params", "fold"),
    [
        # d/dr (r - 0.4 r^3) = 0 at r = sqrt(1 / 1.2)
        ("SIMPLE_RADIAL", (1300.0, 800.0, 600.0, -0.4), np.sqrt(1 / 1.2)),
        # 1 + 3 k1 r^2 + 5 k2 r^4 = 0 with k1 = -1/2, k2 = 1/25: r^2 = (1.5 - sqrt(1.45)) / 0.4
        ("RADIAL", (1300.0, 800.0, 600.0, -0.5, 0.04), np.sqrt((1.5 - np.sqrt(1.45)) / 0.4)),
        ("OPENCV", (1300.0, 1300.0, 800.0, 600.0, -0.4, 0.0, 0.0, 0.0), np.sqrt(1 / 1.2)),
        # r / (1 + r^2) turns back at r = 1
        ("FULL_OPENCV", (900.0, 900.0, 800.0, 600.0, 0, 0, 0, 0, 0, 1.0, 0, 0), 1.0),
        ("SIMPLE_RADIAL_FISHEYE", (900.0, 800.0, 600.0, -1 / 3), np.tan(1.0)),
    ],
)
def test_folded_distortion_is_not_seen(model: str, params: tuple[float, ...], fold: float) -> None:
    lens = Camera(model=model, width=1600, height=1200, params=params)
    angles = np.array([0.0, 0.7, 2.5])
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    inside = np.column_stack([0.999 * fold * around, np.ones(3)])
    outside = np.column_stack([1.001 * fold * around, np.ones(3)])
    assert np.isfinite(lens.project(5.0 * inside)).all()
    assert np.isnan(lens.project(5.0 * outside)).all()


def test_empty_input_gives_empty_output() -> None:
    assert camera("OPENCV").project(np.empty((0, 3))).shape == (0, 2)
    assert camera("OPENCV").unproject([]).shape == (0, 2)


@pytest.mark.parametrize("model", SUPPORTED_MODELS)
def test_resized_picture_shows_the_same_rays(model: str) -> None:
    original = camera(model)
    half = original.scaled_to(800, 600)
    points = rays(np.random.default_rng(3), 20)
    # Pixel coordinates start at the corner of the top-left pixel, so resizing is a plain multiplication.
    np.testing.assert_allclose(half.project(points), original.project(points) / 2, atol=1e-8)
    assert (half.width, half.height) == (800, 600)


def test_resize_refuses_another_aspect_ratio() -> None:
    assert camera("PINHOLE").scaled_to(801, 600).width == 801  # rounding of a resize
    for size in ((1600, 900), (1200, 1600), (0, 0), (-800, -600), (800.5, 600.0)):
        with pytest.raises(InvalidValueError, match="Camera"):
            camera("PINHOLE").scaled_to(*size)  # type: ignore[arg-type]


def test_focal_length_is_replaced_in_proportion() -> None:
    changed = camera("OPENCV").with_focal(2610.0)
    assert changed.focal_px == pytest.approx(2610.0)
    assert changed.params[0] / changed.params[1] == pytest.approx(1300 / 1310)
    assert changed.params[2:] == PARAMS["OPENCV"][2:]
    with pytest.raises(InvalidValueError, match="focal"):
        camera("OPENCV").with_focal(-1.0)


def test_from_focal_is_centred_and_undistorted() -> None:
    for model in SUPPORTED_MODELS:
        lens = Camera.from_focal(1600, 1200, 1000.0, model)
        assert lens.focal_px == 1000.0
        np.testing.assert_allclose(lens.project([0, 0, 1]), [[800, 600]])
    np.testing.assert_allclose(Camera.from_focal(1600, 1200, 1000.0).project([0.2, -0.1, 1]), [[1000, 500]])


@pytest.mark.parametrize("model", SUPPORTED_MODELS)
def test_pycolmap_round_trip_is_exact(model: str) -> None:
    assert Camera.from_pycolmap(camera(model).to_pycolmap(7)) == camera(model)
    assert camera(model).to_pycolmap(7).camera_id == 7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "THIN_PRISM"}, r"Camera\.model"),
        ({"width": 0}, r"Camera\.width"),
        ({"width": 100.5}, r"Camera\.width"),
        ({"width": "1600"}, r"Camera\.width"),
        ({"height": True}, r"Camera\.height"),
        ({"height": 2_000_000}, r"Camera\.height"),
        ({"params": (1300.0, 800.0, 600.0)}, r"Camera\.params"),
        ({"params": (1300.0, 1300.0, 800.0, np.nan)}, r"Camera\.params"),
        ({"params": ("f", 1300.0, 800.0, 600.0)}, r"Camera\.params"),
        ({"params": None}, r"Camera\.params"),
        ({"params": (-10.0, 1300.0, 800.0, 600.0)}, "focal"),
        ({"params": (0.0, 0.0, 800.0, 600.0)}, "focal"),
        ({"params": (1e8, 1300.0, 800.0, 600.0)}, "focal"),
    ],
)
def test_bad_cameras_are_refused(change: dict[str, object], message: str) -> None:
    good: dict[str, object] = {
        "model": "PINHOLE",
        "width": 1600,
        "height": 1200,
        "params": (1300.0, 1300.0, 800.0, 600.0),
    }
    Camera(**good)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match=message):
        Camera(**(good | change))  # type: ignore[arg-type]


def test_bad_points_are_refused() -> None:
    for shape in ((2, 6), (4, 2), (2, 2, 3)):
        with pytest.raises(InvalidValueError, match=r"Camera\.project"):
            camera("PINHOLE").project(np.ones(shape))
    with pytest.raises(InvalidValueError, match=r"Camera\.unproject"):
        camera("PINHOLE").unproject(np.ones((2, 3)))
