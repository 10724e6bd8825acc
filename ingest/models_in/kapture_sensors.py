"""kapture's text files, and the cameras, images, poses and positions of its folder `sensors`."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from featuredb.errors import IngestError, InvalidValueError
from featuredb.features.exif.gps import (
    DEFAULT_SIGMA_HORIZONTAL_M,
    DEFAULT_SIGMA_VERTICAL_M,
    RANGE_ERROR_M,
)
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import GeoPrior

_WGS84 = ("", "EPSG:4326")
_Key = tuple[int, str]  # timestamp, device


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KaptureImage:
    """An image with a pose.

    Attributes:
        device: of its camera. gps: of a receiver at the same timestamp, or None.
    """

    name: str
    device: str
    cam_from_world: Rigid3
    gps: GeoPrior | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KaptureSensors:
    """What the folder holds.

    Attributes:
        cameras: by device, in the order of the file; those that images with a pose have.
        camera_ids: of `cameras`, their numbers among all cameras of the file, from 1.
        images: with a pose, by timestamp and device.
        records: names of all images.
        files: that it was read from.
    """

    cameras: Mapping[str, Camera]
    camera_ids: tuple[int, ...]
    images: tuple[KaptureImage, ...]
    records: frozenset[str]
    files: tuple[Path, ...]


def read_sensors(folder: Path) -> KaptureSensors:
    """The cameras, and the images with a pose.

    Raises:
        IngestError: another version of the format, broken files, unknown cameras, lenses that maps do not
            have, or no image with a pose.
    """
    path = folder / "sensors.txt"
    check_version(path)
    sensors = {values[0]: (where, values[2:]) for where, values in table(path, 3)}
    records = {
        (_timestamp(values[0], where), values[1]): (where, values[2])
        for where, values in table(folder / "records_camera.txt", 3, 3)
    }
    poses = _poses(folder)
    gps = _positions(folder, sensors)
    images = []
    cameras: dict[str, Camera] = {}
    for key, (where, name) in sorted(records.items()):
        parts = name.split("/")
        if name.startswith("/") or "\0" in name or any(part in ("", "..") for part in parts):
            raise IngestError(f"{where}: expected a path below records_data, found {name[:60]!r}")
        if key not in poses:
            continue
        device = key[1]
        if device not in sensors or sensors[device][1][0] != "camera":
            raise IngestError(
                f"{where}: expected a camera of {path}, found {device!r}; export the model again"
            )
        if device not in cameras:
            cameras[device] = _camera(*sensors[device])
        images.append(
            KaptureImage(name=name, device=device, cam_from_world=poses[key], gps=_of_image(gps, *key))
        )
    if not images:
        raise IngestError(
            f"{folder}: expected images with a pose, found {len(records)} images and {len(poses)} poses of "
            "them"
        )
    names = {image.name for image in images}
    if len(names) != len(images):
        raise IngestError(f"{folder / 'records_camera.txt'}: expected every image once, found some again")
    every = [device for device, (_, values) in sensors.items() if values[0] == "camera"]
    read = ("sensors.txt", "records_camera.txt", "trajectories.txt", "rigs.txt", "records_gnss.txt")
    return KaptureSensors(
        cameras={device: cameras[device] for device in every if device in cameras},
        camera_ids=tuple(k for k, device in enumerate(every, start=1) if device in cameras),
        images=tuple(images),
        records=frozenset(name for _, name in records.values()),
        files=tuple(folder / name for name in read if (folder / name).is_file()),
    )


def _timestamp(value: str, where: str) -> int:
    if value.removeprefix("-").isdecimal() and len(value) < 20:
        return int(value)
    raise IngestError(f"{where}: expected a timestamp, found {value[:40]!r}; export the model again")


def _camera(where: str, values: list[str]) -> Camera:
    """Of `camera, model, width, height, parameters`, which are COLMAP's."""
    model, *params = values[1:] or [""]
    numbers = floats(params, where)
    try:
        if len(numbers) < 2 or (numbers[:2] != np.floor(numbers[:2])).any():
            raise InvalidValueError(f"expected a size in whole pixels, found {numbers[:2].tolist()}")
        width, height = (int(v) for v in numbers[:2])
        return Camera(model=model, width=width, height=height, params=tuple(numbers[2:].tolist()))
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}; undistort the images to a simpler camera first") from error


def _poses(folder: Path) -> dict[_Key, Rigid3]:
    """World to device; what a rig carries goes with it. Records without a whole pose have none."""
    rigs: dict[str, list[tuple[str, Rigid3]]] = {}
    if (folder / "rigs.txt").is_file():
        for where, values in table(folder / "rigs.txt", 9, 9):
            pose = _pose(values[2:], where)
            if pose is not None:
                rigs.setdefault(values[0], []).append((values[1], pose))
    found: dict[_Key, Rigid3] = {}
    for where, values in table(folder / "trajectories.txt", 9, 9):
        pose = _pose(values[2:], where)
        if pose is None:
            continue
        timestamp, device = _timestamp(values[0], where), values[1]
        found[timestamp, device] = pose
        for sensor, sensor_from_rig in rigs.get(device, []):
            if sensor in rigs:
                raise IngestError(
                    f"{folder / 'rigs.txt'}: expected rigs of sensors, found {sensor!r}, a rig, in one"
                )
            found.setdefault((timestamp, sensor), sensor_from_rig @ pose)
    return found


def _pose(values: list[str], where: str) -> Rigid3 | None:
    """Of qw, qx, qy, qz, tx, ty, tz; None where some of it is unknown."""
    if "" in values:
        return None
    numbers = floats(values, where)
    try:
        return Rigid3.from_quaternion(np.roll(numbers[:4], -1), numbers[4:])
    except InvalidValueError as error:
        raise IngestError(f"{where}: {error}; export the model again") from error


def _positions(folder: Path, sensors: Mapping[str, tuple[str, list[str]]]) -> dict[_Key, GeoPrior]:
    """Positions in WGS84 by timestamp and receiver; those in other systems are not read."""
    path = folder / "records_gnss.txt"
    found: dict[_Key, GeoPrior] = {}
    if not path.is_file():
        return found
    for where, values in table(path, 7, 7):
        _, (kind, *crs) = sensors.get(values[1], ("", ["gnss"]))
        if kind != "gnss" or (crs[0] if crs else "") not in _WGS84:
            continue
        longitude, latitude, height, dop = floats([*values[2:5], values[6]], where)
        horizontal = dop * RANGE_ERROR_M if dop > 0 else DEFAULT_SIGMA_HORIZONTAL_M
        try:
            found[_timestamp(values[0], where), values[1]] = GeoPrior(
                latitude_deg=float(latitude),
                longitude_deg=float(longitude),
                height_m=float(height),
                sigma_horizontal_m=float(horizontal),
                sigma_vertical_m=float(horizontal * DEFAULT_SIGMA_VERTICAL_M / DEFAULT_SIGMA_HORIZONTAL_M),
            )
        except InvalidValueError as error:
            raise IngestError(f"{where}: {error}") from error
    return found


def _of_image(gps: Mapping[_Key, GeoPrior], timestamp: int, device: str) -> GeoPrior | None:
    """That of the receiver that kapture names after the camera, which is how it keeps what EXIF says."""
    return gps.get((timestamp, f"GPS_{device}"))


_VERSION = re.compile(r"#\s*kapture format:\s*(\S+)")
_MAJOR_MINOR = "1.1"
_LONGEST_LINE = 10_000_000  # of a point that a hundred thousand images see

Row = tuple[str, list[str]]
"""Where a row stands, for error messages, and its values."""


def check_version(path: Path) -> None:
    """Whether a file is of kapture 1.1.

    Raises:
        IngestError: it is not.
    """
    try:
        with path.open(encoding="utf-8") as file:
            first = file.readline(200)
    except (OSError, UnicodeDecodeError) as error:
        raise IngestError(f"{path}: expected kapture's file, cannot be read: {error}") from error
    found = _VERSION.match(first)
    if found is None or found[1] != _MAJOR_MINOR:
        raise IngestError(
            f"{path}: expected '# kapture format: {_MAJOR_MINOR}' in the first line, found "
            f"{first[:60].strip()!r}; "
            "bring it to that version by kapture_upgrade_1.0_to_1.1.py of kapture"
        )


def table(path: Path, least: int, most: int | None = None) -> Iterator[Row]:
    """The rows of a file, of at least and at most so many values.

    Raises:
        IngestError: it is missing, no text, or has a row of another number.
    """
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), start=1):
                if not line.strip() or line.startswith("#"):
                    continue
                values = [value.strip() for value in line.split(",")]
                where = f"{path}, line {number}"
                if len(values) < least or (most is not None and len(values) > most):
                    expected = f"{least}" if most == least else f"at least {least}"
                    raise IngestError(
                        f"{where}: expected {expected} values, found {len(values)}: the file is cut off or "
                        "broken; copy or export it again"
                    )
                yield where, values
    except (OSError, UnicodeDecodeError) as error:
        raise IngestError(f"{path}: expected kapture's table, cannot be read: {error}") from error


def floats(values: list[str], where: str) -> FloatArray:
    """Finite numbers.

    Raises:
        IngestError: something else.
    """
    try:
        found = np.array([float(value) for value in values], dtype=np.float64)
    except ValueError:
        found = np.full(1, np.nan)
    if not np.isfinite(found).all():
        raise IngestError(
            f"{where}: expected finite numbers, found {', '.join(v[:20] for v in values[:8])}; export it "
            "again"
        )
    return found


def whole(value: str, below: int | None, where: str) -> int:
    """A number from 0, below a bound.

    Raises:
        IngestError: something else.
    """
    if value.isdecimal() and len(value) < 20 and (below is None or int(value) < below):
        return int(value)
    expected = "a number from 0" if below is None else f"a number from 0 to {below - 1}"
    raise IngestError(f"{where}: expected {expected}, found {value[:40]!r}; the files do not belong together")
