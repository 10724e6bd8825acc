"""What is known of one file of an ingest; which photos share intrinsics; where they say they were taken."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from featuredb.features.exif.read import UNNAMED_MAKE
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.camera_angles import CameraAngles
from featuredb.maps.feature_map import GeoPrior

PhotoStatus = Literal["ok", "skipped"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Photo:
    """One file of the folder or table, usable or not.

    Attributes:
        name: path within the ingested folder, with forward slashes, or what the table calls it; unique
            within the ingest.
        path: where the file lies.
        sha256: hex digest of its bytes, "" where it could not be read.
        status: ok, or skipped with a `reason` for people and a `reason_code` for programs.
        width, height: size in pixels as stored (before EXIF orientation is applied), 0 if unknown.
        orientation: EXIF orientation 1..8; features and cameras are in the pixels as stored, the
            orientation is kept for display only.
        make, model: camera maker and model from EXIF, "" where absent.
        camera_key: photos with equal keys share one set of intrinsics (see featuredb.features.exif.read); ""
            where the photo names no camera (who it shares with then: ingest.photos.photo).
        focal_px: focal length from EXIF in pixels of the stored image, or None.
        capture_time: EXIF time (timezone-aware only where EXIF gives the offset), or None.
        gps: position prior from EXIF or a table, or None.
        gps_is_hint: nobody answers for the position (a photo site's table): good enough to look for
            neighbours there, not to place an active map by.
        angles: how the camera was turned, from EXIF, XMP or a table, or None.
        owner, licence: attribution from a table, EXIF (Artist, Copyright) or the ingest's options.
        contributor: who gave it to the database, as the wire has authenticated (`Candidate.owner`); "" for
            photos that come from this machine.
        title: from a table.
        film: name of the film that this is a keyframe of, "" for other photos.
        duplicate_of: name of the photo that was kept instead, "" where this is no duplicate.
        warnings: what was wrong in the photo's metadata without making it unusable.
    """

    name: str
    path: Path
    sha256: str = ""
    status: PhotoStatus = "ok"
    reason_code: str = ""
    reason: str = ""
    width: int = 0
    height: int = 0
    orientation: int = 1
    make: str = ""
    model: str = ""
    camera_key: str = ""
    focal_px: float | None = None
    capture_time: datetime | None = None
    gps: GeoPrior | None = None
    gps_is_hint: bool = False
    angles: CameraAngles | None = None
    owner: str = ""
    licence: str = ""
    contributor: str = ""
    title: str = ""
    film: str = ""
    duplicate_of: str = ""
    warnings: tuple[str, ...] = ()


CameraSharing = Literal["shared", "per-image"]

# 1.2 times the longer side is a field of view of 45 degrees, COLMAP's guess without EXIF.
_DEFAULT_FOCAL_OVER_SIDE = 1.2
_ONE_LENS = 0.05  # of the logarithm, chosen: `reichstag`'s 74 people have 0.19


def photo_cameras(
    photos: Sequence[Photo], sharing: CameraSharing, camera_model: str
) -> tuple[list[tuple[Camera, bool]], list[int]]:
    """Cameras (with whether EXIF gives the focal length) and the camera's row of each photo."""
    rows: dict[str, int] = {}
    cameras: list[tuple[Camera, bool]] = []
    of_photo: list[int] = []
    for photo in photos:
        key = shared_key(photo, sharing)
        if key not in rows:
            rows[key] = len(cameras)
            known = photo.focal_px is not None
            focal = photo.focal_px or _DEFAULT_FOCAL_OVER_SIDE * max(photo.width, photo.height)
            cameras.append((Camera.from_focal(photo.width, photo.height, focal, camera_model), known))
        of_photo.append(rows[key])
    return cameras, of_photo


def shared_key(photo: Photo, sharing: CameraSharing) -> str:
    """Photos with equal keys share intrinsics.

    Those of one make, model, size and focal length do. A photo that names no camera shares with those of the
    same owner (by the same contributor), day and size: left alone, a view straight down finds a focal length
    a quarter off and a height to go with it. Where no day is known, which is so for most contributions
    without EXIF, owner and size must do; without an owner it is alone.
    """
    if sharing == "per-image":
        return photo.name
    if photo.camera_key:
        return photo.camera_key
    if not photo.owner:
        return photo.name
    time = photo.capture_time
    day = "some day" if time is None else str((time.astimezone(UTC) if time.tzinfo else time).date())
    whose = f"{photo.owner} by {photo.contributor}" if photo.contributor else photo.owner
    focal = "" if photo.focal_px is None else f", {photo.focal_px:.1f} px"
    return f"unnamed camera of {whose}, {day}, {photo.width} x {photo.height}{focal}"


def whose_cameras(photos: Sequence[Photo], focals_px: Sequence[float] = ()) -> NDArray[np.int64]:
    """(n,) numbers of whose and which camera took each photo.

    By who contributed it; else by owner; else by make and model. Photos that name nothing are by as many
    cameras as there are films and sizes, but by one where their focal lengths agree: programs cut and resize.

    Args:
        focals_px: (n,) as reconstructed; none: sizes must do.
    """
    keys: list[tuple[str, ...]] = [
        (p.contributor or p.owner,) if p.contributor or p.owner else (p.make, p.model) for p in photos
    ]
    rows = [k for k, p in enumerate(photos) if not any(keys[k]) or keys[k][0] == UNNAMED_MAKE]
    sides = np.array([max(photos[k].width, photos[k].height) for k in rows])
    if len(focals_px) and rows:
        relative = np.log(np.asarray(focals_px, dtype=np.float64)[rows] / sides)
        if 1.4826 * float(np.median(np.abs(relative - np.median(relative)))) < _ONE_LENS:
            for k in rows:
                keys[k] = ("one lens",)
            rows = []
    for k in rows:
        keys[k] = (photos[k].film or f"{photos[k].width} x {photos[k].height}",)
    numbers: dict[tuple[str, ...], int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


def local_frame_of(photos: Sequence[Photo]) -> LocalFrame | None:
    """A frame at the photos' median position."""
    gps = _geodetic(photos)
    return LocalFrame.amid(gps) if len(gps) else None


def gps_positions(photos: Sequence[Photo], frame: LocalFrame | None = None) -> FloatArray:
    """East, north, up (n, 3) in metres of photos with GPS; height 0 where the photo has none."""
    geodetic = _geodetic(photos)
    if frame is None:
        frame = LocalFrame(latitude_deg=geodetic[0, 0], longitude_deg=geodetic[0, 1], height_m=0.0)
    return frame.enu_from_geodetic(geodetic)


def without_unset_heights(photos: Sequence[Photo]) -> tuple[list[Photo], tuple[str, ...]]:
    """The photos, without heights that are exactly zero, and a line on them.

    Programs write zero where they know no height; taken at its word it lays a map at sea level. Where it is
    one, the other photos tell it as well.
    """
    unset = {photo.name for photo in photos if photo.gps is not None and photo.gps.height_m == 0.0}
    if not unset:
        return list(photos), ()
    note = f"the heights of {len(unset)} photos are exactly zero, and are taken as unknown"
    return [
        replace(p, gps=replace(p.gps, height_m=None)) if p.gps and p.name in unset else p for p in photos
    ], (note,)


def _geodetic(photos: Sequence[Photo]) -> FloatArray:
    """Latitude, longitude, height (n, 3) of photos with GPS."""
    known = [photo.gps for photo in photos if photo.gps is not None]
    return np.array([[gps.latitude_deg, gps.longitude_deg, gps.height_m or 0.0] for gps in known])


def gps_priors(photos: Sequence[Photo], frame: LocalFrame | None) -> tuple[FloatArray, FloatArray]:
    """Positions and sigmas (n, 3) in the frame: NaN for photos without GPS, infinite without height."""
    positions = np.full((len(photos), 3), np.nan)
    sigmas = np.full((len(photos), 3), np.nan)
    rows = [i for i, p in enumerate(photos) if p.gps is not None]
    if frame is not None and rows:
        positions[rows] = gps_positions([photos[i] for i in rows], frame)
        for i in rows:
            gps = photos[i].gps
            assert gps is not None
            vertical = gps.sigma_vertical_m if gps.height_m is not None else np.inf
            sigmas[i] = (gps.sigma_horizontal_m, gps.sigma_horizontal_m, vertical)
    return positions, sigmas


def capture_seconds(photos: Sequence[Photo]) -> FloatArray | None:
    """Times (n,) of capture; None where some photo does not say, or some do not say in which zone."""
    times = [photo.capture_time for photo in photos if photo.capture_time is not None]
    if len(times) < len(photos) or len({time.tzinfo is None for time in times}) != 1:
        return None
    return np.array([(time - times[0]).total_seconds() for time in times])


def answered_positions(
    photos: Sequence[Photo], frame: LocalFrame
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Photos (n,) whose positions somebody answers for, with these (n, 3) and their sigmas (n, 3)."""
    xyz, sigmas = gps_priors(photos, frame)
    hints = np.array([photo.gps_is_hint for photo in photos], dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(sigmas).all(axis=1) & ~hints)
    return rows, xyz[rows], sigmas[rows]
