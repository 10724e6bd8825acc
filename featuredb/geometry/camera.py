"""Camera intrinsics by COLMAP's models; projection is pycolmap's own code."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import pycolmap
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray

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
        if self.model not in SUPPORTED_MODELS:
            raise InvalidValueError(
                f"Camera.model: expected one of {', '.join(SUPPORTED_MODELS)}, found {self.model!r}"
            )
        if not (0 < self.width <= 1_000_000 and 0 < self.height <= 1_000_000):
            raise InvalidValueError(
                f"Camera: expected width and height in 1..1000000 px, found {self.width}x{self.height}"
            )
        params = tuple(float(p) for p in self.params)
        wanted = len(_template(self.model).params)
        if len(params) != wanted or not np.isfinite(params).all():
            raise InvalidValueError(
                f"Camera.params: {self.model} takes {wanted} finite numbers "
                f"({_template(self.model).params_info}), found {self.params!r}"
            )
        object.__setattr__(self, "params", params)
        if not 0 < self.focal_px < 1e7:
            raise InvalidValueError(f"Camera: expected a focal length > 0 px, found {self.focal_px}")

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float, model: str = "SIMPLE_RADIAL") -> Self:
        """A camera of the given model with this focal length, centred, without distortion."""
        if model not in SUPPORTED_MODELS:
            raise InvalidValueError(f"Camera.model: unknown model {model!r}")
        camera = pycolmap.Camera.create_from_model_name(1, model, float(focal_px), int(width), int(height))
        return cls(model=model, width=width, height=height, params=tuple(camera.params))

    @classmethod
    def from_pycolmap(cls, camera: Any) -> Self:
        """From a pycolmap.Camera."""
        return cls(
            model=camera.model.name, width=camera.width, height=camera.height, params=tuple(camera.params)
        )

    def to_pycolmap(self, camera_id: int = 1) -> Any:
        """As a pycolmap.Camera with the given id."""
        return pycolmap.Camera(
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

    def with_focal(self, focal_px: float) -> "Camera":
        """The same camera with every focal length scaled so that their mean is `focal_px`."""
        params = list(self.params)
        for i in _template(self.model).focal_length_idxs():
            params[i] *= focal_px / self.focal_px
        return Camera(model=self.model, width=self.width, height=self.height, params=tuple(params))

    def scaled_to(self, width: int, height: int) -> "Camera":
        """The same lens for an image resampled to another size.

        Raises:
            InvalidValueError: the aspect ratio differs by more than 1 %, so it is not the same picture.
        """
        sx, sy = width / self.width, height / self.height
        if abs(sx / sy - 1.0) > 0.01:
            raise InvalidValueError(
                f"Camera.scaled_to: {self.width}x{self.height} and {width}x{height} differ in aspect ratio; "
                "a cropped image needs a camera of its own"
            )
        camera = self.to_pycolmap()
        camera.rescale(int(width), int(height))
        return Camera.from_pycolmap(camera)

    def project(self, points_cam: ArrayLike) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) in the camera frame; NaN for points behind the camera."""
        points = np.ascontiguousarray(np.asarray(points_cam, dtype=np.float64).reshape(-1, 3))
        return np.asarray(self.to_pycolmap().img_from_cam(points), dtype=np.float64)

    def unproject(self, pixels: ArrayLike) -> FloatArray:
        """Normalised image coordinates (n, 2), the ray being (x, y, 1), of pixels (n, 2)."""
        xy = np.ascontiguousarray(np.asarray(pixels, dtype=np.float64).reshape(-1, 2))
        return np.asarray(self.to_pycolmap().cam_from_img(xy), dtype=np.float64)


_TEMPLATES: dict[str, Any] = {}


def _template(model: str) -> Any:
    """A pycolmap camera of the model, for its constants (parameter names and places)."""
    if model not in _TEMPLATES:
        _TEMPLATES[model] = pycolmap.Camera.create_from_model_name(1, model, 1.0, 2, 2)
    return _TEMPLATES[model]
