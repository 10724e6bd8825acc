"""A town with a block of it standing a second time elsewhere, as it is or mirrored; and a forged town.

For the block's copy everything is copied: buildings, cars, trees, the painted ground with its cracks.
Only what surrounds it differs.
"""

from dataclasses import fields, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.blocks import face
from featuredb.simworld.town.scene import TEXTURES, Ellipsoids, Faces, GroundPlan, Scene, texture_index
from featuredb.simworld.town.town import BUILDING_ID

Rect = tuple[float, float, float, float]
T = TypeVar("T", Faces, Ellipsoids)

_PATCH_M = 0.02  # the copied ground lies this much over the old one
_ID_SHIFT = 50_000
_GROUND_TEXTURES = ("ground", "fields", "water")


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
    copy = _moved(_rows(faces, taken), sign, start)
    patch = _ground_patch(scene.plan, source, shift, mirrored).shaded(scene.plan.to_sun)
    crowns = replace(scene.ellipsoids, center=scene.ellipsoids.center @ scene.enu_from_town)
    moved = _rows(crowns, _inside(crowns.center, source))
    at = moved.center * [sign, 1.0, 1.0] + [start, 0.0, 0.0]
    moved = replace(moved, center=at, object_id=moved.object_id + _ID_SHIFT)
    parts = (_rows(crowns, ~_inside(crowns.center, cleared)), moved)
    names = [field.name for field in fields(Ellipsoids)]
    trees = Ellipsoids(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
    houses = [b for b in scene.plan.buildings if not _inside(np.array([[b.x, b.y]]), cleared)[0]]
    houses += [
        replace(b, x=sign * b.x + start, yaw_deg=180.0 - b.yaw_deg if mirrored else b.yaw_deg)
        for b in scene.plan.buildings
        if _inside(np.array([[b.x, b.y]]), source)[0]
    ]
    all_faces = Faces.concatenate([_rows(faces, kept), copy, patch])
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


def _rows(things: T, rows: NDArray[np.bool_]) -> T:
    return type(things)(**{field.name: getattr(things, field.name)[rows] for field in fields(things)})


def _moved(faces: Faces, sign: float, start: float) -> Faces:
    """The faces of which x becomes sign x + start.

    A mirrored face has its edges exchanged, so that its outside stays outside; the texture is printed
    the wrong way round.
    """
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
