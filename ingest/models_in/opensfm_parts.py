"""OpenSfM's files as it writes them, checked: reconstructions and references, lenses, observations.

Reference: OpenSfM, doc/source/geometry.rst. Lengths are over the longer side of the image, the principal
point counts from its middle; `featuredb.export.formats.opensfm` is the way back.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from featuredb.errors import IngestError, InvalidValueError
from featuredb.export.formats.opensfm import LENS_TERMS
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera

_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Vector = tuple[_Number, _Number, _Number]
_Kind = TypeVar("_Kind")

UNKNOWN_DOP = 15.0  # what OpenSfM writes where a photo does not say


class OpensfmReference(BaseModel):
    """Origin of the topocentric frame: degrees, and metres above the ellipsoid of WGS84."""

    latitude: _Number
    longitude: _Number
    altitude: _Number


class OpensfmShot(BaseModel):
    """A photo: its camera's name, the rotation vector and translation from the frame to the camera, what it
    said of its position in the frame, and that position's deviation in metres, together or along each axis.
    """

    camera: str
    rotation: _Vector
    translation: _Vector
    gps_position: _Vector | None = None
    gps_dop: _Number | _Vector | None = None


class OpensfmPoint(BaseModel):
    """A point in the frame, and its red, green, blue from 0 to 255."""

    coordinates: _Vector
    color: _Vector


class OpensfmReconstruction(BaseModel):
    """One reconstruction; cameras as they are, since one that no shot has may be a lens that maps lack."""

    cameras: dict[str, dict[str, Any]]
    shots: dict[str, OpensfmShot] = Field(min_length=1)
    points: dict[str, OpensfmPoint] = Field(min_length=1)
    reference_lla: OpensfmReference | None = None


def read_json(path: Path, kind: TypeAdapter[_Kind]) -> _Kind:
    """A file's document.

    Raises:
        IngestError: it cannot be read, or is something else.
    """
    try:
        return kind.validate_json(path.read_bytes())
    except OSError as error:
        raise IngestError(f"{path}: expected OpenSfM's JSON, cannot be read: {error}") from error
    except ValidationError as error:
        raise IngestError(f"{path}: {_wrong(error)}") from error


def checked(found: object, kind: TypeAdapter[_Kind], path: Path) -> _Kind:
    """A part of a file's document.

    Raises:
        IngestError: it is something else.
    """
    try:
        return kind.validate_json(json.dumps(found))
    except ValidationError as error:
        raise IngestError(f"{path}: {_wrong(error)}") from error


def _wrong(error: ValidationError) -> str:
    """The first thing that is wrong with a document, and what to do."""
    first = error.errors(include_url=False)[0]
    where = "".join(f"{step}: " for step in first["loc"])
    return f"{where}{first['msg']}, found {first['input']!r:.100}; export the model again"


class _Lens(BaseModel):
    """An entry of `cameras`: the names of all projection types that maps have."""

    projection_type: Literal[
        "perspective", "fisheye", "brown", "radial", "simple_radial", "fisheye_opencv"
    ] = "perspective"
    width: int
    height: int
    focal: _Number | None = None
    focal_x: _Number | None = None
    focal_y: _Number | None = None
    c_x: _Number = 0.0
    c_y: _Number = 0.0
    k1: _Number = 0.0
    k2: _Number = 0.0
    k3: _Number = 0.0
    k4: _Number = 0.0
    p1: _Number = 0.0
    p2: _Number = 0.0


def camera_from_opensfm(entry: Mapping[str, Any], where: str) -> Camera:
    """An entry of `cameras` in reconstruction.json.

    Raises:
        IngestError: values that are missing or cannot be, or a lens that maps do not have.
    """
    try:
        lens = _Lens.model_validate(entry)
    except ValidationError as error:
        raise IngestError(f"{where}: {_wrong(error)}, or undistort its images to a simpler camera") from error
    size, middle = max(lens.width, lens.height), (lens.width / 2.0, lens.height / 2.0)
    one_focal = {"perspective": "RADIAL", "fisheye": "RADIAL_FISHEYE"}.get(lens.projection_type)
    x, y = (lens.focal, lens.focal) if one_focal else (lens.focal_x, lens.focal_y)
    if x is None or y is None:
        raise IngestError(
            f"{where}: expected {'focal' if one_focal else 'focal_x and focal_y'}, found {sorted(entry)}; "
            "export the model again"
        )
    pinhole: tuple[float, ...] = (x * size, *middle)
    model = one_focal or ("FULL_OPENCV" if lens.k3 else "OPENCV")
    if not one_focal:
        pinhole = (x * size, y * size, lens.c_x * size + middle[0], lens.c_y * size + middle[1])
    if lens.projection_type == "fisheye_opencv":
        model = "OPENCV_FISHEYE"
    terms = [getattr(lens, name) for name in LENS_TERMS[model][1]]
    none = (0.0, 0.0, 0.0) if model == "FULL_OPENCV" else ()  # its k4 to k6, which OpenSfM does not have
    try:
        return Camera(model=model, width=lens.width, height=lens.height, params=(*pinhole, *terms, *none))
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}; export the model again") from error


_COLUMNS = ("image", "track", "feature", "x", "y", "scale", "red", "green", "blue")
_VERSIONS = {  # by the first line of the file
    "OPENSFM_TRACKS_VERSION_v1": _COLUMNS,
    "OPENSFM_TRACKS_VERSION_v2": (*_COLUMNS, "segmentation", "instance"),
}
_READ = {"image": pa.string(), "track": pa.string(), **dict.fromkeys(("x", "y", "scale"), pa.float64())}
_MOST = 0.5 + 1e-9  # normalised coordinates count from the middle of the image, over its longer side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OpensfmTracks:
    """Observations of the images and tracks that were asked for, in the order of the file.

    Attributes:
        image, track: (m,) int64, rows of what was asked for.
        xy: (m, 2) normalised. scale: (m,) of the feature, over the image's longer side, > 0.
    """

    image: NDArray[np.int64]
    track: NDArray[np.int64]
    xy: FloatArray
    scale: FloatArray


def read_tracks(path: Path, images: Sequence[str], tracks: Sequence[str]) -> OpensfmTracks:
    """The observations of these images that see these tracks; others are no part of the reconstruction.

    Raises:
        IngestError: not such a file, of a version without scales, or broken: a line of other columns, a value
            that is no number, or cannot be.
    """
    try:
        with path.open("rb") as file:
            header = file.readline(100).decode(errors="replace").strip()
        if header not in _VERSIONS:
            raise IngestError(
                f"{path}: expected {' or '.join(_VERSIONS)} in the first line, found {header[:60]!r}: other "
                "versions have no scales to describe keypoints by; create the tracks by a newer OpenSfM"
            )
        table = csv.read_csv(
            path,
            csv.ReadOptions(skip_rows=1, column_names=_VERSIONS[header], use_threads=False),
            csv.ParseOptions(delimiter="\t", quote_char=False),
            csv.ConvertOptions(column_types=_READ, include_columns=list(_READ)),
        )
    except (OSError, pa.ArrowInvalid) as error:
        raise IngestError(
            f"{path}: expected OpenSfM's tracks, cannot be read: {error}; if it was cut off, copy it again"
        ) from error
    values = np.column_stack([table[name].to_numpy() for name in ("x", "y", "scale")])
    # Whatever is no number is NaN, and no comparison is true of it.
    good = (np.abs(values[:, :2]) <= _MOST).all(axis=1) & (values[:, 2] > 0.0) & (values[:, 2] <= 1.0)
    if not good.all():
        row = int(np.argmin(good))
        raise IngestError(
            f"{path}, line {row + 2}: expected x and y within -0.5 and 0.5 and a scale in (0, 1], over the "
            f"longer side of the image, found {values[row].tolist()}; export the tracks again"
        )
    image, track = (
        np.array([known.get(value, -1) for value in table[name].to_pylist()], dtype=np.int64)
        for name, known in (("image", _rows(images)), ("track", _rows(tracks)))
    )
    ours = (image >= 0) & (track >= 0)
    return OpensfmTracks(
        image=image[ours], track=track[ours], xy=values[ours, :2], scale=np.ascontiguousarray(values[ours, 2])
    )


def _rows(names: Sequence[str]) -> dict[str, int]:
    return {name: row for row, name in enumerate(names)}
