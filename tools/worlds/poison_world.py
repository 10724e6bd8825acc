"""A town with traps: look-alike blocks, mirrors, liars, forgers; and honest people beside them.

The survey covers the west of the town. One of its blocks stands a second time in the east, another one
stands there mirrored. Kinds of photos:

- survey, honest, canary (held out, of the mapped area), late (honest photos that arrive after the poison);
- lookalike, mirror_block: honest photos of the two copies, where they truly stand; of the first a part says
  to have been taken at the original;
- mirrored: photos of the mapped area, left and right exchanged: no camera in the town can see it so;
- liar: true photos whose owner shifts all positions by the same 150 m, or by kilometres;
- liar_other: photos of another town, tagged with this one, by the same person;
- altered: pieces pasted, moved, painted over, or the picture warped;
- forged: photos of a town as it is not, in which buildings have moved or changed their facades: they agree
  with each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.flight import FlightOptions, survey_half_extent
from featuredb.simworld.town.blocks import face
from featuredb.simworld.town.scene import TEXTURES, Ellipsoids, Faces, GroundPlan, Scene, texture_index
from featuredb.simworld.town.town import BUILDING_ID
from tools.worlds.album import PlannedPhoto, TownOptions, day_scene, renamed, survey_photos, town_of
from tools.worlds.edits import Edit
from tools.worlds.gathering import named, plan_visits, tagged
from tools.worlds.people import GeotagOptions, Person, community, geotag_at
from tools.worlds.sights import Rect, Sight, find_sights, lies_in

POISONS = ("lookalike", "mirrored", "mirror_block", "liar", "liar_other", "altered", "forged")
_LIE_M = (130.0, 75.0)  # shift of the liar's positions, east and north: another block
_TAGS = GeotagOptions(sigma_m=15.0, far_share=0.0)  # of those who do not lie
_EDITS = (
    Edit(kind="pasted", amount=0.3),
    Edit(kind="moved", amount=0.25),
    Edit(kind="painted_over", amount=0.3),
    Edit(kind="warped", amount=0.02),
)

_PATCH_M = 0.02  # the copied ground lies this much over the old one
_ID_SHIFT = 50_000
_GROUND_TEXTURES = ("ground", "fields", "water")


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonOptions(TownOptions):
    """What to write; the survey is in the west of the town.

    Attributes:
        honest, late: photos of honest people before and after the poison. canaries: held-out photos.
        per_poison: photos of each of POISONS. sights: places that honest people visit.
    """

    seed: int = 4
    town_size_m: tuple[float, float] = (400.0, 200.0)
    flight: FlightOptions = field(
        default_factory=lambda: FlightOptions(
            lines=4, per_line=8, oblique=4, width=1200, gps_error="rtk", center_m=(-100.0, 10.0)
        )
    )
    honest: int = 20
    late: int = 12
    canaries: int = 6
    per_poison: int = 10
    sights: int = 6

    def scene(self, key: str) -> Scene:
        """Scenes "home/...", "forged/..." and "away/light/week"."""
        kind = key.split("/")[0]
        return day_scene(town_of(self, away=True) if kind == "away" else _with_traps(self, kind), key)


class Places(NamedTuple):
    """Where the traps are, town axes: what the survey covers, the originals, the places of their copies."""

    mapped: Rect
    source: Rect
    target: Rect
    mirror_source: Rect
    mirror_target: Rect


@lru_cache(maxsize=4)
def _with_traps(options: PoisonOptions, kind: str) -> Scene:
    places = poison_places(options)
    scene = with_copied_block(town_of(options), places.source, places.target)
    scene = with_copied_block(scene, places.mirror_source, places.mirror_target, mirrored=True)
    return scene if kind == "home" else forged(scene, places.mapped, options.seed)


def poison_places(options: PoisonOptions) -> Places:
    """The blocks: copies stand in the rows of their originals, as far from the mapped area as possible."""
    half_x, half_y = survey_half_extent(options.flight)
    cx, cy = options.flight.center_m
    mapped = (cx - half_x, cy - half_y, cx + half_x, cy + half_y)
    rows: dict[float, list[Rect]] = {}
    for block in blocks_of(town_of(options).plan):
        rows.setdefault(block[1], []).append(block)
    pairs = []
    for row in rows.values():
        row.sort()
        inside = [b for b in row if lies_in(mapped, 0.5 * (b[0] + b[2]), 0.5 * (b[1] + b[3]))]
        outside = [b for b in row if b[0] > mapped[2] + 25.0]
        if inside and outside:
            pairs.append(min((_unfit(options, a, b), a, b) for a in inside for b in outside[-2:])[1:])
    first, second, *_ = pairs  # such a town has two rows or more
    return Places(mapped, *first, *second)


def _unfit(options: PoisonOptions, source: Rect, target: Rect) -> float:
    """How badly a copy would do as a trap: it should fit between its streets, and its houses should differ,
    or its mirror image would be itself."""
    wider = (source[2] - source[0]) - (target[2] - target[0])
    looks = {b.detail_u for b in town_of(options).plan.buildings if lies_in(source, b.x, b.y)}
    return (100.0 if wider > 4.0 else abs(wider)) - 4.0 * min(len(looks), 6)


def poison_album(options: PoisonOptions) -> list[PlannedPhoto]:
    """All photos."""
    survey = survey_photos(options.scene("home/0/000"), options.flight, options.seed)
    return survey + plan_poison(options)


def plan_poison(options: PoisonOptions) -> list[PlannedPhoto]:
    """All photos but the survey's. `AlbumFact.batch` is 0 for honest ones and canaries, 1 for the poison,
    2 for honest ones that come late."""
    home, away = options.scene("home/0/000"), options.scene("away/0/000")
    places = poison_places(options)
    people = {p.name: p for p in community(options.width)}
    good = tuple(people[n] for n in ("anna", "bert", "carla", "jonas", "lena"))
    towns = _sights_of(options, home, places)
    n = options.per_poison
    plans = (
        ("honest", "home", "town", good, options.honest, 0),
        ("canary", "home", "mapped", good, options.canaries, 0),
        ("late", "home", "town", good, options.late, 2),
        ("lookalike", "home", "target", (people["carla"], people["greta"]), n, 1),
        ("mirror_block", "home", "mirror_target", (people["jonas"], people["elif"]), n, 1),
        ("mirrored", "home", "mapped", (_as(people["bert"], "mira"),), n, 1),
        ("liar", "home", "town", (_as(people["carla"], "loki"),), n, 1),
        ("liar_other", "away", "away", (_as(people["carla"], "loki"),), n, 1),
        ("altered", "home", "mapped", (_as(people["jonas"], "alter"),), n, 1),
        ("forged", "forged", "mapped", (_as(people["jonas"], "forge"), _as(people["bert"], "forge")), n, 1),
    )
    photos: list[PlannedPhoto] = []
    for i, (kind, town, sights, owners, count, batch) in enumerate(plans):
        scene = away if town == "away" else home
        seed = options.seed + 10 * i
        taken = plan_visits(scene, owners, towns[sights], count, seed, town, first_visit=1000 * i, kind=kind)
        rng = np.random.default_rng((seed, 58))
        taken = tagged(scene, taken, owners, _TAGS, rng)
        # A forged or mirrored view has a true pose or none.
        photos += [
            renamed(
                _poisoned(p, home, places, rng),
                f"{kind}-{p.shot.name}",
                kind=kind,
                batch=batch,
                home=kind != "liar_other",
            )
            for p in taken
        ]
    return named(photos, options.seed)


def _sights_of(options: PoisonOptions, home: Scene, places: Places) -> dict[str, Sequence[Sight]]:
    center, seed, n = options.flight.center_m, options.seed, options.sights
    x0, y0, x1, y1 = places.mapped
    return {
        "town": find_sights(home, n, seed, center, (x0 - 45.0, y0 - 45.0, x1 + 45.0, y1 + 45.0)),
        "mapped": find_sights(home, n, seed, center, places.mapped),
        "target": find_sights(home, 4, seed, center, places.target),
        "mirror_target": find_sights(home, 4, seed, center, places.mirror_target),
        "away": find_sights(options.scene("away/0/000"), n, seed),
    }


def _as(person: Person, name: str) -> Person:
    """The same cameras in other hands, who leave all their positions in their files."""
    return replace(person, name=name, exif="full", tags=1.0, by_hand=False, edits=())


def _poisoned(photo: PlannedPhoto, home: Scene, places: Places, rng: np.random.Generator) -> PlannedPhoto:
    """What its owner does to a photo before it is sent."""
    kind, center = photo.fact.kind, photo.shot.cam_from_local.center
    if kind == "mirrored":
        return replace(photo, edits=(Edit(kind="mirrored"),))
    if kind == "altered":
        return replace(photo, edits=(_EDITS[int(rng.integers(len(_EDITS)))],))
    if kind == "lookalike" and photo.fact.visit % 2 == 0:
        shift = 0.5 * (sum(places.source[::2]) - sum(places.target[::2]))
        at = center + home.enu_from_town @ np.array([shift, 0.0, 0.0])
        return replace(photo, geotag=geotag_at(home, at, 0.0, 8.0), exif="full")
    if kind == "liar":
        far = photo.fact.visit % 3 == 2
        at = center + np.array([*_LIE_M, 0.0]) * (30.0 if far else 1.0)
    elif kind == "liar_other":
        spot = rng.uniform(places.mapped[:2], places.mapped[2:])
        at = home.enu_from_town @ np.array([*spot, 40.0])
    else:
        return photo
    return replace(photo, geotag=geotag_at(home, at, 0.0, 5.0), exif="full")


def blocks_of(plan: GroundPlan) -> list[Rect]:
    """Rectangles (x0, y0, x1, y1) between the kerbs of neighbouring streets, town axes, row by row."""
    xs = sorted((s.at, s.width) for s in plan.streets if s.along == "y")
    ys = sorted((s.at, s.width) for s in plan.streets if s.along == "x")
    low, high = plan.river
    return [
        (x0 + 0.5 * wx, y0 + 0.5 * wy, x1 - 0.5 * wx, y1 - 0.5 * wy)
        for (y0, wy), (y1, _) in pairwise(ys)
        if not (y0 < high and y1 > low)
        for (x0, wx), (x1, _) in pairwise(xs)
    ]


def with_copied_block(scene: Scene, source: Rect, target: Rect, *, mirrored: bool = False) -> Scene:
    """The scene with the block `source` standing in the middle of `target` instead of what was there.

    Args:
        source, target: rectangles of one row of blocks (the terrain depends on y only), town axes.
        mirrored: left and right exchanged.

    Raises:
        InvalidValueError: rectangles of different rows.
    """
    if abs(source[1] - target[1]) > 0.01 or abs(source[3] - target[3]) > 0.01:
        raise InvalidValueError(f"with_copied_block: expected blocks of one row, found {source} and {target}")
    middle = 0.5 * (source[0] + source[2])
    shift, half = 0.5 * (target[0] + target[2]) - middle, 0.5 * (source[2] - source[0])
    place = (middle + shift - half, source[1], middle + shift + half, source[3])
    cleared = (min(place[0], target[0]), source[1], max(place[2], target[2]), source[3])
    sign, start = (-1.0, 2 * middle + shift) if mirrored else (1.0, shift)  # x becomes sign x + start
    faces = scene.faces.moved(scene.enu_from_town.T, np.zeros(3))  # in town axes
    face_at = _object_centers(faces)
    fixed = np.isin(faces.texture, [texture_index(t) for t in _GROUND_TEXTURES])
    kept, taken = fixed | ~_inside(face_at, cleared), ~fixed & _inside(face_at, source)
    copy = _moved(faces.take(taken), sign, start)
    patch = _ground_patch(scene.plan, source, shift, mirrored).shaded(scene.plan.to_sun)
    crowns = replace(scene.ellipsoids, center=scene.ellipsoids.center @ scene.enu_from_town)
    moved = _rows(crowns, _inside(crowns.center, source))
    at = moved.center * [sign, 1.0, 1.0] + [start, 0.0, 0.0]
    moved = replace(moved, center=at, object_id=moved.object_id + _ID_SHIFT)
    parts = (_rows(crowns, ~_inside(crowns.center, cleared)), moved)
    names = [field.name for field in fields(Ellipsoids)]
    trees = Ellipsoids(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
    houses = [b for b in scene.plan.buildings if not lies_in(cleared, b.x, b.y)]
    houses += [
        replace(b, x=sign * b.x + start, yaw_deg=180.0 - b.yaw_deg if mirrored else b.yaw_deg)
        for b in scene.plan.buildings
        if lies_in(source, b.x, b.y)
    ]
    all_faces = Faces.concatenate([faces.take(kept), copy, patch])
    return replace(
        scene,
        plan=replace(scene.plan, buildings=tuple(houses)),
        faces=all_faces.moved(scene.enu_from_town, np.zeros(3)),
        ellipsoids=replace(trees, center=trees.center @ scene.enu_from_town.T),
    )


def forged(scene: Scene, within: Rect, seed: int) -> Scene:
    """The scene as somebody wants it to be: of the buildings in a rectangle, half are moved by 2 to 6 m or
    wear another facade. Photos of it agree with each other, and not with the town.
    """
    rng = np.random.default_rng((seed, 71))
    faces = scene.faces.moved(scene.enu_from_town.T, np.zeros(3))
    origin, texture = faces.origin.copy(), faces.texture.copy()
    facades = [i for i, name in enumerate(TEXTURES) if name.startswith("facade")]
    is_building = (faces.object_id >= BUILDING_ID) & (faces.object_id < BUILDING_ID + 10_000)
    at = _object_centers(faces)
    for object_id in np.unique(faces.object_id[is_building & _inside(at, within)]):
        mine = is_building & (faces.object_id == object_id)
        angle, distance, fate = rng.uniform(0, 2 * np.pi), rng.uniform(2.0, 6.0), rng.random()
        other = int(rng.choice(facades))
        if fate < 0.3:
            origin[mine] += [distance * np.cos(angle), distance * np.sin(angle), 0.0]
        elif fate < 0.5:
            texture[mine & np.isin(texture, facades)] = other
    changed = replace(faces, origin=origin, texture=texture)
    return replace(scene, faces=changed.moved(scene.enu_from_town, np.zeros(3)))


def _inside(points: FloatArray, rect: Rect) -> NDArray[np.bool_]:
    x, y = points[:, 0], points[:, 1]
    return np.asarray((rect[0] <= x) & (x <= rect[2]) & (rect[1] <= y) & (y <= rect[3]))


def _object_centers(faces: Faces) -> FloatArray:
    """For each face, the mean (n, 3) of the centres of all faces of its object."""
    centers = faces.origin + 0.5 * (faces.edge_s + faces.edge_t)
    _, row = np.unique(faces.object_id, return_inverse=True)
    sums = np.zeros((row.max() + 1, 3))
    np.add.at(sums, row, centers)
    return np.asarray((sums / np.bincount(row)[:, None])[row])


def _rows(crowns: Ellipsoids, rows: NDArray[np.bool_]) -> Ellipsoids:
    return Ellipsoids(**{field.name: getattr(crowns, field.name)[rows] for field in fields(crowns)})


def _moved(faces: Faces, sign: float, start: float) -> Faces:
    """The faces of which x becomes sign x + start; mirrored ones with their edges exchanged, so that the
    outside stays outside, and the texture printed the wrong way round."""
    flip = np.array([sign, 1.0, 1.0])
    moved = replace(
        faces, origin=faces.origin * flip + [start, 0.0, 0.0], object_id=faces.object_id + _ID_SHIFT
    )
    if sign > 0:
        return moved
    edges = {"edge_s": faces.edge_t * flip, "edge_t": faces.edge_s * flip}
    return replace(moved, **edges, uv=faces.uv[:, [0, 1, 4, 5, 2, 3]])


def _ground_patch(plan: GroundPlan, source: Rect, shift: float, mirrored: bool) -> Faces:
    """The painted ground of the source laid over the target, strip by strip of the terrain."""
    x0, y0, x1, y1 = source
    w, h = plan.size
    knots = [y for y, _ in plan.profile if y0 < y < y1]
    parts = []
    for a, b in pairwise([y0, *knots, y1]):
        z0, z1 = float(plan.height(a)) + _PATCH_M, float(plan.height(b)) + _PATCH_M
        u, run = (x1, -(x1 - x0)) if mirrored else (x0, x1 - x0)
        start = (u + 0.5 * w, a + 0.5 * h)
        parts.append(
            face(
                (x0 + shift, a, z0),
                (x1 - x0, 0, 0),
                (0, b - a, z1 - z0),
                "ground",
                _ID_SHIFT,
                uv=(*start, run, 0.0, 0.0, b - a),
                detail=start,
            )
        )
    return Faces.concatenate(parts)
