"""From a film to photos: keyframes of its shots, written below the work folder."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from pydantic import TypeAdapter, ValidationError

from featuredb.atomic import atomic_file, file_sha256
from featuredb.errors import VideoError
from featuredb.features.exif.angles import DJI_GIMBAL
from featuredb.features.exif.read import UNNAMED_MAKE, shot_model, unnamed_model
from featuredb.features.exif.write import gps_directory, with_properties
from featuredb.features.shrink import shrunk
from featuredb.video.film import VideoFrame, VideoInfo, VideoOptions
from featuredb.video.frames import open_video
from featuredb.video.telemetry.values import Telemetry
from ingest.executor import Progress, no_progress
from ingest.fingerprint import digest, options_fingerprint
from ingest.report.films import ShotOutcome
from ingest.video.burnt_in import BurntIn, find_burnt_in, painted_over
from ingest.video.clocks import check_overlap
from ingest.video.film_time import FilmTime
from ingest.video.keyframes import KeyframeChoice, KeyframeOptions, choose_keyframes, shots_of
from ingest.video.motion import FrameKind, Motion, measure_motion
from ingest.video.positions import GimbalAngles, Position, digest_of_telemetry, lateness, places_at
from ingest.workspace import read_json, write_json

_DONE = "film.json"
# Raised when a film gives other stills: with the constants of `motion`, `burnt_in`, `clocks`, `lag`, `match`.
_VERSION = "1"
_MOTION_SIDE_PX = 640  # frames are made so small to measure their motion

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
            exif, xmp = _properties(frame, opened.info, camera, told[0][k], told[1][k])
            _save(folder / keyframe_name(frame.index), frame.rgb(), exif, xmp)
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


def _properties(
    frame: VideoFrame,
    info: VideoInfo,
    camera: tuple[str, str],
    place: Position | None,
    angles: GimbalAngles | None,
) -> tuple[Image.Exif, bytes]:
    """EXIF and XMP of a keyframe, of a camera's make and model."""
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
    return exif, xmp


def _save(file: Path, rgb: NDArray[np.uint8], exif: Image.Exif, xmp: bytes) -> None:
    with atomic_file(file) as target:
        Image.fromarray(rgb).save(target, format="JPEG", quality=_QUALITY, subsampling=0, exif=exif, xmp=xmp)


def clean_keyframes(folder: Path, choice: KeyframeChoice, side_px: int) -> dict[int, BurntIn]:
    """Paint over what is burnt into keyframes, so that no feature comes of it.

    Args:
        side_px: of the pictures that are looked at, and whose pixels the answer has.

    Returns:
        What was found, by shot.
    """
    files = [folder / keyframe_name(index) for index in choice.index]
    pictures = []
    for file in files:
        with Image.open(file) as picture:
            pictures.append(shrunk(np.asarray(picture.convert("L")), side_px))
    found = find_burnt_in(pictures, choice.shot)
    for file, shot in zip(files, choice.shot, strict=True):
        if found[shot].mask.any():
            _paint_over(file, found[shot].mask)
    return found


def _paint_over(file: Path, mask: NDArray[np.bool_]) -> None:
    with Image.open(file) as picture:
        rgb, exif, xmp = np.asarray(picture.convert("RGB")), picture.getexif(), picture.info.get("xmp", b"")
    size = (rgb.shape[1], rgb.shape[0])
    large = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    _save(file, painted_over(rgb, large), exif, xmp)


@dataclass(frozen=True, slots=True, kw_only=True)
class StillsOptions:
    """From a film to photos.

    Attributes:
        telemetry_late_s: telemetry that is shown at t belongs to t minus this; None: estimated (`lag.py`),
            and 0 where that says nothing.
        film_start_s: where the film begins in telemetry that has a clock of its own (`film_time.film_start`);
            None: found (`clocks.py`).
        positions: telemetry that cannot be laid on the film is refused; False: it is only told, as the map is
            placed by other means.
    """

    start_s: float | None = None
    end_s: float | None = None
    telemetry_late_s: float | None = None
    film_start_s: float | None = None
    positions: bool = True
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stills:
    """What was made of a film.

    Attributes:
        shots: with the file names of their keyframes; a film of titles alone has none of them.
        positions: photos with a position. heights: what their heights count from, for people.
        late_s: the telemetry's time that belongs to the film's time 0: how late it is, or where in the log
            the film begins; None where that is not known, and no photo has a position.
    """

    folder: Path
    shots: tuple[ShotOutcome, ...]
    positions: int
    heights: str
    late_s: float | None
    notes: tuple[str, ...]


_STILLS = TypeAdapter(Stills)


def make_stills(
    film: Path,
    telemetry: Telemetry | None,
    root: Path,
    options: StillsOptions | None = None,
    progress: Progress = no_progress,
) -> Stills:
    """Choose keyframes and write them below `root`; what is there already is not made again.

    Raises:
        VideoError: the film cannot be read, or shows no place.
        TelemetryError: the telemetry has a clock of its own, and where the film lies on it is not clear.
    """
    options = options or StillsOptions()
    try:
        content = file_sha256(film)
    except OSError as error:
        raise VideoError(f"{film}: expected a film, {error.strerror or error}") from error
    key = digest(_VERSION, content, options_fingerprint(options), digest_of_telemetry(telemetry))
    folder = root / "stills" / key[:16]
    known = _known(folder)
    if known is not None:
        return known
    with open_video(film, _video_options(options, _MOTION_SIDE_PX)) as video:
        when = FilmTime(
            name=video.info.name,
            duration_s=video.info.duration_s or 0.0,
            created=video.info.creation_time,
            told_s=options.film_start_s,
        )
        if telemetry is not None and options.positions and not telemetry.in_video_time:
            check_overlap(when, telemetry)
        progress("motion", 0, video.info.frame_count or 0)
        motion = measure_motion(video)
        if not len(motion):
            raise video.info.no_frames()
        notes = list(video.report.complaints())
    choice = choose_keyframes(motion, options.keyframes)
    if not choice.index:
        said = _dropped(_shots(motion, choice, {}))
        raise VideoError(f"{film.name}: {len(motion)} frames, and none shows a place: {said}")
    late_s: float | None = 0.0
    if telemetry is not None:
        notes += telemetry.warnings
        late_s, found = lateness(motion, telemetry, when, options.telemetry_late_s, needed=options.positions)
        notes += found
    places, angles, heights = places_at(telemetry, choice, late_s)
    stretch, unnamed = _video_options(options, None), unnamed_model(content)
    write_keyframes(film, folder, choice, (places, angles), progress, video=stretch, unnamed=unnamed)
    shots = _shots(motion, choice, clean_keyframes(folder, choice, _MOTION_SIDE_PX))
    made = Stills(
        folder=folder,
        shots=shots,
        positions=sum(place is not None for place in places),
        heights=heights,
        late_s=late_s,
        notes=tuple(notes),
    )
    write_json(folder / _DONE, _STILLS.dump_python(made, mode="json", exclude={"folder"}))
    return made


def _known(folder: Path) -> Stills | None:
    """What an earlier run made, if all of it is there."""
    done = folder / _DONE
    if not done.is_file():
        return None
    try:
        known = _STILLS.validate_python(read_json(done) | {"folder": folder})
    except ValidationError:  # of another version, or damaged: they are made again
        return None
    names = [name for shot in known.shots for name in shot.keyframes]
    return known if all((folder / name).is_file() for name in names) else None


def _shots(
    motion: Motion, choice: KeyframeChoice, burnt_in: Mapping[int, BurntIn]
) -> tuple[ShotOutcome, ...]:
    """Every shot, with the names of its keyframes, what its other frames are, and what is burnt into it."""
    chosen = set(choice.index)
    # A frame that neither the one before nor the one after hangs on.
    alone = motion.broken & np.append(motion.broken[1:], True)
    shots = []
    for number, rows in enumerate(shots_of(motion)):
        other: Counter[str] = Counter()
        for row in rows.tolist():
            if int(motion.index[row]) not in chosen:
                kind = FrameKind(motion.kind[row])
                looked = "break" if alone[row] else "between"
                other[looked if kind == FrameKind.PICTURE else kind.name.lower()] += 1
        mine = zip(choice.index, choice.shot, strict=True)
        names = [keyframe_name(index) for index, shot in mine if shot == number]
        found = burnt_in.get(number)
        shots.append(
            ShotOutcome(
                start_s=round(float(motion.time_s[rows[0]]), 3),
                end_s=round(float(motion.time_s[rows[-1]]), 3),
                frames=len(rows),
                keyframes=tuple(names),
                step=round(choice.step[number], 4),
                dropped=dict(other),
                bars=(0.0, 0.0, 0.0, 0.0) if found is None else found.bar_shares,
                overlay_share=0.0 if found is None else round(found.overlay_share, 4),
            )
        )
    return tuple(shots)


def _dropped(shots: tuple[ShotOutcome, ...]) -> str:
    total: Counter[str] = Counter()
    for shot in shots:
        total.update(shot.dropped)
    return ", ".join(f"{count} {code}" for code, count in total.most_common()) or "there are none"


def _video_options(options: StillsOptions, side_px: int | None) -> VideoOptions:
    return VideoOptions(max_side_px=side_px, start_s=options.start_s, end_s=options.end_s)
