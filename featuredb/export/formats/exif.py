"""Copies of the photos with the pose that the map gives them: EXIF's GPS, and XMP's angles and accuracy.

Photos are found by the SHA-256 of their bytes, whatever they are called. Originals are only read. Only JPEG:
its segments can be exchanged without touching the picture.
"""

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from featuredb.atomic import file_sha256
from featuredb.errors import ExportError, FeatureDbError, ImageError
from featuredb.export.formats.colmap import image_names
from featuredb.export.job import (
    Attribution,
    Exported,
    ExportJob,
    attribution_of,
    folder_name,
    whole_or_nothing,
    write_attribution,
    write_csv,
)
from featuredb.export.shots import PosedPhoto, altitude_of, shots_of
from featuredb.features.exif.gps import RADIUS_68
from featuredb.features.exif.write import gps_directory, with_app1, with_gps, with_properties
from featuredb.features.image_header import read_header

FILES_TABLE = "files.csv"
# What the receiver said of its own position no longer belongs to the position that is written.
_STALE = (
    *("drone-dji:RtkFlag", "drone-dji:RtkStdLat", "drone-dji:RtkStdLon", "drone-dji:RtkStdHgt"),
    *("drone-dji:GpsStatus", "drone-dji:GpsLatitude", "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude"),
    "drone-dji:AbsoluteAltitude",
)


class _File(NamedTuple):
    """What became of one photo: its file in the export, or why there is none."""

    map_id: str
    image: str
    sha256: str
    file: str
    reason: str


def write_exif(job: ExportJob, photos: Path | None) -> Exported:
    """Write copies to `job.out`/<map>/<photo>, with files.csv and attribution.csv.

    A photo that is not in the folder, or no JPEG, is named in files.csv with the reason, and not counted.

    Raises:
        ExportError: nothing is selected, none of the photos can be written, no such folder, or there is
            something at `job.out`.
    """
    if photos is None:
        raise ExportError("--format exif: expected --photos FOLDER with the photos to be copied, found none")
    if not photos.is_dir():
        raise ExportError(f"--photos {photos}: expected the folder of the photos, found none")
    found = files_by_sha256(photos)
    files: list[_File] = []
    attribution: list[Attribution] = []
    with whole_or_nothing(job.out) as part:
        part.mkdir()
        for feature_map in job.maps():
            folder = Path(folder_name(feature_map.map_id))
            names = image_names(feature_map)
            credits = attribution_of(feature_map)
            for shot, name, credit in zip(shots_of(feature_map), names, credits, strict=True):
                outcome = _copy(part, folder / _safe(name), shot, found.get(shot.image.sha256))
                files.append(outcome)
                if not outcome.reason:
                    attribution.append(credit)
        if not attribution:
            raise ExportError(
                f"--photos {photos}: none of the {len(files)} photos of the selected maps can be written; "
                f"the first: {files[0].image}: {files[0].reason}"
                if files
                else "the selected maps have no photos"
            )
        write_csv(part / FILES_TABLE, _File._fields, files)
        write_attribution(part, attribution)
        return replace(job.exported(part), images=len(attribution))


def files_by_sha256(folder: Path) -> dict[str, Path]:
    """All files below a folder by the hex digest of their bytes; of equal ones the first by name."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            found.setdefault(file_sha256(path), path)
    return found


def with_pose(data: bytes, shot: PosedPhoto) -> bytes:
    """The JPEG file with the photo's pose in its metadata.

    Raises:
        ImageError: not a readable JPEG. InvalidValueError: no room for the metadata, or a broken EXIF block.
    """
    header = read_header(data)
    if header.format != "JPEG":
        raise ImageError(f"a {header.format} file; only JPEG is written", "unsupported")
    tiff = data[slice(*header.exif)] if header.exif else b""
    xmp = data[slice(*header.xmp)] if header.xmp else b""
    return with_app1(data, with_gps(tiff, _gps(shot)), with_properties(xmp, properties(shot), _STALE))


def _gps(shot: PosedPhoto) -> dict[int, object]:
    """The position; heights above sea level where they are, or can be converted to, such."""
    altitude, datum = altitude_of(shot)
    east, north, _ = shot.sigma_enu_m
    return gps_directory(
        (shot.geopose.latitude_deg, shot.geopose.longitude_deg, altitude),
        "ellipsoid" if datum.startswith("ellipsoidal") else "sea_level",
        heading_deg=shot.geopose.heading_pitch_roll_deg[0],
        error_m=float(RADIUS_68 * ((east**2 + north**2) / 2.0) ** 0.5),
    )


def properties(shot: PosedPhoto) -> dict[str, str]:
    """XMP: angles as DJI's gimbals tell them, accuracies as Pix4D and OpenDroneMap read them, attribution."""
    heading, pitch, roll = shot.geopose.heading_pitch_roll_deg
    yaw = (heading + 180.0) % 360.0 - 180.0
    east, north, up = shot.sigma_enu_m
    told = {
        "drone-dji:GimbalYawDegree": f"{yaw:+.4f}",
        "drone-dji:GimbalPitchDegree": f"{pitch:+.4f}",
        "drone-dji:GimbalRollDegree": f"{roll:+.4f}",
        "Camera:GPSXYAccuracy": f"{((east**2 + north**2) / 2.0) ** 0.5:.4f}",
        "Camera:GPSZAccuracy": f"{up:.4f}",
        "featuredb:HeightDatum": altitude_of(shot)[1],
        "featuredb:MapId": shot.map_id,
        "featuredb:OriginalSha256": shot.image.sha256,
        "featuredb:Owner": shot.image.owner,
        "featuredb:Licence": shot.licence,
    }
    return {name: text for name, text in told.items() if text}


def _copy(part: Path, name: Path, shot: PosedPhoto, original: Path | None) -> _File:
    reason = ""
    if original is None:
        reason = "no file of these bytes in the folder"
    else:
        try:
            data = with_pose(original.read_bytes(), shot)
        except FeatureDbError as error:
            reason = str(error)
        else:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_bytes(data)
    file = "" if reason else name.as_posix()
    return _File(
        map_id=shot.map_id, image=shot.image.name, sha256=shot.image.sha256, file=file, reason=reason
    )


def _safe(name: str) -> Path:
    """The image's name as a path that stays below its folder."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", ".")]
    return Path(*(folder_name(part) for part in parts))
