"""What is known of one file of an ingest."""

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from featuredb.features.exif.gps import AltitudeReference
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
            where the photo names no camera (who it shares with then: ingest.photos.cameras).
        focal_px: focal length from EXIF in pixels of the stored image, or None.
        capture_time: EXIF time (timezone-aware only where EXIF gives the offset), or None.
        gps: position prior from EXIF or a table, or None.
        gps_is_hint: nobody answers for the position (a photo site's table): good enough to look for
            neighbours there, not to place an active map by.
        angles: how the camera was turned, from EXIF, XMP or a table, or None.
        altitude_reference: what gps.height_m is counted from: sea_level, ellipsoid or unknown.
        relative_altitude_m: height above take-off by a drone's barometer, or None.
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
    altitude_reference: AltitudeReference = "unknown"
    relative_altitude_m: float | None = None
    owner: str = ""
    licence: str = ""
    contributor: str = ""
    title: str = ""
    film: str = ""
    duplicate_of: str = ""
    warnings: tuple[str, ...] = ()
