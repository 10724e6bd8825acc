"""The way of a camera that films: position and orientation at any time, smooth or in gusts."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import look_pose
from featuredb.simworld.town.scene import Scene

FlightStyle = Literal["smooth", "jerky"]

_LEG_S = (3.0, 5.0)  # between waypoints
_CLEAR_M = 22.0  # over the ground; roofs and trees end below
# Gusts: waves of these frequencies (Hz), and how much they turn (degrees) and shift (metres) the camera.
_GUST_HZ, _GUST_DEG, _GUST_M = (0.7, 3.1), 1.1, 0.10
_SNAP_DEG, _SNAP_S = (50.0, 95.0), 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class PathOptions:
    """How a camera flies.

    Attributes:
        seed: of the way. style: smooth; or jerky: gusts, and turns on the spot of up to 95 degrees in 0.8 s.
        duration_s: of the flight.
        half_extent_m: it stays within (+-x, +-y) of the town's middle, town axes.
        heights_m: over the town's origin. speed_m_s: over ground.
        down_deg: how far below the horizon it looks.
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
        self._options, self._turn = options, scene.enu_from_town
        times, places = _waypoints(scene, options, rng)
        self._place = CubicSpline(times, places)
        down = rng.uniform(*options.down_deg, len(times))
        if options.river:
            over = np.abs(places[:, 1] - np.mean(scene.plan.river)) < 15.0
            down[over] = options.down_deg[1] + 10.0
        self._pitch = PchipInterpolator(times, -down)
        self._heading = PchipInterpolator(times, _headings(places))
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
        rotation = town.rotation @ self._turn.T
        return Rigid3(rotation=rotation, translation=-rotation @ (self._turn @ place))


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
        leg = float(rng.uniform(*_LEG_S))
        reach = options.speed_m_s * leg
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


def _headings(places: FloatArray) -> FloatArray:
    """(n,) degrees clockwise from the town's north, from each place's last neighbour to its next, unwrapped.

    A camera that turns with its way would spin where the way turns back.
    """
    away = np.gradient(places[:, :2], axis=0)
    return np.asarray(np.degrees(np.unwrap(np.arctan2(away[:, 0], away[:, 1]))), dtype=np.float64)


def _inside(options: PathOptions, rng: np.random.Generator) -> FloatArray:
    half = np.asarray(options.half_extent_m)
    return np.array([*rng.uniform(-half, half), rng.uniform(*options.heights_m)])


def _snaps(options: PathOptions, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Start times and angles of turns on the spot, one in about ten seconds."""
    count = max(1, int(options.duration_s / 10.0))
    starts = (np.arange(count) + rng.uniform(0.3, 0.7, count)) * options.duration_s / count
    signs = np.where(rng.random(count) < 0.5, -1.0, 1.0)
    return [(float(s), float(a)) for s, a in zip(starts, signs * rng.uniform(*_SNAP_DEG, count), strict=True)]
