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
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import SensorOptions, expose, look_pose, moving_cars, scene_look
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.scene import Faces, Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import WorldOptions, in_order, other_town_of, town_of
from featuredb.video.writer import VideoWriter, VideoWriterOptions

FlightStyle = Literal["smooth", "jerky"]

_LEG_S = (3.0, 5.0)  # between waypoints
_CLEAR_M = 22.0  # over the ground; roofs and trees end below
# Gusts: waves of these frequencies (Hz), and how much they turn (degrees) and shift (metres) the camera.
_GUST_HZ, _GUST_DEG, _GUST_M = (0.7, 3.1), 1.1, 0.10
_SNAP_DEG, _SNAP_S = (50.0, 95.0), 0.8
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
class PathOptions:
    """How a camera flies.

    Attributes:
        seed: of the way. style: smooth; or jerky: gusts, and turns on the spot of up to 95 degrees in 0.8 s.
        half_extent_m: it stays within (+-x, +-y) of the town's middle, town axes.
        heights_m: over the town's origin. speed_m_s: over ground. down_deg: of its view, below the horizon.
        river: whether the way leads over the water and looks down on it.
    """

    seed: int = 1
    style: FlightStyle = "smooth"
    duration_s: float = 40.0
    half_extent_m: tuple[float, float] = (70.0, 55.0)
    heights_m: tuple[float, float] = (42.0, 60.0)
    speed_m_s: float = 8.0
    down_deg: tuple[float, float] = (40.0, 70.0)
    river: bool = True

    def __post_init__(self) -> None:
        if not _CLEAR_M <= self.heights_m[0] <= self.heights_m[1]:
            raise InvalidValueError(
                f"PathOptions.heights_m: expected {_CLEAR_M} m or more, found {self.heights_m}"
            )


class FlightPath:
    """A camera's way; poses at any time from 0 to `duration_s`, in a scene's local frame."""

    def __init__(self, scene: Scene, options: PathOptions) -> None:
        rng = np.random.default_rng((options.seed, 71))
        self._turn = scene.enu_from_town
        times, places = _waypoints(scene, options, rng)
        self._place = CubicSpline(times, places)
        down = rng.uniform(*options.down_deg, len(times))
        if options.river:
            over = np.abs(places[:, 1] - np.mean(scene.plan.river)) < 15.0
            down[over] = options.down_deg[1] + 10.0
        self._pitch = PchipInterpolator(times, -down)
        # From each place's last neighbour to its next: along its way it would spin where that turns back.
        away = np.gradient(places[:, :2], axis=0)
        self._heading = PchipInterpolator(times, np.degrees(np.unwrap(np.arctan2(away[:, 0], away[:, 1]))))
        self._gusts = _Gusts(rng) if options.style == "jerky" else None
        self._snaps = _snaps(options, rng) if options.style == "jerky" else []

    def pose(self, time_s: float) -> Rigid3:
        """cam_from_local at a time, seconds."""
        place = np.asarray(self._place(time_s), dtype=np.float64)
        heading, pitch, roll = float(self._heading(time_s)), float(self._pitch(time_s)), 0.0
        for start_s, angle in self._snaps:
            s = np.clip((time_s - start_s) / _SNAP_S, 0.0, 1.0)
            heading += angle * s * s * (3.0 - 2.0 * s)
        if self._gusts is not None:
            shift, turn = self._gusts.at(time_s)
            place, heading, pitch, roll = place + shift, heading + turn[0], pitch + turn[1], turn[2]
        # Headings are those of the town's axes, turned against north with them.
        town = look_pose(place, float(heading), pitch, float(roll))
        return Rigid3.from_center(town.rotation @ self._turn.T, self._turn @ place)


class _Gusts:
    """Sums of sines: a shift (3,) in metres and a turn (3,) in degrees (heading, pitch, roll) at any time."""

    def __init__(self, rng: np.random.Generator, waves: int = 7) -> None:
        self._hz = rng.uniform(*_GUST_HZ, (waves, 6))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (waves, 6))
        # Slow gusts are the strong ones.
        strength = rng.normal(0.0, 1.0, (waves, 6)) / self._hz
        self._strength = strength / np.sqrt((0.5 * strength**2).sum(axis=0))

    def at(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        value = (self._strength * np.sin(2.0 * np.pi * self._hz * time_s + self._phase)).sum(axis=0)
        return _GUST_M * value[:3], _GUST_DEG * value[3:]


def _waypoints(scene: Scene, options: PathOptions, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Times (n,) and places (n, 3) in town axes, from before the start to after the end."""
    times, places = [-4.0], [_inside(options, rng)]
    at_river = int(options.duration_s / (2.0 * np.mean(_LEG_S))) + 1
    while times[-1] < options.duration_s + 4.0:
        reach = options.speed_m_s * float(rng.uniform(*_LEG_S))
        before = places[-1]
        candidates = np.array([_inside(options, rng) for _ in range(40)])
        off = np.abs(np.linalg.norm(candidates[:, :2] - before[:2], axis=1) - reach)
        chosen = candidates[int(np.argmin(off))]
        if options.river and len(places) == at_river:
            chosen[1] = float(np.mean(scene.plan.river))
        # Time by distance, so that the speed is what was asked for.
        times.append(times[-1] + float(np.linalg.norm(chosen - before)) / options.speed_m_s + 0.3)
        places.append(chosen)
    return np.array(times), np.array(places)


def _inside(options: PathOptions, rng: np.random.Generator) -> FloatArray:
    half = np.asarray(options.half_extent_m)
    return np.array([*rng.uniform(-half, half), rng.uniform(*options.heights_m)])


def _snaps(options: PathOptions, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Start times and angles of turns on the spot, one in about ten seconds."""
    count = max(1, int(options.duration_s / 10.0))
    starts = (np.arange(count) + rng.uniform(0.3, 0.7, count)) * options.duration_s / count
    signs = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    return [(float(s), float(a)) for s, a in zip(starts, signs * rng.uniform(*_SNAP_DEG, count), strict=True)]


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmOptions:
    """What to write. The same options give the same frames.

    Attributes:
        world: whose town is filmed. path: how the camera flies; its duration is that of the frames.
        frames, rate_hz: of the film. width, height: pixels.
        samples: pictures of a frame's time, in which what moves is blurred, that are averaged; each looks
            through other parts of the pixels.
        readout_s: rolling shutter, from the first row to the last; the frame's time is its middle row's.
        ev: stops brighter than the scene is.
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
    samples: int = 4
    readout_s: float = 0.0
    ev: float = 0.0
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
        times_s: (n,) seconds. cam_from_local: true poses; None where the frame does not show the town.
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
    """Write film and telemetry into `folder`, by so many processes, 0 for one per core; a folder that holds
    just these is left as it is."""
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
    scene, path, frames = _scene(options, True), flight_path(options), range(options.frames)
    return FilmTruth(
        camera=options.camera,
        frame=scene.frame,
        epsg=scene.epsg,
        times_s=np.array([options.time_s(i) for i in frames]),
        cam_from_local=tuple(path.pose(options.time_s(i)) if options.at_home(i) else None for i in frames),
    )


def film_frame(options: FilmOptions, frame: int) -> Image8:
    """One frame (h, w, 3) uint8 RGB as the camera's sensor gives it."""
    home, time_s, n = options.at_home(frame), options.time_s(frame), options.samples
    scene, path, camera = _scene(options, home), flight_path(options, home), options.camera_at(frame)
    look = scene_look(scene, water_seed=int(time_s * _GLITTER_HZ))
    faces = Faces.concatenate([scene.faces, moving_cars(scene, options.path.seed, time_s=time_s)])
    light: NDArray[np.float32] = np.zeros((camera.height, camera.width, 3), np.float32)
    for k in range(n):
        moment_s = time_s + _SHUTTER_S * ((k + 0.5) / n - 0.5)
        # Another part of each pixel: a rank-1 lattice over its square.
        shift = (float((k + 0.5) / n - 0.5), float((k * 0.618034 + 0.5 / n) % 1.0 - 0.5))
        for top, bottom, later_s in _bands(camera.height, options.readout_s):
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
    return float(options.ev + slow + (0.6 * options.ev_range if leaps else 0.0))


@lru_cache(maxsize=2)
def _scene(options: FilmOptions, home: bool) -> Scene:
    return (town_of if home else other_town_of)(options.world)


@lru_cache(maxsize=8)
def flight_path(options: FilmOptions, home: bool = True) -> FlightPath:
    """How the camera of a film flies, over its town or over the other one."""
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
        place = flight_path(options, home).pose(time_s - TELEMETRY_LATE_S).center + error
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
    edges = np.linspace(0, height, (_BANDS if readout_s else 1) + 1).round().astype(int).tolist()
    return [
        (top, bottom, readout_s * (0.5 * (top + bottom) / height - 0.5)) for top, bottom in pairwise(edges)
    ]
