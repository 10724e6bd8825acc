"""Writes films of a simulated town: a drone's flight as mp4, its telemetry, and the true pose of every frame.

The film shows the town of a `WorldOptions`, so that maps of that world's photos, and its scan, are of the
place that the film shows. Cars drive, water glitters, the light changes; a frame is exposed while the camera
moves. Beside `film.mp4` stand `film.srt`, as DJI's drones write it, and `film.json`, the truth.
"""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.town.scene import Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, other_town_of, town_of
from featuredb.video.writer import VideoWriter, VideoWriterOptions
from tools.worlds.film_frame import Exposure, draw_frame, in_order
from tools.worlds.flight_path import FlightPath, PathOptions

Progress = Callable[[int, int], None]

FILM_FILE, TRUTH_FILE, TELEMETRY_FILE = "film.mp4", "film.json", "film.srt"
_FORMAT = 1  # raised when the same options give other files
_START = datetime(2025, 6, 21, 12, 40, 3, tzinfo=UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmOptions:
    """What to write. The same options give the same frames.

    Attributes:
        world: whose town is filmed. path: how the camera flies; its duration is that of the frames.
        frames, rate_hz: of the film. width, height: pixels.
        exposure: of a frame; what it says of stops is not used.
        ev_range: stops between the darkest and the brightest exposure, which follow each other slowly, and
            leap once where the flight is jerky.
        cut: frames (first, last + 1) that show another town, or None.
        gps_sigma_m: of the telemetry: errors that wander.
        telemetry_late_s: how much later than the picture the telemetry is.
    """

    world: WorldOptions = field(default_factory=WorldOptions)
    path: PathOptions = field(default_factory=PathOptions)
    frames: int = 1200
    rate_hz: float = 30.0
    width: int = 1280
    height: int = 720
    exposure: Exposure = field(default_factory=Exposure)
    ev_range: float = 0.7
    cut: tuple[int, int] | None = None
    gps_sigma_m: float = 1.5
    telemetry_late_s: float = 0.3

    def __post_init__(self) -> None:
        if not (self.frames > 0 and self.rate_hz > 0 and self.exposure.readout_s <= 1 / self.rate_hz):
            raise InvalidValueError(f"FilmOptions: value out of range in {self}")
        if self.cut is not None and not 0 <= self.cut[0] < self.cut[1] <= self.frames:
            raise InvalidValueError(
                f"FilmOptions.cut: expected frames within 0 to {self.frames}, found {self.cut}"
            )

    @property
    def camera(self) -> Camera:
        """True intrinsics: a drone's video mode, a little barrel distortion, the axis off the centre."""
        f = 0.757 * self.width
        params = (f, 0.5006 * self.width, 0.4991 * self.height, -0.031, 0.012)
        return Camera(model="RADIAL", width=self.width, height=self.height, params=params)

    def time_s(self, frame: int) -> float:
        """Middle of a frame's exposure since the film's start."""
        return frame / self.rate_hz

    def at_home(self, frame: int) -> bool:
        """Whether the frame shows the town."""
        return self.cut is None or not self.cut[0] <= frame < self.cut[1]

    def fingerprint(self) -> str:
        """Digest of what the files depend on."""
        options = asdict(self)
        options["world"].pop("workers")
        options |= options.pop("exposure")
        options.pop("ev")
        if options["readout_s"] == 0:
            options.pop("readout_s")  # films that were written before there was one
        return hashlib.sha256(json.dumps([_FORMAT, options], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilmTruth:
    """What is true of a film's n frames.

    Attributes:
        camera: true intrinsics. frame, epsg: local frame of the poses, UTM zone of answers.
        times_s: (n,) seconds. at_home: (n,) bool; other frames show a place that no map knows.
        cam_from_local: true poses; None where the frame does not show the town.
    """

    camera: Camera
    frame: LocalFrame
    epsg: int
    times_s: FloatArray
    at_home: NDArray[np.bool_]
    cam_from_local: tuple[Rigid3 | None, ...]


def write_film(
    folder: Path, options: FilmOptions, workers: int = 0, progress: Progress | None = None
) -> Path:
    """Write film, telemetry and truth into `folder`; a folder that holds just these is left as it is.

    Args:
        workers: processes; 0 takes one per core.
        progress: called with (frames done, frames in all).

    Raises:
        OSError: the folder cannot be written.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    truth_file = folder / TRUTH_FILE
    if truth_file.is_file() and _read(truth_file).get("fingerprint") == options.fingerprint():
        return folder
    # The truth comes last: a folder with it is complete.
    truth_file.unlink(missing_ok=True)
    tags = {"creation_time": _START.isoformat()}
    with VideoWriter(
        folder / FILM_FILE,
        width=options.width,
        height=options.height,
        fps=options.rate_hz,
        options=VideoWriterOptions(preset="veryfast", tags=tags),
    ) as writer:
        for done, picture in enumerate(
            in_order(partial(film_frame, options), options.frames, workers), start=1
        ):
            writer.write(picture)
            if progress is not None:
                progress(done, options.frames)
    (folder / TELEMETRY_FILE).write_text(_telemetry(options), encoding="utf-8")
    truth_file.write_text(json.dumps(_truth_json(options)) + "\n", encoding="utf-8")
    return folder


def read_film_truth(folder: Path) -> FilmTruth:
    """The truth of a film that was written before.

    Raises:
        InvalidValueError: there is none.
    """
    path = Path(folder) / TRUTH_FILE
    try:
        document = _read(path)
        poses = [
            None if p is None else Rigid3.from_quaternion(p["quaternion_xyzw"], p["translation_m"])
            for p in document["cam_from_local"]
        ]
        camera = document["camera"] | {"params": tuple(document["camera"]["params"])}
        return FilmTruth(
            camera=Camera(**camera),
            frame=LocalFrame(**document["frame"]),
            epsg=document["epsg"],
            times_s=np.array(document["times_s"], dtype=np.float64),
            at_home=np.array([p is not None for p in poses]),
            cam_from_local=tuple(poses),
        )
    except (OSError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise InvalidValueError(f"{path}: expected the truth of a simulated film, found {error!r}") from error


def film_frame(options: FilmOptions, frame: int) -> Image8:
    """One frame (h, w, 3) uint8 RGB as the camera's sensor gives it."""
    home, time_s = options.at_home(frame), options.time_s(frame)
    exposure = replace(options.exposure, ev=_exposure_ev(options, time_s))
    pose_at = _path(options, home).pose
    seeds = (options.path.seed, frame)
    return draw_frame(_scene(options, home), options.camera, pose_at, time_s, exposure, seeds)


def _exposure_ev(options: FilmOptions, time_s: float) -> float:
    slow = 0.5 * options.ev_range * np.sin(2.0 * np.pi * time_s / 17.0)
    leaps = options.path.style == "jerky" and time_s > 0.6 * options.frames / options.rate_hz
    return float(slow + (0.6 * options.ev_range if leaps else 0.0))


@lru_cache(maxsize=2)
def _scene(options: FilmOptions, home: bool) -> Scene:
    if home:
        return town_of(options.world)
    return other_town_of(options.world)


@lru_cache(maxsize=2)
def _path(options: FilmOptions, home: bool) -> FlightPath:
    path = replace(options.path, duration_s=options.frames / options.rate_hz)
    return FlightPath(_scene(options, home), path)


def _truth_json(options: FilmOptions) -> dict[str, Any]:
    scene, path = _scene(options, True), _path(options, True)
    camera = options.camera
    poses = [path.pose(options.time_s(i)) if options.at_home(i) else None for i in range(options.frames)]
    return {
        "fingerprint": options.fingerprint(),
        "epsg": scene.epsg,
        "frame": asdict(scene.frame),
        "camera": {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "params": list(camera.params),
        },
        "times_s": [options.time_s(i) for i in range(options.frames)],
        "cam_from_local": [
            None
            if pose is None
            else {
                "quaternion_xyzw": pose.quaternion_xyzw.tolist(),
                "translation_m": pose.translation.tolist(),
            }
            for pose in poses
        ],
    }


def _telemetry(options: FilmOptions) -> str:
    """Subtitles in DJI's bracketed dialect, a block a frame, late, with an error that wanders."""
    rng = np.random.default_rng((options.path.seed, 73))
    keep = np.exp(-1.0 / (options.rate_hz * 20.0))  # forgets in twenty seconds
    error = options.gps_sigma_m * rng.standard_normal(3) * (1.0, 1.0, 2.0)
    blocks = []
    for i in range(options.frames):
        time_s = options.time_s(i)
        home = options.at_home(i)
        scene = _scene(options, home)
        error = keep * error + options.gps_sigma_m * np.sqrt(1.0 - keep**2) * rng.standard_normal(3) * (
            1.0,
            1.0,
            2.0,
        )
        place = _path(options, home).pose(time_s - options.telemetry_late_s).center + error
        latitude, longitude, height = scene.frame.geodetic_from_enu(place)
        ground = scene.frame.height_m
        start, end = _clock(time_s), _clock(time_s + 1.0 / options.rate_hz)
        moment = _START + timedelta(seconds=time_s)
        blocks.append(
            f"{i + 1}\n{start} --> {end}\n"
            f'<font size="28">FrameCnt: {i + 1}, DiffTime: {1000 / options.rate_hz:.0f}ms\n'
            f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 1000:03d}\n"
            f"[latitude: {float(latitude):.6f}] [longitude: {float(longitude):.6f}] "
            f"[rel_alt: {float(height) - ground:.3f} abs_alt: {float(height):.3f}] </font>\n\n"
        )
    return "".join(blocks)


def _clock(time_s: float) -> str:
    milli = round(1000 * time_s)
    hours, rest = divmod(milli, 3_600_000)
    minutes, rest = divmod(rest, 60_000)
    seconds, milli = divmod(rest, 1000)
    return f"{hours:02d}:{minutes:02d}:{seconds:02d},{milli:03d}"


def _read(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text(encoding="utf-8")))
