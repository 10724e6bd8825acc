"""One person at one sight on one day: a handful of photos, as people take them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.shot import Device
from tools.worlds.people import Person, stored_upright, zoomed
from tools.worlds.sights import Sight, Surroundings, look_at

_NEAREST_DRONE_M, _NEAREST_GROUND_M = 4.0, 2.5
_TRIES = 6  # a photographer who sees nothing but a wall takes a step and tries again


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One photo of a visit: with what, from where, how the phone was held."""

    device: Device
    cam_from_local: Rigid3
    orientation: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Viewpoint:
    """Where one photo is taken from and of what, town axes; `turn_deg` is heading, pitch, roll on top."""

    eye: FloatArray
    target: FloatArray
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)


DroneMode = Callable[[Person, Sight, Surroundings, int, np.random.Generator], list[Viewpoint]]


def ground_visit(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[View]:
    """Photos from the ground: near one of the places where most people stand, a few steps between them."""
    assert person.ground is not None
    stand = np.array(sight.stands[int(rng.integers(len(sight.stands)))])
    careless = 1.0 - person.skill
    views: list[View] = []
    for _ in range(count):
        for _ in range(_TRIES):
            eye = stand + np.append(rng.normal(0, 3.0 + 4.0 * careless, 2), 0.0)
            eye[2] = around.ground(float(eye[1])) + rng.uniform(1.45, 1.8)
            aim = np.asarray(sight.target) + rng.normal(0, [2.0, 2.0, 1.0])
            if rng.random() < 0.15:  # somebody turns and photographs what else is there
                away = rng.normal(0, 1, 2)
                aim = eye + np.append(25.0 * away / np.linalg.norm(away), 2.0)
            factor = float(rng.choice([1.0, person.zoom], p=[0.7, 0.3]))
            device = person.ground if factor == 1.0 else zoomed(person.ground, factor)
            upright = person.upright != "never" and rng.random() < 0.5
            device, roll, orientation = _held(device, person, upright)
            wobble = rng.normal(0, [3.0, 2.0, 0.8 + 3.0 * careless])
            look = Viewpoint(eye=eye, target=aim, turn_deg=(wobble[0], wobble[1], wobble[2] + roll))
            view = _view(around, look, device, orientation, _NEAREST_GROUND_M)
            if view is not None:
                views.append(view)
                break
    return views


def _held(device: Device, person: Person, upright: bool) -> tuple[Device, float, int]:
    """Device, roll in degrees and EXIF orientation of a photo held level or upright."""
    if not upright:
        return device, 0.0, 1
    if person.upright == "stored":
        return stored_upright(device), 0.0, 1
    return device, 90.0, 6


def drone_visit(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[View]:
    """Photos of one flight: around a sight, climbing, along a street, straight down, or the whole town."""
    assert person.drone is not None
    low = person.heights_m[0] < 35.0
    names = ["orbit", "climb", "along", "down", "overview"]
    shares = [0.36, 0.2, 0.2, 0.12, 0.12] if low else [0.3, 0.08, 0.12, 0.25, 0.25]
    mode = str(rng.choice(names, p=shares))
    views = []
    for look in DRONE_MODES[mode](person, sight, around, count, rng):
        wobble = rng.normal(0, [1.5, 1.2, 0.6 + 1.5 * (1 - person.skill)])
        turn = (look.turn_deg[0] + wobble[0], look.turn_deg[1] + wobble[1], look.turn_deg[2] + wobble[2])
        view = _view(
            around,
            Viewpoint(eye=look.eye, target=look.target, turn_deg=turn),
            person.drone,
            1,
            _NEAREST_DRONE_M,
        )
        if view is not None:
            views.append(view)
    return views


def _view(
    around: Surroundings, look: Viewpoint, device: Device, orientation: int, nearest_m: float
) -> View | None:
    """The view, or None where nobody would take it or the camera would stand in something."""
    inside = np.abs(look.eye[:2]) < 0.5 * np.asarray(around.scene.plan.size) + 20.0
    if not inside.all() or not around.free(look.eye):
        return None
    pose = look_at(around.scene, look.eye, look.target, look.turn_deg)
    if not around.worth_taking(device.camera, pose, nearest_m):
        return None
    return View(device=device, cam_from_local=pose, orientation=orientation)


def _height(person: Person, rng: np.random.Generator) -> float:
    low, high = person.heights_m
    return float(low * (high / low) ** rng.random())


def _orbit(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """A part of a circle, 8 to 20 degrees between photos; the town lies behind the sight or under it."""
    above = _height(person, rng)
    radius = sight.radius + above * float(rng.uniform(0.5, 1.6))
    start, step = float(rng.uniform(0, 360)), float(rng.choice([-1, 1]) * rng.uniform(8, 20))
    target = np.asarray(sight.target)
    looks = []
    for i in range(count):
        a = np.radians(start + step * i)
        eye = target + radius * np.array([np.cos(a), np.sin(a), 0.0]) + rng.normal(0, 0.8, 3)
        eye[2] = around.ground(float(target[1])) + above
        looks.append(Viewpoint(eye=eye, target=target))
    return looks


def _climb(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """Take-off before the sight: from the height of a person's head up, camera lowered as it rises."""
    x, y, eye_z = sight.stands[int(rng.integers(len(sight.stands)))]
    top = max(_height(person, rng), 12.0)
    away = np.array([x, y]) - sight.target[:2]
    away /= max(float(np.linalg.norm(away)), 1.0)
    looks = []
    for height in 2.0 * (top / 2.0) ** np.linspace(0.0, 1.0, max(count, 2)):
        back = 0.35 * height * away + rng.normal(0, 0.4, 2)
        eye = np.array([x + back[0], y + back[1], eye_z - 1.6 + height])
        looks.append(Viewpoint(eye=eye, target=np.asarray(sight.target)))
    return looks[:count]


def _along(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """Forward over the town towards and past the sight, camera 20 to 45 degrees down."""
    above = min(_height(person, rng), 45.0)
    heading = float(rng.choice([0.0, 90.0, 180.0, 270.0]) + rng.normal(0, 8))
    ahead = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0])
    step, down = above * float(rng.uniform(0.2, 0.45)), float(rng.uniform(20, 45))
    target = np.asarray(sight.target)
    looks = []
    for i in range(count):
        eye = target + ahead * step * (i - 0.7 * count)
        eye[2] = around.ground(float(eye[1])) + above
        reach = above / np.tan(np.radians(down))
        looks.append(Viewpoint(eye=eye, target=eye + ahead * reach - [0, 0, above]))
    return looks


def _down(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """Straight down in hops of a quarter to a half of the height, some with the camera a little forward."""
    above = max(_height(person, rng), 30.0)
    heading = float(rng.uniform(0, 360))
    ahead = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0])
    lean = float(rng.choice([0.02, 0.15, 0.35]))
    step = above * float(rng.uniform(0.25, 0.5))
    looks = []
    for i in range(count):
        eye = np.asarray(sight.target) + ahead * step * (i - 0.5 * count)
        eye[2] = around.ground(float(eye[1])) + above
        looks.append(Viewpoint(eye=eye, target=eye + ahead * lean * above - [0, 0, above]))
    return looks


def _overview(
    person: Person, sight: Sight, around: Surroundings, count: int, rng: np.random.Generator
) -> list[Viewpoint]:
    """The town from above its rim, or panned from one place: high, 15 to 45 degrees down."""
    above = float(rng.uniform(max(60.0, person.heights_m[0]), max(75.0, person.heights_m[1])))
    angle, down = float(rng.uniform(0, 360)), float(rng.uniform(15, 45))
    a = np.radians(angle)
    eye = np.asarray(sight.target) - above / np.tan(np.radians(down)) * np.array([np.cos(a), np.sin(a), 0.0])
    eye[2] = around.ground(float(eye[1])) + above
    pan = float(rng.choice([0.0, 12.0, 20.0]))
    hop = 0.0 if pan else 0.3 * above
    side = np.array([-np.sin(a), np.cos(a), 0.0])
    looks = []
    for i in range(min(count, 5)):
        offset = i - 0.5 * (min(count, 5) - 1)
        here = eye + side * hop * offset + rng.normal(0, 0.7, 3)
        aim = np.asarray(sight.target) + side * hop * offset
        looks.append(Viewpoint(eye=here, target=aim, turn_deg=(pan * offset, 0.0, 0.0)))
    return looks


DRONE_MODES: dict[str, DroneMode] = {
    "orbit": _orbit,
    "climb": _climb,
    "along": _along,
    "down": _down,
    "overview": _overview,
}
