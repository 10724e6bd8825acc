"""Camera intrinsics by COLMAP's models; projection is pycolmap's own code."""

from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.stop_signals import handle_as_before

if TYPE_CHECKING:
    from numpy.polynomial import Polynomial

SUPPORTED_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "OPENCV_FISHEYE",
)

_MAX_SIZE_PX = 1_000_000
_MAX_FOCAL_PX = 1e7  # longer than any lens; larger numbers are mistaken units


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Intrinsics of one camera.

    Pixel coordinates have x to the right and y down; the centre of the top-left pixel is (0.5, 0.5).

    Attributes:
        model: COLMAP's model name, one of SUPPORTED_MODELS.
        width, height: image size in pixels to which `params` belong.
        params: COLMAP's parameters of the model, in COLMAP's order, pixels first.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def __post_init__(self) -> None:
        template = _template(self.model)
        for name in ("width", "height"):
            object.__setattr__(self, name, _pixel_count(f"Camera.{name}", getattr(self, name)))
        what, wanted = f"Camera.params of {self.model} ({template.params_info})", len(template.params)
        params = frozen_array(what, self.params, (wanted,))
        object.__setattr__(self, "params", tuple(float(p) for p in params))
        focals = [self.params[i] for i in template.focal_length_idxs()]
        if not all(0 < focal < _MAX_FOCAL_PX for focal in focals):
            raise InvalidValueError(
                f"Camera: expected every focal length in (0, {_MAX_FOCAL_PX:g}) px, found {focals}"
            )

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float, model: str = "SIMPLE_RADIAL") -> Self:
        """A camera of the given model with this focal length, centred, without distortion."""
        _template(model)  # raises where there is no such model
        width, height = _pixel_count("Camera.width", width), _pixel_count("Camera.height", height)
        camera = _pycolmap().Camera.create_from_model_name(1, model, float(focal_px), width, height)
        return cls(model=model, width=width, height=height, params=tuple(camera.params))

    @classmethod
    def from_pycolmap(cls, camera: Any) -> Self:
        """From a pycolmap.Camera."""
        return cls(
            model=camera.model.name, width=camera.width, height=camera.height, params=tuple(camera.params)
        )

    def to_pycolmap(self, camera_id: int = 1) -> Any:
        """As a pycolmap.Camera with the given id."""
        return _pycolmap().Camera(
            camera_id=camera_id,
            model=self.model,
            width=self.width,
            height=self.height,
            params=list(self.params),
        )

    @property
    def focal_px(self) -> float:
        """Mean focal length in pixels."""
        return float(np.mean([self.params[i] for i in _template(self.model).focal_length_idxs()]))

    @property
    def tan_of_fold(self) -> float:
        """Tangent of the angle off the axis from which on `project` answers NaN; infinity for most lenses."""
        return _tan_of_fold(self.model, self.params[_FIRST_RADIAL.get(self.model, len(self.params)) :])

    def with_focal(self, focal_px: float) -> "Camera":
        """The same camera with every focal length scaled so that their mean is `focal_px`."""
        params = list(self.params)
        for i in _template(self.model).focal_length_idxs():
            params[i] *= focal_px / self.focal_px
        return replace(self, params=tuple(params))

    def scaled_to(self, width: int, height: int) -> "Camera":
        """The same lens for an image resampled to another size.

        Raises:
            InvalidValueError: the aspect ratio differs by more than 1 %, so it is not the same picture.
        """
        width, height = _pixel_count("Camera.width", width), _pixel_count("Camera.height", height)
        sx, sy = width / self.width, height / self.height
        if abs(sx / sy - 1.0) > 0.01:
            raise InvalidValueError(
                f"Camera.scaled_to: {self.width}x{self.height} and {width}x{height} differ in aspect ratio; "
                "a cropped image needs a camera of its own"
            )
        camera = self.to_pycolmap()
        camera.rescale(width, height)
        return Camera.from_pycolmap(camera)

    def project(self, points_cam: ArrayLike) -> FloatArray:
        """Pixels (n, 2) of points (n, 3), or of one point (3,), in the camera frame.

        NaN for points behind the camera, and for those so far off the axis that the distortion polynomial
        has turned back: there it would draw into the picture what the lens cannot see.
        """
        points = _rows("Camera.project", points_cam, 3)
        pixels = np.asarray(self.to_pycolmap().img_from_cam(points), dtype=np.float64)
        limit = self.tan_of_fold
        if np.isfinite(limit):
            pixels[np.hypot(points[:, 0], points[:, 1]) >= limit * points[:, 2]] = np.nan
        return pixels

    def projection_jacobian(self, points_cam: FloatArray) -> FloatArray:
        """(n, 2, 3) derivatives of `project` by points (n, 3) in front, by central differences."""
        step = 1e-5 * np.maximum(points_cam[:, 2:], 1e-3)  # error about 1e-10 of the derivative in float64
        ends = [self.project(points_cam + step * axis) for axis in (*np.eye(3), *-np.eye(3))]
        return np.asarray(np.stack(ends[:3], axis=2) - np.stack(ends[3:], axis=2)) / (2.0 * step[:, None])

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Normalised image coordinates (n, 2), the ray being (x, y, 1), of pixels (n, 2) or (2,).

        NaN for pixels that the distortion model reaches from no ray.
        """
        xy = _rows("Camera.unproject", pixels, 2)
        return np.asarray(self.to_pycolmap().cam_from_img(xy), dtype=np.float64)


@cache
def _pycolmap() -> Any:
    """Imported where a camera is, and not for what only speaks of cameras: listing maps, a command's help."""
    import pycolmap

    handle_as_before()  # its glog has put a handler there that prints a stack trace
    return pycolmap


def _pixel_count(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 < value <= _MAX_SIZE_PX:
        raise InvalidValueError(f"{name}: expected a whole number in 1..{_MAX_SIZE_PX} px, found {value!r}")
    return int(value)


def _rows(name: str, value: ArrayLike, columns: int) -> FloatArray:
    """A contiguous (n, columns) float64 array of an (n, columns) or (columns,) one."""
    array: FloatArray = np.atleast_2d(np.asarray(value, dtype=np.float64))
    if array.size == 0:
        array = array.reshape(0, columns)
    if array.ndim != 2 or array.shape[1] != columns:
        raise InvalidValueError(f"{name}: expected shape (n, {columns}), found {array.shape}")
    return np.ascontiguousarray(array)


# Where the distortion begins among a model's parameters.
_FIRST_RADIAL = {
    **{"SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 4},
    **{"SIMPLE_RADIAL_FISHEYE": 3, "RADIAL_FISHEYE": 3, "OPENCV_FISHEYE": 4},
}


@lru_cache(maxsize=256)
def _tan_of_fold(model: str, distortion: tuple[float, ...]) -> float:
    """Tangent of the angle off the axis where the radial distortion stops growing, or infinity.

    The distorted radius is r (1 + k1 r^2 + k2 r^4 + ...) (a quotient of two such polynomials in FULL_OPENCV),
    r being the tangent of the angle, or the angle itself in a fisheye. Tangential terms are small beside it.
    """
    numerator, denominator = _radial_polynomials(model, distortion)
    derivative = numerator.deriv() * denominator - numerator * denominator.deriv()
    roots = derivative.roots()
    real = roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real
    fold = float(min(real[real > 0], default=np.inf))
    if "FISHEYE" not in model:
        return fold
    return float(np.tan(fold)) if fold < np.pi / 2 else np.inf


def _radial_polynomials(model: str, k: tuple[float, ...]) -> "tuple[Polynomial, Polynomial]":
    """Numerator and denominator, in r, of the distorted radius."""
    from numpy.polynomial import Polynomial

    above: tuple[float, ...] = k
    below: tuple[float, ...] = ()
    if model == "OPENCV":
        above = k[:2]
    elif model == "FULL_OPENCV":
        above, below = (k[0], k[1], k[4]), k[5:8]
    numerator = [0.0, 1.0, *(c for term in above for c in (0.0, term))]
    denominator = [1.0, *(c for term in below for c in (0.0, term))]
    return Polynomial(numerator), Polynomial(denominator)


def _template(model: str) -> Any:
    """A pycolmap camera of the model, for its constants (parameter names and places).

    Raises:
        InvalidValueError: there is no such model here.
    """
    if model not in SUPPORTED_MODELS:
        raise InvalidValueError(
            f"Camera.model: expected one of {', '.join(SUPPORTED_MODELS)}, found {model!r}"
        )
    return _made(model)


@cache
def _made(model: str) -> Any:
    return _pycolmap().Camera.create_from_model_name(1, model, 1.0, 2, 2)


# Undistortion is smooth: a polynomial of this degree in both directions interpolates it to better than
# 1e-7 for the lenses of photo cameras, and costs two small matrix products instead of one
# Newton iteration per pixel.
_DEGREE = 24


@lru_cache(maxsize=3)
def pixel_rays(camera: Camera, supersample: int = 1) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normalised image coordinates x and y, each (height * supersample, width * supersample) float32.

    The ray of element (i, j) is (x, y, 1) and passes the centre of that (sub)pixel, at pixel coordinates
    ((j + 0.5) / supersample, (i + 0.5) / supersample).
    """
    nodes = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    u, v = np.meshgrid(0.5 * (nodes + 1) * camera.width, 0.5 * (nodes + 1) * camera.height)
    at_nodes = camera.unproject(np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
    fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, _DEGREE))
    rows = np.polynomial.chebyshev.chebvander(_centres(camera.height * supersample), _DEGREE) @ fit
    columns = np.polynomial.chebyshev.chebvander(_centres(camera.width * supersample), _DEGREE) @ fit
    x, y = (np.ascontiguousarray(rows @ at_nodes[..., k] @ columns.T, dtype=np.float32) for k in (0, 1))
    x.setflags(write=False)
    y.setflags(write=False)
    return x, y


def _centres(n: int) -> FloatArray:
    """Centres of n cells of [-1, 1]."""
    return (2.0 * np.arange(n) + 1.0) / n - 1.0
