"""Lenses of OpenSfM as this system's: the way back of `featuredb.export.formats.opensfm_camera`.

Reference: OpenSfM, doc/source/geometry.rst. Lengths are over the longer side of the image, the principal
point counts from its middle.
"""

from collections.abc import Mapping
from typing import Any

from featuredb.errors import IngestError, InvalidValueError
from featuredb.geometry.camera import Camera
from ingest.models_in.json_values import member, number

_ONE_FOCAL = ("perspective", "fisheye")
_TWO_FOCALS = ("brown", "radial", "simple_radial", "fisheye_opencv")


def camera_from_opensfm(entry: Mapping[str, Any], where: str) -> Camera:
    """An entry of `cameras` in reconstruction.json.

    Raises:
        IngestError: values that are missing or cannot be, or a lens that maps do not have.
    """
    kind = entry.get("projection_type", "perspective")
    if kind not in (*_ONE_FOCAL, *_TWO_FOCALS):
        raise IngestError(
            f"{where}: expected a lens of {', '.join((*_ONE_FOCAL, *_TWO_FOCALS))}, found {kind!r}; "
            "undistort the images to a simpler camera first"
        )
    width, height = (number(member(entry, name, where), f"{where}, {name}") for name in ("width", "height"))
    size = max(width, height)

    def given(name: str) -> float:
        return number(entry.get(name, 0.0), f"{where}, {name}")

    def required(name: str) -> float:
        return number(member(entry, name, where), f"{where}, {name}")

    k = [given(f"k{i}") for i in range(1, 5)]
    if kind in _ONE_FOCAL:
        focal = required("focal") * size
        model = "RADIAL" if kind == "perspective" else "RADIAL_FISHEYE"
        return _camera(model, width, height, (focal, width / 2.0, height / 2.0, k[0], k[1]), where)
    pinhole = (
        required("focal_x") * size,
        required("focal_y") * size,
        given("c_x") * size + width / 2.0,
        given("c_y") * size + height / 2.0,
    )
    if kind == "fisheye_opencv":
        return _camera("OPENCV_FISHEYE", width, height, (*pinhole, *k), where)
    lens = (*pinhole, k[0], k[1], given("p1"), given("p2"))
    if k[2]:
        return _camera("FULL_OPENCV", width, height, (*lens, k[2], 0.0, 0.0, 0.0), where)
    return _camera("OPENCV", width, height, lens, where)


def _camera(model: str, width: float, height: float, params: tuple[float, ...], where: str) -> Camera:
    try:
        if width != int(width) or height != int(height):
            raise InvalidValueError(f"expected whole pixels, found {width}x{height}")
        return Camera(model=model, width=int(width), height=int(height), params=params)
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}; export the model again") from error
