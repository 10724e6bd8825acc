"""Keyframes of a film as photos: JPEG files with what film and telemetry know in their EXIF."""

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from featuredb.errors import TelemetryError, VideoError
from featuredb.features.exif_write import gps_directory
from featuredb.file_digest import file_sha256
from featuredb.geometry.arrays import FloatArray
from featuredb.video.film import VideoFrame, VideoInfo, VideoOptions
from featuredb.video.frames import open_video
from featuredb.video.telemetry.values import Telemetry
from ingest.executor import Progress, no_progress
from ingest.fingerprint import digest, options_fingerprint
from ingest.video.clocks import ClockOptions, check_overlap, lay_on_film
from ingest.video.film_time import FilmTime
from ingest.video.keyframes import KeyframeChoice, KeyframeOptions, choose_keyframes
from ingest.video.lag import LagOptions, estimate_lag
from ingest.video.motion import Motion, MotionOptions, measure_motion
from ingest.workspace import atomic_file, write_json

_DONE = "film.json"
RELATIVE_HEIGHTS = "above the place of take-off"


@dataclass(frozen=True, slots=True, kw_only=True)
class StillsOptions:
    """From a film to photos.

    Attributes:
        motion_side_px: frames are made so small to measure their motion.
        max_side_px: of the photos; None: as the film is.
        quality: of JPEG; films are compressed already, and what it adds should not be seen.
        start_s, end_s: the stretch of the film; None: all of it.
        telemetry_late_s: telemetry that is shown at t belongs to t minus this; None: estimated (`lag.py`),
            and 0 where that says nothing.
        film_start_s: where the film begins in telemetry that has a clock of its own (`film_time.film_start`);
            None: found (`clocks.py`).
        positions: telemetry that cannot be laid on the film is refused; False: it is only told, as the map is
            placed by other means.
    """

    motion_side_px: int = 640
    max_side_px: int | None = None
    quality: int = 95
    start_s: float | None = None
    end_s: float | None = None
    telemetry_late_s: float | None = None
    film_start_s: float | None = None
    positions: bool = True
    lag: LagOptions = field(default_factory=LagOptions)
    clock: ClockOptions = field(default_factory=ClockOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stills:
    """What was made of a film.

    Attributes:
        folder: of the photos. photos: number of them. frames: of the film that were looked at.
        breaks: where nothing connects a frame with the one before.
        step: between keyframes, a share of the picture's longer side.
        positions: photos with a position. heights: what their heights count from, for people.
        late_s: the telemetry's time that belongs to the film's time 0: how late it is, or where in the log
            the film begins; None where that is not known, and no photo has a position.
        notes: what was found of the film and its telemetry, and what was wrong with them.
    """

    folder: Path
    photos: int
    frames: int
    breaks: int
    step: float
    positions: int
    heights: str
    late_s: float | None
    notes: tuple[str, ...]


def make_stills(
    film: Path,
    telemetry: Telemetry | None,
    root: Path,
    options: StillsOptions | None = None,
    progress: Progress = no_progress,
) -> Stills:
    """Choose keyframes and write them below `root`; what is there already is not made again.

    Raises:
        VideoError: the film cannot be read, or shows too little motion for two keyframes.
        TelemetryError: the telemetry has a clock of its own, and where the film lies on it is not clear.
    """
    options = options or StillsOptions()
    content = _digest_of(film)
    name = digest(content, film.stem, options_fingerprint(options), _digest_of_telemetry(telemetry))[:16]
    folder = root / "films" / name / film.stem
    done = folder.parent / _DONE
    if done.is_file():
        known = json.loads(done.read_text(encoding="utf-8"))
        if len(list(folder.glob("*.jpg"))) == known["photos"]:
            return Stills(**{**known, "folder": folder, "notes": tuple(known["notes"])})
    small = _video_options(options, options.motion_side_px)
    with open_video(film, small) as video:
        when = _film_time(video.info, options)
        if telemetry is not None and options.positions and not telemetry.in_video_time:
            check_overlap(when, telemetry, options.clock)
        progress("motion", 0, video.info.frame_count or 0)
        motion = measure_motion(video, options.motion)
        notes = list(video.report.complaints())
    choice = choose_keyframes(motion, options.keyframes)
    if len(choice.index) < 2:
        raise VideoError(
            f"{film.name}: {len(choice.index)} keyframes in {len(motion)} frames, two are needed: the "
            "picture hardly moves, or no two frames belong together"
        )
    late_s: float | None = 0.0
    if telemetry is not None:
        notes += telemetry.warnings
        late_s, said = _lateness(motion, telemetry, when, options)
        notes += said
    places, heights = _places(telemetry, choice, late_s)
    _write(film, folder, choice, places, content, options, progress)
    found = Stills(
        folder=folder,
        photos=len(choice.index),
        frames=len(motion),
        breaks=int(motion.broken[1:].sum()),
        step=round(choice.step, 4),
        positions=sum(place is not None for place in places),
        heights=heights,
        late_s=late_s,
        notes=tuple(notes),
    )
    write_json(done, {name: getattr(found, name) for name in Stills.__slots__ if name != "folder"})
    return found


def _film_time(info: VideoInfo, options: StillsOptions) -> FilmTime:
    return FilmTime(
        name=info.name,
        duration_s=info.duration_s or 0.0,
        created=info.creation_time,
        told_s=options.film_start_s,
    )


def _lateness(
    motion: Motion, telemetry: Telemetry, film: FilmTime, options: StillsOptions
) -> tuple[float | None, tuple[str, ...]]:
    """`Stills.late_s`, and what there is to say of it.

    Raises:
        TelemetryError: positions are wanted, and the film cannot be laid on the telemetry's clock.
    """
    told = options.telemetry_late_s
    if telemetry.in_video_time:
        if told is not None:
            return told, ()
        lag = estimate_lag(motion, telemetry, options.lag)
        return lag.late_s or 0.0, (lag.message,)
    if told is not None and film.told_s is not None:
        return film.told_s + told, ()
    laid = lay_on_film(motion, telemetry, film, options.clock)
    if laid.late_s is None and options.positions:
        raise TelemetryError(laid.message)
    return laid.late_s, (laid.message,)


def _digest_of(film: Path) -> str:
    try:
        return file_sha256(film)
    except OSError as error:
        raise VideoError(
            f"{film}: expected a film, {error.strerror or error}; folders of pictures go to "
            "`featuredb ingest photos`"
        ) from error


def _digest_of_telemetry(telemetry: Telemetry | None) -> str:
    """Of all that positions are made of."""
    if telemetry is None:
        return "none"
    columns = (
        telemetry.times_s,
        telemetry.latitude_deg,
        telemetry.longitude_deg,
        telemetry.height_m,
        telemetry.relative_height_m,
        telemetry.clock_s,
    )
    parts = [hashlib.sha256(np.ascontiguousarray(column).tobytes()).hexdigest() for column in columns]
    return digest(*parts, telemetry.height_datum, str(telemetry.in_video_time), telemetry.clock)


def _video_options(options: StillsOptions, side_px: int | None) -> VideoOptions:
    return VideoOptions(max_side_px=side_px, start_s=options.start_s, end_s=options.end_s)


def _places(
    telemetry: Telemetry | None, choice: KeyframeChoice, late_s: float | None
) -> tuple[list[tuple[float, float, float] | None], str]:
    """Position of each keyframe, latitude, longitude, height; and what the heights are."""
    if telemetry is None:
        return [None] * len(choice.index), ""
    if late_s is None:
        return [None] * len(choice.index), "not known: where in the log the film begins is not clear"
    at = telemetry.at(np.array(choice.time_s) + late_s)
    height: FloatArray = at.height_m
    heights: str = telemetry.height_datum
    if not np.isfinite(height).any():
        height, heights = at.relative_height_m, RELATIVE_HEIGHTS
    known = at.has_position & np.isfinite(height)
    if not at.has_position.any():
        return [None] * len(choice.index), "not known: the telemetry has no positions at the keyframes' times"
    if not known.any():
        return [None] * len(choice.index), "not known: positions without heights are not used"
    return [
        (float(at.latitude_deg[k]), float(at.longitude_deg[k]), float(height[k])) if known[k] else None
        for k in range(len(choice.index))
    ], heights


def _write(
    film: Path,
    folder: Path,
    choice: KeyframeChoice,
    places: Sequence[tuple[float, float, float] | None],
    content: str,
    options: StillsOptions,
    progress: Progress,
) -> None:
    wanted = {index: k for k, index in enumerate(choice.index)}
    with open_video(film, _video_options(options, options.max_side_px)) as video:
        for frame in video:
            k = wanted.get(frame.index)
            if k is None:
                continue
            with atomic_file(folder / f"{frame.index:06d}.jpg") as file:
                camera = (video.info.make or "film", video.info.model or content[:16])
                file.write_bytes(_jpeg(frame, video.info, camera, places[k], options.quality))
            progress("keyframes", k + 1, len(wanted))
            if k + 1 == len(wanted):
                return
    raise VideoError(f"{film.name}: not all keyframes could be read again; was the film changed meanwhile?")


def _jpeg(
    frame: VideoFrame,
    info: VideoInfo,
    camera: tuple[str, str],
    place: tuple[float, float, float] | None,
    quality: int,
) -> bytes:
    """One keyframe.

    Args:
        camera: make and model. All keyframes of a film name one, and so share their lens; films that do not
            say theirs name themselves, so that no other film takes that lens for its own.
    """
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
    out = io.BytesIO()
    Image.fromarray(frame.rgb()).save(out, format="JPEG", quality=quality, subsampling=0, exif=exif)
    return out.getvalue()
