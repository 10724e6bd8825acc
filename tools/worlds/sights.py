"""Sights of a town, where people stand to look at them, and which views somebody would take."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import look_pose, render_depth
from featuredb.simworld.town.scene import Building, Scene, texture_index

Rect = tuple[float, float, float, float]

_PROBE_WIDTH_PX = 72
_CLASSIC_STANDS = 3  # most people photograph a sight from the same few places
_STAND_TRIES = 150


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """Something that people photograph, in town axes, metres.

    Attributes:
        target: what they aim at. radius: half its size. weight: popularity.
        stands: eye positions from which it is seen from the ground.
    """

    target: tuple[float, float, float]
    radius: float
    weight: float
    stands: tuple[tuple[float, float, float], ...]


class Surroundings:
    """What a camera may bump into, as arrays; in town axes."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        plan = scene.plan
        self._centers = np.array([(b.x, b.y) for b in plan.buildings]).reshape(-1, 2)
        turns = np.radians([b.yaw_deg for b in plan.buildings])
        self._turns = np.column_stack([np.cos(turns), np.sin(turns)])
        self._half = 0.5 * np.array([(b.width, b.depth) for b in plan.buildings]).reshape(-1, 2)
        self._tops = np.array([b.eaves + b.ridge for b in plan.buildings])

    def free(self, point: FloatArray, margin_m: float = 1.0) -> bool:
        """Whether a camera (3,) is outside of all buildings and crowns, and above ground."""
        if point[2] < self.ground(float(point[1])) + 0.5:
            return False
        offset = point[:2] - self._centers
        c, s = self._turns.T
        own = np.column_stack([c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1]])
        inside = (np.abs(own) < self._half + margin_m).all(axis=1) & (point[2] < self._tops + margin_m)
        if inside.any():
            return False
        crowns = self.scene.ellipsoids
        away = (self.scene.enu_from_town @ point - crowns.center) / (crowns.radii + 0.5 * margin_m)
        return not bool((np.einsum("ij,ij->i", away, away) < 1.0).any())

    def ground(self, y: float) -> float:
        """Height of the terrain, or of the bridges over the river."""
        low, high = self.scene.plan.river
        height = float(self.scene.plan.height(y))
        return max(height, 0.0) if low - 2 < y < high + 2 else height

    def worth_taking(self, camera: Camera, cam_from_local: Rigid3, nearest_m: float) -> bool:
        """Whether the view is not blocked by something close, and is not all sky or far land."""
        scale = _PROBE_WIDTH_PX / camera.width
        height = max(9, round(scale * camera.height))
        probe = Camera.from_focal(_PROBE_WIDTH_PX, height, scale * camera.focal_px)
        depth = render_depth(self.scene, probe, cam_from_local).depth
        near, seen = float((depth < nearest_m).mean()), float((depth < 250.0).mean())
        h, w = depth.shape
        middle = float(np.median(depth[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3]))
        return near < 0.12 and seen > 0.45 and nearest_m < middle < 250.0


def find_sights(
    scene: Scene,
    count: int,
    seed: int,
    center_m: tuple[float, float] = (0.0, 0.0),
    within: Rect | None = None,
) -> list[Sight]:
    """Sights of a town, most popular first; the same for the same arguments.

    Churches and squares are looked at most, then the park, halls and bridges, then ordinary houses; all the
    more the nearer to `center_m` (town axes) they lie. With `within`, only those in that rectangle.
    """
    rng = np.random.default_rng((seed, 51))
    around = Surroundings(scene)
    candidates = _named_targets(scene, within, rng)
    spread = 0.35 * max(scene.plan.size)
    scored = []
    for target, radius, weight in candidates:
        away = np.hypot(target[0] - center_m[0], target[1] - center_m[1]) / spread
        scored.append((weight * float(np.exp(-0.5 * away**2) + 0.1), target, radius))
    scored.sort(key=lambda entry: -entry[0])
    sights = []
    for weight, target, radius in scored:
        stands = _stands(around, target, radius, rng)
        if stands:
            sights.append(Sight(target=target, radius=radius, weight=weight, stands=stands))
        if len(sights) == count:
            break
    return sights


def lies_in(rect: Rect, x: float, y: float) -> bool:
    """Whether a place is in a rectangle, town axes."""
    return rect[0] <= x <= rect[2] and rect[1] <= y <= rect[3]


Target = tuple[tuple[float, float, float], float, float]


def _named_targets(scene: Scene, within: Rect | None, rng: np.random.Generator) -> list[Target]:
    targets: list[Target] = []
    houses: list[Target] = []
    for b in scene.plan.buildings:
        kind, weight = _kind_of(b)
        if kind == "tower":
            continue  # its church stands beside it
        height = 0.5 * (b.eaves + float(scene.plan.height(b.y)))
        target = ((b.x, b.y, height), 0.5 * max(b.width, b.depth), weight)
        (houses if kind == "house" else targets).append(target)
    for s in scene.plan.streets:
        if s.along == "y":
            targets.append(((s.at, 0.5 * sum(scene.plan.river), 0.8), 8.0, 3.0))
    if within is not None:
        targets, houses = ([t for t in those if lies_in(within, *t[0][:2])] for those in (targets, houses))
    picked = rng.permutation(len(houses))[: max(8, len(houses) // 10)]
    return targets + [houses[int(i)] for i in picked]


def _kind_of(b: Building) -> tuple[str, float]:
    if b.facade == "facade_stone" and b.roof == "roof_slate" and b.ridge >= 5.0:
        return ("tower", 0.0) if b.width < 8.0 else ("church", 8.0)
    if b.roof == "roof_metal":
        return "hall", 3.0
    if b.facade == "facade_panel":
        return "slab", 2.0
    if (b.width, b.depth) == (6, 6):
        return "pavilion", 4.0
    return "house", 1.5


def _stands(
    around: Surroundings, target: tuple[float, float, float], radius: float, rng: np.random.Generator
) -> tuple[tuple[float, float, float], ...]:
    """A few places on streets, squares and lawns from which the target is in sight."""
    found: list[tuple[float, float, float]] = []
    camera = Camera.from_focal(_PROBE_WIDTH_PX, 54, 0.75 * _PROBE_WIDTH_PX)
    goal = np.asarray(target)
    for _ in range(_STAND_TRIES):
        angle, distance = rng.uniform(0, 2 * np.pi), radius + rng.uniform(7.0, 30.0)
        x, y = goal[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
        eye = np.array([x, y, around.ground(float(y)) + 1.6])
        if not around.free(eye) or any(np.hypot(x - a, y - b) < 6.0 for a, b, _ in found):
            continue
        pose = look_at(around.scene, eye, goal)
        depth = render_depth(around.scene, camera, pose).depth
        middle = float(np.median(depth[18:36, 26:46]))
        if distance - 1.3 * radius - 4.0 < middle < distance + 4.0 and (depth < 3.0).mean() < 0.1:
            found.append((float(x), float(y), float(eye[2])))
        if len(found) == _CLASSIC_STANDS:
            break
    return tuple(found)


def look_at(
    scene: Scene, eye: FloatArray, target: FloatArray, turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Rigid3:
    """Pose of a camera at `eye` that looks at `target`, both (3,) in town axes; `turn_deg` is added to
    heading, pitch, roll."""
    position = scene.enu_from_town @ eye
    view = scene.enu_from_town @ (np.asarray(target, dtype=np.float64) - eye)
    heading = float(np.degrees(np.arctan2(view[0], view[1])))
    pitch = float(np.degrees(np.arctan2(view[2], np.hypot(view[0], view[1]))))
    return look_pose(position, heading + turn_deg[0], max(pitch + turn_deg[1], -90.0), turn_deg[2])


class SeenPlaces:
    """A picture whose every pixel has a true place, in the scene's local frame.

    Attributes:
        depth: (h, w) metres, infinite in the sky. still: (h, w) what shows no car.
    """

    def __init__(self, scene: Scene, camera: Camera, cam_from_local: Rigid3) -> None:
        self._camera, self._cam_from_local = camera, cam_from_local
        rendered = render_depth(scene, camera, cam_from_local)
        self.depth = rendered.depth
        cars = np.unique(scene.faces.object_id[scene.faces.texture == texture_index("car")])
        self.still = np.isfinite(self.depth) & ~np.isin(rendered.object_id, cars)

    def pixels(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Centres (count, 2) of pixels that show what stands still."""
        rows, columns = np.nonzero(self.still)
        chosen = rng.choice(len(rows), count, replace=False)
        return np.column_stack([columns[chosen], rows[chosen]]).astype(np.float64) + 0.5

    def places(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) of pixels (n, 2)."""
        depth = self.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(np.float64)
        rays = np.column_stack([self._camera.unproject(pixels), np.ones(len(pixels))])
        return self._cam_from_local.inverse().act(rays * depth[:, None])
