"""Plans of photos: a drone's survey, later visitors with drones, and people in the streets."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Literal

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.simworld.camera.photograph import Device, Shot, look_pose
from featuredb.simworld.town.scene import Scene, Street

GpsError = Literal["realistic", "rtk", "none"]

RTK_SIGMA_M = (0.015, 0.015, 0.025)  # east, north, up: fixed ambiguities, a station nearby
_FORWARD_OVERLAP, _SIDE_OVERLAP = 0.78, 0.70  # shares of a photo's footprint
_PHOTOS_PER_SIGHT = 5
_START = datetime(2025, 6, 14, 9, 12, 5, tzinfo=UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightOptions:
    """A survey flight in lines to and fro.

    Attributes:
        lines, per_line: photos = lines * per_line, plus the oblique ones.
        oblique: photos from the rim, looking inward at 50 degrees below the horizon.
        width: of the photos, pixels; they are 4:3.
        gps_error: "realistic", "rtk" for a surveyor's receiver, or "none" for truth priors.
        center_m: middle of the survey, town axes.
    """

    lines: int = 7
    per_line: int = 10
    height_m: float = 70.0
    oblique: int = 8
    width: int = 1600
    gps_error: GpsError = "realistic"
    center_m: tuple[float, float] = (0.0, 0.0)


def drone_device(width: int) -> Device:
    """The survey drone: 4:3, 24 mm equivalent, a little barrel distortion, the axis off the centre."""
    f = 0.749 * width
    params = (f, 1.0007 * f, 0.5009 * width, 0.3744 * width, -0.052, 0.021, 0.0004, -0.0003)
    camera = Camera(model="OPENCV", width=width, height=width * 3 // 4, params=params)
    return Device(make="Simworld", model="SW-Drone 1", camera=camera, focal_mm=8.8, focal_35mm=26)


def visitor_device(width: int) -> Device:
    """Another drone, for queries: longer lens, other distortion."""
    f = 0.832 * width
    params = (f, 0.4992 * width, 0.3754 * width, 0.031)
    camera = Camera(model="SIMPLE_RADIAL", width=width, height=width * 3 // 4, params=params)
    return Device(make="Simworld", model="SW-Mini", camera=camera, focal_mm=6.7, focal_35mm=29)


def street_devices(width: int) -> tuple[Device, ...]:
    """Phones and cameras of passers-by: other focal lengths, sizes, distortions, one upright."""
    plans = (
        ("Phone A", 1.0, 0.75, 0.722, 0.035, 26, 4.3),
        ("Phone B", 0.9, 0.5625, 0.78, -0.02, 28, 5.6),
        ("Compact", 0.85, 0.667, 0.98, -0.07, 35, 9.1),
        ("Phone A upright", 0.75, 1.3334, 0.963, 0.035, 26, 4.3),
    )
    devices = []
    for name, share, aspect, focal, k, equivalent, millimetres in plans:
        w = round(share * width / 4) * 4
        h = round(w * aspect / 4) * 4
        camera = Camera(model="SIMPLE_RADIAL", width=w, height=h, params=(focal * w, 0.5 * w, 0.5 * h, k))
        devices.append(
            Device(make="Simworld", model=name, camera=camera, focal_mm=millimetres, focal_35mm=equivalent)
        )
    return tuple(devices)


def survey(scene: Scene, options: FlightOptions, seed: int) -> list[Shot]:
    """The survey: lines along the town's x axis, then the oblique photos on a ring."""
    rng = np.random.default_rng((seed, 11))
    device = drone_device(options.width)
    step, between = _spacing_m(options)
    y_axis = scene.enu_from_town[:, 1]
    turn = float(np.degrees(np.arctan2(y_axis[0], y_axis[1])))  # compass heading of the town's y axis
    stations: list[tuple[FloatArray, float, float]] = []
    for line in range(options.lines):
        y = (line - 0.5 * (options.lines - 1)) * between
        along = (np.arange(options.per_line) - 0.5 * (options.per_line - 1)) * step
        for x in along if line % 2 == 0 else along[::-1]:
            stations.append((np.array([x, y, options.height_m]), 90.0 if line % 2 == 0 else 270.0, -90.0))
    ring = np.array([0.5 * step * options.per_line, 0.5 * between * options.lines])
    for i in range(options.oblique):
        a = 2 * np.pi * (i + 0.3) / options.oblique
        outward = np.array([np.cos(a), np.sin(a)])
        position = np.array([*(outward * ring), 0.9 * options.height_m])
        stations.append((position, float(np.degrees(np.arctan2(-outward[0], -outward[1]))), -50.0))
    middle = np.array([*options.center_m, 0.0])
    positions = np.array(
        [scene.enu_from_town @ (p + middle + rng.normal(0, [0.9, 0.9, 0.5])) for p, _, _ in stations]
    )
    times = [_START + timedelta(seconds=3.1 * i) for i in range(len(stations))]
    believed = received_positions(positions, 3.1, options.gps_error, rng)
    shots = []
    for i, (_, heading, pitch) in enumerate(stations):
        sway = rng.normal(0, [1.8, 1.3, 1.0])
        shots.append(
            Shot(
                name=f"drone/SW_{i + 1:04d}.jpg",
                device=device,
                cam_from_local=look_pose(positions[i], heading + turn + sway[0], pitch + sway[1], sway[2]),
                time=times[i],
                seed=shot_seed(seed, 1, i),
                gps_enu=believed[i],
            )
        )
    return shots


def visitors(scene: Scene, flight: FlightOptions, count: int, seed: int, *, width: int) -> list[Shot]:
    """Held-out drone photos over the survey's area, by the survey's drone and another one in turn.

    Any heading, height within 25 %, pitch from straight down to about 52 degrees below the horizon.
    """
    rng = np.random.default_rng((seed, 12))
    devices = drone_device(width), visitor_device(width)
    half_x, half_y = survey_half_extent(flight)
    shots = []
    for i in range(count):
        at = rng.uniform(-0.85, 0.85, 2) * [half_x, half_y]
        height = flight.height_m * float(rng.uniform(0.75, 1.25))
        position = scene.enu_from_town @ np.array([*(at + flight.center_m), height])
        pitch = -90.0 + float(rng.choice([0.0, 8.0, 18.0, 28.0, 35.0]) + abs(rng.normal(0, 3)))
        heading = float(rng.uniform(0, 360))
        if pitch > -80 and at @ _town_direction(scene, heading) > 0:
            heading += 180.0  # an oblique view looks over the town, not away from it
        shots.append(
            Shot(
                name=f"queries/query_{i + 1:04d}.jpg",
                device=devices[i % 2],
                cam_from_local=look_pose(position, heading, pitch, float(rng.normal(0, 3))),
                time=_START + timedelta(days=21, seconds=40 * i),
                seed=shot_seed(seed, 2, i),
                gps_enu=received_positions(position[None], 1.0, flight.gps_error, rng)[0],
            )
        )
    return shots


def pedestrians(
    scene: Scene, count: int, seed: int, *, width: int, extent_m: tuple[float, float]
) -> list[Shot]:
    """Street-level photos within `extent_m` (half sizes, town axes), each of the sights by several people.

    A sight is a place on the building line of a street; people stand on the far pavement within 14 m of
    facing it, with another camera each. Every second photo has a poor GPS, the others none.
    """
    rng = np.random.default_rng((seed, 13))
    devices = street_devices(width)
    streets = [s for s in scene.plan.streets if abs(s.at) < extent_m[1 if s.along == "x" else 0]]
    sights = [_sight(streets, extent_m, rng) for _ in range(-(-count // _PHOTOS_PER_SIGHT))]
    shots = []
    for i in range(count):
        street, along, side = sights[i // _PHOTOS_PER_SIGHT]
        stand = along + float(rng.uniform(-14, 14)), street.at - side * (0.5 * street.width + 0.3)
        target = along, street.at + side * (0.5 * street.width + 6.0)
        (x, y), (tx, ty) = (stand, target) if street.along == "x" else (stand[::-1], target[::-1])
        eye = max(float(scene.plan.height(y)), 0.0) + float(rng.uniform(1.5, 1.75))
        position = scene.enu_from_town @ np.array([x, y, eye])
        view = scene.enu_from_town @ np.array([tx - x, ty - y, 0.0])
        heading = float(np.degrees(np.arctan2(view[0], view[1])) + rng.normal(0, 6))
        error = rng.normal(0, [9.0, 9.0, 12.0]) if i % 2 else None
        shots.append(
            Shot(
                name=f"street/street_{i + 1:04d}.jpg",
                device=devices[i % len(devices)],
                cam_from_local=look_pose(
                    position, heading, float(rng.normal(6, 3)), float(rng.normal(0, 1.5))
                ),
                time=_START + timedelta(days=35, seconds=90 * i),
                seed=shot_seed(seed, 3, i),
                gps_enu=None if error is None else position + error,
            )
        )
    return shots


def _sight(
    streets: list[Street], extent_m: tuple[float, float], rng: np.random.Generator
) -> tuple[Street, float, float]:
    """A street, a place along it, and the side (-1, 1) of it that is looked at."""
    street = streets[int(rng.integers(len(streets)))]
    along = float(rng.uniform(-0.85, 0.85)) * extent_m[0 if street.along == "x" else 1]
    return street, along, float(rng.choice([-1.0, 1.0]))


def survey_half_extent(options: FlightOptions) -> tuple[float, float]:
    """Half of the rectangle that the survey's centres cover, town axes, metres."""
    step, between = _spacing_m(options)
    return 0.5 * step * options.per_line, 0.5 * between * options.lines


def _spacing_m(options: FlightOptions) -> tuple[float, float]:
    """Between photos of a line, and between lines."""
    camera = drone_device(options.width).camera
    step = (1 - _FORWARD_OVERLAP) * options.height_m * camera.height / camera.focal_px
    return step, (1 - _SIDE_OVERLAP) * options.height_m * camera.width / camera.focal_px


def received_positions(
    positions: FloatArray, step_s: float, error: GpsError, rng: np.random.Generator
) -> FloatArray:
    """What a receiver says (n, 3): truth, or truth with noise, a wandering bias and a wrong height.

    White noise of 0.8 m, a first-order Gauss-Markov bias of 1.2 m with a time constant of 200 s, and a
    height off by a constant of several metres: a consumer drone without RTK. With RTK, white noise alone.
    """
    if error == "none":
        return positions.copy()
    if error == "rtk":
        return np.asarray(positions + rng.normal(0, RTK_SIGMA_M, positions.shape), dtype=np.float64)
    keep = np.exp(-step_s / 200.0)
    bias = rng.normal(0, [1.2, 1.2, 1.5])
    height_bias = float(rng.choice([-1, 1]) * rng.uniform(3, 8))
    believed = np.empty_like(positions)
    for i, position in enumerate(positions):
        bias = keep * bias + np.sqrt(1 - keep**2) * rng.normal(0, [1.2, 1.2, 1.5])
        believed[i] = position + bias + rng.normal(0, [0.8, 0.8, 1.2]) + [0.0, 0.0, height_bias]
    return believed


def _town_direction(scene: Scene, heading_deg: float) -> FloatArray:
    """Unit vector (2,) in town axes of a compass heading."""
    h = np.radians(heading_deg)
    return np.asarray((scene.enu_from_town.T @ np.array([np.sin(h), np.cos(h), 0.0]))[:2])


def shot_seed(seed: int, *what: int) -> int:
    """Seed of one shot."""
    return int(np.random.SeedSequence((seed, *what)).generate_state(1)[0])
