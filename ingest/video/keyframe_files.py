"""Keyframes as JPEG files, with what film and telemetry know in their EXIF."""

import io
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from featuredb.errors import VideoError
from featuredb.features.exif.angles import DJI_GIMBAL
from featuredb.features.exif.write import gps_directory, with_properties
from featuredb.features.film_lens import UNNAMED_MAKE, shot_model
from featuredb.features.shrink import shrunk
from featuredb.video.film import VideoFrame, VideoInfo, VideoOptions
from featuredb.video.frames import open_video
from ingest.executor import Progress
from ingest.video.burnt_in import BurntIn, find_burnt_in, painted_over
from ingest.video.keyframes import KeyframeChoice
from ingest.video.positions import GimbalAngles, Position
from ingest.workspace import atomic_file

_QUALITY = 95  # of JPEG; films are compressed already, and what it adds should not be seen


def write_keyframes(
    film: Path,
    folder: Path,
    choice: KeyframeChoice,
    told: tuple[Sequence[Position | None], Sequence[GimbalAngles | None]],
    progress: Progress,
    *,
    video: VideoOptions,
    unnamed: str,
) -> None:
    """Write the chosen frames as `folder`/NNNNNN.jpg, each named by its number in the film.

    Args:
        told: position and gimbal angles of each.
        video: how the film is read: the same stretch as when keyframes were chosen.
        unnamed: the camera's model where the film does not say; no two films have the same.

    Raises:
        VideoError: the film does not give the same frames again.
    """
    wanted = {index: k for k, index in enumerate(choice.index)}
    left = len(wanted)
    with open_video(film, video) as opened:
        for frame in opened:
            k = wanted.get(frame.index)
            if k is None:
                continue
            camera = _camera(opened.info, unnamed, choice.shot[k])
            with atomic_file(folder / keyframe_name(frame.index)) as file:
                file.write_bytes(_jpeg(frame, opened.info, camera, told[0][k], told[1][k]))
            left -= 1
            progress("keyframes", len(wanted) - left, len(wanted))
            if not left:
                return
    raise VideoError(f"{film.name}: not all keyframes could be read again; was the film changed meanwhile?")


def keyframe_name(index: int) -> str:
    """The file of a frame."""
    return f"{index:06d}.jpg"


def _camera(info: VideoInfo, unnamed: str, shot: int) -> tuple[str, str]:
    """Make and model. All keyframes of a shot name one, and so share their lens.

    Films that do not say theirs name themselves, so that no other film takes that lens for its own. Shots
    after the first have a lens of their own: who cuts a film may have had several cameras.
    """
    return info.make or UNNAMED_MAKE, shot_model(info.model or unnamed, shot)


def _jpeg(
    frame: VideoFrame,
    info: VideoInfo,
    camera: tuple[str, str],
    place: Position | None,
    angles: GimbalAngles | None,
) -> bytes:
    """One keyframe, of a camera's make and model."""
    exif = Image.Exif()
    base = ExifTags.Base
    exif[base.Make.value], exif[base.Model.value] = camera
    exif[base.Software.value] = "featuredb"
    if info.creation_time is not None:
        when = info.creation_time + timedelta(seconds=frame.time_s)
        offset = when.strftime("%z") or "+0000"
        details = exif.get_ifd(ExifTags.IFD.Exif)
        details[base.DateTimeOriginal.value] = when.strftime("%Y:%m:%d %H:%M:%S")
        details[base.OffsetTimeOriginal.value] = f"{offset[:3]}:{offset[3:5]}"
        details[base.SubsecTimeOriginal.value] = f"{when.microsecond // 1000:03d}"
    if place is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps_directory(place))
    xmp = b""
    if angles is not None:
        words = {f"drone-dji:{name}": f"{angle:+.2f}" for name, angle in zip(DJI_GIMBAL, angles, strict=True)}
        xmp = with_properties(b"", words)
    out = io.BytesIO()
    Image.fromarray(frame.rgb()).save(out, format="JPEG", quality=_QUALITY, subsampling=0, exif=exif, xmp=xmp)
    return out.getvalue()


def clean_keyframes(folder: Path, choice: KeyframeChoice, side_px: int) -> dict[int, BurntIn]:
    """Paint over what is burnt into keyframes, so that no feature comes of it.

    Args:
        side_px: of the pictures that are looked at, and whose pixels the answer has.

    Returns:
        What was found, by shot.
    """
    files = [folder / keyframe_name(index) for index in choice.index]
    pictures = [_shrunk(file, side_px) for file in files]
    found = find_burnt_in(pictures, choice.shot)
    for file, shot in zip(files, choice.shot, strict=True):
        if found[shot].mask.any():
            _paint_over(file, found[shot].mask)
    return found


def _paint_over(file: Path, mask: NDArray[np.bool_]) -> None:
    """Paint over a keyframe's mask."""
    with Image.open(file) as picture:
        rgb, exif, xmp = np.asarray(picture.convert("RGB")), picture.getexif(), picture.info.get("xmp", b"")
    size = (rgb.shape[1], rgb.shape[0])
    large = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    with atomic_file(file) as target:
        Image.fromarray(painted_over(rgb, large)).save(
            target, format="JPEG", quality=_QUALITY, subsampling=0, exif=exif, xmp=xmp
        )


def _shrunk(file: Path, side_px: int) -> NDArray[np.uint8]:
    with Image.open(file) as picture:
        gray = np.asarray(picture.convert("L"))
    return shrunk(gray, side_px)
