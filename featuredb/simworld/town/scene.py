"""What stands where: planar faces and ellipsoids in a local east-north-up frame. No pixels, no files.

Everything that a sensor can meet is one of two primitives, so any camera, LiDAR or ortho sensor needs two
intersections only, and both have a closed form. On another day the sun
stands elsewhere, and other cars at the kerbs.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, freeze

# What each texture throws back of a laser's light at 1064 nm. A face holds the index of its texture; the
# painters in `materials` and `ground` know what the names mean.
REFLECTANCE = {
    "ground": 0.25,  # replaced by the painted map
    "fields": 0.42,
    "water": 0.015,
    "facade_brick": 0.36,
    "facade_plaster": 0.52,
    "facade_ochre": 0.48,
    "facade_panel": 0.40,
    "facade_stone": 0.38,
    "roof_red": 0.44,
    "roof_brown": 0.30,
    "roof_slate": 0.13,
    "roof_bitumen": 0.09,
    "roof_metal": 0.55,
    "plain": 0.40,
    "wood": 0.46,
    "car": 0.28,
    "leaves": 0.50,
}
TEXTURES = tuple(REFLECTANCE)
SKY_ID = -1


def texture_index(name: str) -> int:
    """Index of a texture in TEXTURES."""
    return TEXTURES.index(name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Faces:
    """n one-sided planar faces; a point of face i is origin + s * edge_s + t * edge_t.

    A parallelogram has s and t in [0, 1], a triangle has s, t >= 0 and s + t <= 1. The outside is where
    edge_s x edge_t points to.

    Attributes:
        origin, edge_s, edge_t: (n, 3) float64, metres.
        triangle: (n,) bool.
        texture: (n,) int16, index into TEXTURES.
        uv: (n, 6) float64 texture coordinates in metres: u0, v0 at the origin, then du, dv along edge_s,
            then du, dv along edge_t.
        detail_uv: (n, 2) float64, metres: where the fine-detail texture starts; equal values and equal
            `uv` give exactly equal looks. NaN means no detail.
        tint: (n, 3) float64 factors on red, green, blue: paint and light from the sun.
        object_id: (n,) int32, one number per building, car, ...
    """

    origin: FloatArray
    edge_s: FloatArray
    edge_t: FloatArray
    triangle: NDArray[np.bool_]
    texture: NDArray[np.int16]
    uv: FloatArray
    detail_uv: FloatArray
    tint: FloatArray
    object_id: NDArray[np.int32]

    def __post_init__(self) -> None:
        n = len(self.origin)
        for name, columns, dtype in _FACE_COLUMNS:
            value = np.array(getattr(self, name), dtype=dtype)
            if value.shape != ((n, columns) if columns else (n,)):
                raise InvalidValueError(f"Faces.{name}: expected {n} rows of {columns}, found {value.shape}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.origin)

    @classmethod
    def concatenate(cls, parts: "list[Faces]") -> Self:
        """All faces of the parts, in their order."""
        if not parts:
            return cls(**{n: np.zeros((0, c) if c else 0, dtype=t) for n, c, t in _FACE_COLUMNS})
        return cls(**{n: np.concatenate([getattr(p, n) for p in parts]) for n, _, _ in _FACE_COLUMNS})

    def take(self, rows: NDArray[np.bool_]) -> "Faces":
        """The faces of these rows."""
        return Faces(**{name: getattr(self, name)[rows] for name, _, _ in _FACE_COLUMNS})

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> "Faces":
        """The same faces at rotation @ x + translation; textures move with them."""
        turn, shift = np.asarray(rotation, dtype=np.float64), np.asarray(translation, dtype=np.float64)
        return replace(
            self,
            origin=self.origin @ turn.T + shift,
            edge_s=self.edge_s @ turn.T,
            edge_t=self.edge_t @ turn.T,
        )

    def shaded(self, to_sun: ArrayLike) -> "Faces":
        """The same faces with Lambert's light from the unit vector `to_sun` multiplied into `tint`."""
        return replace(self, tint=self.tint * self.sunlight(to_sun)[:, None])

    def sunlight(self, to_sun: ArrayLike) -> FloatArray:
        """Lambert's light (n,) from the unit vector `to_sun`, between 0.55 and 1.1."""
        normal = np.cross(self.edge_s, self.edge_t)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return np.asarray(0.55 + (1.1 - 0.55) * np.clip(normal @ np.asarray(to_sun), 0.0, 1.0))


_FACE_COLUMNS: tuple[tuple[str, int, Any], ...] = (
    ("origin", 3, np.float64),
    ("edge_s", 3, np.float64),
    ("edge_t", 3, np.float64),
    ("triangle", 0, np.bool_),
    ("texture", 0, np.int16),
    ("uv", 6, np.float64),
    ("detail_uv", 2, np.float64),
    ("tint", 3, np.float64),
    ("object_id", 0, np.int32),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ellipsoids:
    """n ellipsoids with axes along east, north, up: the crowns of trees and bushes.

    Attributes:
        center, radii: (n, 3) float64, metres.
        tint: (n, 3) float64 factors on red, green, blue.
        texture_uv: (n, 2) float64 metres, where each crown cuts its piece from the leaf texture.
        object_id: (n,) int32.
    """

    center: FloatArray
    radii: FloatArray
    tint: FloatArray
    texture_uv: FloatArray
    object_id: NDArray[np.int32]

    def __post_init__(self) -> None:
        n = len(self.center)
        freeze(self, center=(n, 3), radii=(n, 3), tint=(n, 3), texture_uv=(n, 2))
        freeze(self, np.int32, object_id=(n,))

    def __len__(self) -> int:
        return len(self.center)


@dataclass(frozen=True, slots=True, kw_only=True)
class Building:
    """A box with a roof, in the town's own axes, metres.

    Attributes:
        x, y, width, depth: centre and sizes. yaw_deg: counter-clockwise turn of its width from the x axis.
        base, eaves: heights of the lowest ground and of the eaves. ridge: over the eaves, 0 for a flat roof.
        facade, roof: names of textures.
        facade_u, detail_u, roof_u: where its pieces of the textures start, metres; equal numbers make
            equal looks.
        tint: factors on red, green, blue of the facade.
        back_u: how much further along its texture opposite walls and slopes start than the first ones; 0
            makes them alike. side_u: the same of neighbouring walls.
    """

    x: float
    y: float
    yaw_deg: float = 0.0
    width: float
    depth: float
    base: float
    eaves: float
    ridge: float = 0.0
    facade: str = "facade_plaster"
    roof: str = "roof_bitumen"
    facade_u: float
    detail_u: float
    roof_u: float
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    back_u: float = 0.0
    side_u: float = 9.0

    def footprint(self) -> FloatArray:
        """Corners (4, 2), counter-clockwise, from the front left one, town axes, metres."""
        a = np.radians(self.yaw_deg)
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        half = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [self.width, self.depth]
        return np.asarray(half @ turn.T + [self.x, self.y], dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True)
class Street:
    """A straight street along x or y, at `at` on the other axis, from `start` to `end`; town axes, metres."""

    along: str
    at: float
    start: float
    end: float
    width: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundPlan:
    """What the ground painter needs, in town axes, metres.

    Attributes:
        size: width (x) and height (y) of the painted rectangle, centred on the origin.
        streets, buildings: as laid out. plazas, car_parks, gardens: rectangles (x0, y0, x1, y1).
        trees: (n, 3) x, y, crown radius, for their shadows.
        profile: (k, 2) knots (y, height) of the terrain, which depends on y only.
        river: y0, y1 of the bed.
        to_sun: unit vector.
    """

    seed: int
    size: tuple[float, float]
    streets: tuple[Street, ...]
    buildings: tuple[Building, ...]
    plazas: tuple[tuple[float, float, float, float], ...]
    car_parks: tuple[tuple[float, float, float, float], ...]
    gardens: tuple[tuple[float, float, float, float], ...]
    trees: tuple[tuple[float, float, float], ...]
    profile: tuple[tuple[float, float], ...]
    river: tuple[float, float]
    to_sun: tuple[float, float, float]

    def height(self, y: ArrayLike) -> FloatArray:
        """Terrain height in metres at y (any shape)."""
        knots = np.asarray(self.profile)
        return np.asarray(np.interp(np.asarray(y, dtype=np.float64), knots[:, 0], knots[:, 1]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """The town, placed on Earth.

    Attributes:
        name: for people. seed: of the layout and the textures.
        frame: local ENU frame; all faces and ellipsoids are in it, metres.
        epsg: UTM zone of the answers.
        enu_from_town: (3, 3) rotation about up; the town's axes are not those of the compass.
        plan: the ground, in town axes.
        faces, ellipsoids: all that stands still.
        texel_m: resolution of the painted ground. pieces: of walls and tiled roofs (see `materials`).
    """

    name: str
    seed: int
    frame: LocalFrame
    epsg: int
    enu_from_town: FloatArray
    plan: GroundPlan
    faces: Faces
    ellipsoids: Ellipsoids
    texel_m: float
    pieces: int = 1

    def __post_init__(self) -> None:
        freeze(self, enu_from_town=(3, 3))


# Share of the remaining cars in whose place another stands, of another colour and not quite at the same spot.
_CARS_SWAPPED = 0.8


@dataclass(frozen=True, slots=True, kw_only=True)
class DayOptions:
    """What differs from the day of the scene.

    Attributes:
        to_sun: direction to the sun in town axes, any length; None leaves it where it is. Shadows on the
            ground, the light on faces and crowns follow it.
        cars_gone: share of the parked cars that are not there.
        leaf_tint: factors on red, green, blue of the crowns: the season.
    """

    seed: int = 1
    to_sun: tuple[float, float, float] | None = None
    cars_gone: float = 0.4
    leaf_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)


def another_day(scene: Scene, options: DayOptions) -> Scene:
    """The scene on that day; what does not move is the same to the last bit."""
    faces, plan = _other_cars(scene, options), scene.plan
    crowns = scene.ellipsoids
    if options.leaf_tint != (1.0, 1.0, 1.0):
        crowns = replace(crowns, tint=crowns.tint * np.asarray(options.leaf_tint))
    if options.to_sun is not None:
        sun = np.asarray(options.to_sun) / np.linalg.norm(options.to_sun)
        old, new = (faces.sunlight(scene.enu_from_town @ np.asarray(way)) for way in (plan.to_sun, sun))
        faces = replace(faces, tint=faces.tint * (new / old)[:, None])
        plan = replace(plan, to_sun=(float(sun[0]), float(sun[1]), float(sun[2])))
    return replace(scene, faces=faces, ellipsoids=crowns, plan=plan)


def _other_cars(scene: Scene, options: DayOptions) -> Faces:
    """The faces with some of the parked cars gone, and others in the place of some."""
    faces = scene.faces
    rng = np.random.default_rng((scene.seed, options.seed, 61))
    is_car = faces.texture == texture_index("car")
    origin, tint, keep = faces.origin.copy(), faces.tint.copy(), np.ones(len(faces), dtype=bool)
    for object_id in np.unique(faces.object_id[is_car]):
        gone, swapped = rng.random(2) < (options.cars_gone, _CARS_SWAPPED)
        shift, factors = rng.normal(0, [0.35, 0.35]), rng.uniform(0.25, 1.6) * rng.uniform(0.7, 1.2, 3)
        mine = is_car & (faces.object_id == object_id)
        if gone:
            keep &= ~mine
        elif swapped:
            origin[mine, :2] += shift
            tint[mine] *= factors
    return replace(faces, origin=origin, tint=tint).take(keep)
