"""Writes films of a simulated town: a drone's flight as mp4, its telemetry; and the true pose of every frame.

The film shows the town of a `WorldOptions`, so that maps of that world's photos, and its scan, are of the
place that the film shows. Cars drive, water glitters, the light changes; a frame is exposed while the camera
moves. Beside `film.mp4` stands `film.srt`, as DJI's drones write it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache, partial
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import SensorOptions, expose, moving_cars, scene_look
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.scene import Faces, Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, in_order, other_town_of, town_of
from featuredb.video.writer import VideoWriter, VideoWriterOptions
from tools.worlds.flight_path import FlightPath, PathOptions

FILM_FILE, TELEMETRY_FILE = "film.mp4", "film.srt"
GPS_SIGMA_M = 1.5  # of the telemetry: errors that wander
TELEMETRY_LATE_S = 0.3  # how much later than the picture the telemetry is
_START = datetime(2025, 6, 21, 12, 40, 3, tzinfo=UTC)
_GLITTER_HZ = 5.0  # how often the water looks new
_SHUTTER_S = 1 / 100
_SENSOR = SensorOptions(exposure_sigma_ev=0.0, white_balance_sigma=0.0)
_BANDS = 12  # of rows, where they are not exposed at once
_CHUNK = 4  # frames that travel to a process at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """How a frame is exposed.

    Attributes:
        samples: pictures of its time, in which what moves is blurred, that are averaged; each looks through
            other parts of the pixels.
        readout_s: rolling shutter, from the first row to the last; the frame's time is its middle row's.
        ev: stops brighter than the scene is.
    """

    samples: int = 4
    readout_s: float = 0.0
    ev: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmOptions:
    """What to write. The same options give the same frames.

    Attributes:
        world: whose town is filmed. path: how the camera flies; its duration is that of the frames.
        frames, rate_hz: of the film. width, height: pixels.
        exposure: of a frame, but for what follows.
        ev_range: stops between the darkest and the brightest exposure, which follow each other slowly, and
            leap once where the flight is jerky.
        focal: of the lens, in widths of the picture. zoom: what it becomes in the middle third of the film.
        cut: frames (first, last + 1) that show another town, or None.
    """

    world: WorldOptions = field(default_factory=WorldOptions)
    path: PathOptions = field(default_factory=PathOptions)
    frames: int = 1200
    rate_hz: float = 30.0
    width: int = 1280
    height: int = 720
    exposure: Exposure = field(default_factory=Exposure)
    ev_range: float = 0.7
    focal: float = 0.757
    zoom: float | None = None
    cut: tuple[int, int] | None = None

    @property
    def camera(self) -> Camera:
        """True intrinsics of the first frame."""
        return self.camera_at(0)

    def camera_at(self, frame: int) -> Camera:
        """True intrinsics: a drone's video mode, a little barrel distortion, the axis off the centre."""
        share = np.clip(3.0 * frame / self.frames - 1.0, 0.0, 1.0)
        eased = float(share * share * (3.0 - 2.0 * share))  # the lens zooms slowly at first and at last
        f = self.focal * ((self.zoom or self.focal) / self.focal) ** eased * self.width
        params = (f, 0.5006 * self.width, 0.4991 * self.height, -0.031, 0.012)
        return Camera(model="RADIAL", width=self.width, height=self.height, params=params)

    def time_s(self, frame: int) -> float:
        """Middle of a frame's exposure since the film's start."""
        return frame / self.rate_hz

    def at_home(self, frame: int) -> bool:
        """Whether the frame shows the town."""
        return self.cut is None or not self.cut[0] <= frame < self.cut[1]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FilmTruth:
    """What is true of a film's n frames.

    Attributes:
        camera: true intrinsics. frame, epsg: local frame of the poses, UTM zone of answers.
        times_s: (n,) seconds.
        cam_from_local: true poses; None where the frame does not show the town.
    """

    camera: Camera
    frame: LocalFrame
    epsg: int
    times_s: FloatArray
    cam_from_local: tuple[Rigid3 | None, ...]

    @property
    def at_home(self) -> NDArray[np.bool_]:
        """(n,) of frames that show the town; others show a place that no map knows."""
        return np.array([pose is not None for pose in self.cam_from_local])


def write_film(folder: Path, options: FilmOptions, workers: int = 0) -> Path:
    """Write film and telemetry into `folder`; a folder that holds just these is left as it is.

    Args:
        workers: processes; 0 takes one per core.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / TELEMETRY_FILE).write_text(_telemetry(options), encoding="utf-8")
    tags = {"creation_time": _START.isoformat()}
    write_frames(
        folder / FILM_FILE,
        partial(film_frame, options),
        options.frames,
        options.rate_hz,
        VideoWriterOptions(preset="veryfast", tags=tags),
        folder / f"{FILM_FILE}.stamp",
        repr(options),
        workers,
    )
    return folder


def film_truth(options: FilmOptions) -> FilmTruth:
    """The truth of a film."""
    scene, path, frames = _scene(options, True), _path(options, True), range(options.frames)
    return FilmTruth(
        camera=options.camera,
        frame=scene.frame,
        epsg=scene.epsg,
        times_s=np.array([options.time_s(i) for i in frames]),
        cam_from_local=tuple(path.pose(options.time_s(i)) if options.at_home(i) else None for i in frames),
    )


def film_frame(options: FilmOptions, frame: int) -> Image8:
    """One frame (h, w, 3) uint8 RGB as the camera's sensor gives it."""
    home, time_s, n = options.at_home(frame), options.time_s(frame), options.exposure.samples
    scene, path, camera = _scene(options, home), _path(options, home), options.camera_at(frame)
    look = scene_look(scene, water_seed=int(time_s * _GLITTER_HZ))
    faces = Faces.concatenate([scene.faces, moving_cars(scene, options.path.seed, time_s=time_s)])
    light: NDArray[np.float32] = np.zeros((camera.height, camera.width, 3), np.float32)
    for k in range(n):
        moment_s = time_s + _SHUTTER_S * ((k + 0.5) / n - 0.5)
        # Another part of each pixel: a rank-1 lattice over its square.
        shift = (float((k + 0.5) / n - 0.5), float((k * 0.618034 + 0.5 / n) % 1.0 - 0.5))
        for top, bottom, later_s in _bands(camera.height, options.exposure.readout_s):
            f, cx, cy, *rest = camera.params
            params = (f, cx - shift[0], cy - shift[1] - top, *rest)
            part = replace(camera, height=bottom - top, params=params)
            pose = path.pose(moment_s + later_s)
            rendered = render(faces, scene.ellipsoids, part, pose, look=look, supersample=1)
            assert rendered.rgb is not None
            light[top:bottom] += rendered.rgb
    light *= 2.0 ** _exposure_ev(options, time_s) / n
    rng = np.random.default_rng((options.path.seed, 72, frame))
    return expose(np.clip(light, 0, 255).astype(np.uint8), rng, _SENSOR)


def wandering_errors(rng: np.random.Generator, sigma_m: float, keep: float, count: int) -> FloatArray:
    """(count, 3) errors of a receiver, twice as large in height; each keeps a share of the one before."""
    axes = sigma_m * np.array([1.0, 1.0, 2.0])
    errors = [axes * rng.standard_normal(3)]
    for _ in range(count):
        errors.append(keep * errors[-1] + np.sqrt(1.0 - keep**2) * axes * rng.standard_normal(3))
    return np.array(errors[1:])


def _exposure_ev(options: FilmOptions, time_s: float) -> float:
    slow = 0.5 * options.ev_range * np.sin(2.0 * np.pi * time_s / 17.0)
    leaps = options.path.style == "jerky" and time_s > 0.6 * options.frames / options.rate_hz
    return float(options.exposure.ev + slow + (0.6 * options.ev_range if leaps else 0.0))


@lru_cache(maxsize=2)
def _scene(options: FilmOptions, home: bool) -> Scene:
    return (town_of if home else other_town_of)(options.world)


@lru_cache(maxsize=8)
def _path(options: FilmOptions, home: bool) -> FlightPath:
    path = replace(options.path, duration_s=options.frames / options.rate_hz)
    return FlightPath(_scene(options, home), path)


def _telemetry(options: FilmOptions) -> str:
    """Subtitles in DJI's bracketed dialect, a block a frame, late, with an error that wanders."""
    rng = np.random.default_rng((options.path.seed, 73))
    keep = float(np.exp(-1.0 / (options.rate_hz * 20.0)))  # forgets in twenty seconds
    blocks = []
    for i, error in enumerate(wandering_errors(rng, GPS_SIGMA_M, keep, options.frames)):
        time_s, home = options.time_s(i), options.at_home(i)
        frame = _scene(options, home).frame
        place = _path(options, home).pose(time_s - TELEMETRY_LATE_S).center + error
        latitude, longitude, height = (float(v) for v in frame.geodetic_from_enu(place))
        moment = _START + timedelta(seconds=time_s)
        blocks.append(
            f"{i + 1}\n{_clock(time_s)} --> {_clock(time_s + 1.0 / options.rate_hz)}\n"
            f'<font size="28">FrameCnt: {i + 1}, DiffTime: {1000 / options.rate_hz:.0f}ms\n'
            f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 1000:03d}\n"
            f"[latitude: {latitude:.6f}] [longitude: {longitude:.6f}] "
            f"[rel_alt: {height - frame.height_m:.3f} abs_alt: {height:.3f}] </font>\n\n"
        )
    return "".join(blocks)


def _clock(time_s: float) -> str:
    return f"{datetime.min + timedelta(milliseconds=round(1000 * time_s)):%H:%M:%S,%f}"[:-3]


def write_frames(
    file: Path,
    draw: Callable[[int], Image8],
    count: int,
    rate_hz: float,
    options: VideoWriterOptions,
    mark: Path,
    stamp: str,
    workers: int = 0,
) -> None:
    """A film of the pictures `draw(i)`; it is left as it is where the file `mark` has the stamp."""
    if mark.is_file() and mark.read_text(encoding="utf-8") == stamp:
        return
    mark.unlink(missing_ok=True)
    pictures = in_order(draw, count, workers, _CHUNK)
    first = next(pictures)
    height, width = first.shape[:2]
    with VideoWriter(file, width=width, height=height, fps=rate_hz, options=options) as writer:
        for picture in chain([first], pictures):
            writer.write(picture)
    mark.write_text(stamp, encoding="utf-8")


def _bands(height: int, readout_s: float) -> list[tuple[int, int, float]]:
    """Rows (first, last + 1) that are exposed together, and how much later than the frame's middle."""
    if readout_s == 0:
        return [(0, height, 0.0)]
    edges = np.linspace(0, height, _BANDS + 1).round().astype(int).tolist()
    return [
        (top, bottom, readout_s * (0.5 * (top + bottom) / height - 0.5)) for top, bottom in pairwise(edges)
    ]
