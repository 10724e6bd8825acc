"""Lays out a town by seed and places it on Earth."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.blocks import FILLINGS, Layout, box, face, house
from featuredb.simworld.town.ground import SIDEWALK_M
from featuredb.simworld.town.materials import FACADE_LENGTH_M, ROOF_LENGTH_M
from featuredb.simworld.town.scene import Building, Ellipsoids, Faces, GroundPlan, Scene, Street

# Upper Bavaria, 2.4 degrees east of zone 32's meridian: convergence 1.8 degrees.
TOWN_PLACE = (48.1374, 11.4162, 552.0, 32632)
# Central Chile, 1.6 degrees west of zone 19's meridian, southern hemisphere.
OTHER_TOWN_PLACE = (-33.4512, -70.6215, 611.0, 32719)

GROUND_ID, WATER_ID, BRIDGE_ID = 1, 2, 3
_OWN_SIDES = 8  # pieces of walls, from which on neighbouring walls of a house share none
_LAND_M = 1500.0  # how far the land goes on around the town
_ROAD_M = 6.5
BUILDING_ID, TREE_ID = 10_000, 20_000
WATER_LEVEL_M = -1.9


def make_town(
    seed: int,
    *,
    name: str = "town",
    size_m: tuple[float, float] = (380.0, 330.0),
    place: tuple[float, float, float, int] = TOWN_PLACE,
    texel_m: float = 0.06,
    pieces: int = 1,
) -> Scene:
    """A town of about `size_m` (east by north before it is turned), the same for the same arguments.

    Args:
        place: latitude and longitude in degrees, ellipsoidal height in metres of the local frame's
            origin, EPSG code of the UTM zone for answers.
        pieces: of walls and tiled roofs. With one, buildings of a material share every brick and curtain;
            with more, only those that are meant to be identical (terraces, slabs) do.

    Raises:
        InvalidValueError: a town too small for a river and two rows of blocks.
    """
    if min(size_m) < 150.0:
        raise InvalidValueError(f"make_town: expected a size of at least 150 m, found {size_m}")
    rng = np.random.default_rng((seed, 1))
    a = float(rng.uniform(np.radians(12), np.radians(33)))
    enu_from_town = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    plan, layout = _lay_out(seed, rng, size_m)
    if pieces > 1:
        plan = replace(plan, buildings=_individual(plan.buildings, seed, pieces))
    parts = [_ground_faces(plan), _water_and_bridges(plan), *layout.small]
    parts += [house(b, float(plan.height(b.y)), BUILDING_ID + i) for i, b in enumerate(plan.buildings)]
    parts += [_chimney(b, BUILDING_ID + i) for i, b in enumerate(plan.buildings) if b.ridge > 0]
    trunks, crowns = _trees(plan, rng, enu_from_town)
    faces = Faces.concatenate([*parts, trunks]).shaded(plan.to_sun).moved(enu_from_town, np.zeros(3))
    return Scene(
        name=name,
        seed=seed,
        frame=LocalFrame(latitude_deg=place[0], longitude_deg=place[1], height_m=place[2]),
        epsg=place[3],
        enu_from_town=enu_from_town,
        plan=plan,
        faces=faces,
        ellipsoids=crowns,
        texel_m=texel_m,
        pieces=pieces,
    )


def _individual(buildings: tuple[Building, ...], seed: int, pieces: int) -> tuple[Building, ...]:
    """Buildings with walls and roofs of their own; those that were identical stay so."""
    rng = np.random.default_rng((seed, 79))
    shift_of: dict[tuple[float, float, float], tuple[int, int]] = {}
    found = []
    for b in buildings:
        drawn = int(rng.integers(pieces)), int(rng.integers(pieces))
        wall, roof = shift_of.setdefault((b.facade_u, b.detail_u, b.roof_u), drawn)
        found.append(
            replace(
                b,
                facade_u=b.facade_u + FACADE_LENGTH_M * wall,
                roof_u=b.roof_u + ROOF_LENGTH_M * roof,
                back_u=FACADE_LENGTH_M * (pieces // 2),
                side_u=FACADE_LENGTH_M * (pieces // 4) if pieces >= _OWN_SIDES else b.side_u,
            )
        )
    return tuple(found)


def _lay_out(seed: int, rng: np.random.Generator, size: tuple[float, float]) -> tuple[GroundPlan, Layout]:
    """Streets, river, terrain, and what stands on the blocks."""
    w, h = size
    river = (-0.30 * h, -0.30 * h + 15.0)
    profile = (  # knots (y, height): flat, a river bed, then two slopes
        (-_LAND_M, 0.0),
        (river[0], 0.0),
        (river[0] + 4, -3.0),
        (river[1] - 4, -3.0),
        (river[1], 0.0),
        (0.0, 1.5),
        (0.25 * h, 6.5),
        (0.5 * h, 7.5),
        (_LAND_M, 8.5),
    )
    knots = np.asarray(profile)

    def height(y: float) -> float:
        return float(np.interp(y, knots[:, 0], knots[:, 1]))

    xs = _cuts(rng, -0.5 * w + 12, 0.5 * w - 12, (46.0, 64.0))
    ys = [-0.5 * h + 12, river[0] - 8, river[1] + 8]
    ys += _cuts(rng, river[1] + 8, 0.5 * h - 12, (42.0, 56.0))[1:]
    streets = [Street(along="x", at=y, start=-0.5 * w, end=0.5 * w, width=_ROAD_M) for y in ys]
    streets += [Street(along="y", at=x, start=-0.5 * h, end=0.5 * h, width=_ROAD_M) for x in xs]
    layout = Layout(rng=rng, height=height)
    edge = 0.5 * _ROAD_M + SIDEWALK_M + 0.5
    k = int(rng.integers(len(FILLINGS)))
    for y0, y1 in pairwise(ys):
        if y1 - y0 < 36:  # the river, or a strip too narrow
            continue
        for x0, x1 in pairwise(xs):
            FILLINGS[k % len(FILLINGS)](layout, (x0 + edge, y0 + edge, x1 - edge, y1 - edge))
            k += 1
        k += 3
    _along_streets(layout, streets, xs, ys)
    plan = GroundPlan(
        seed=seed,
        size=size,
        streets=tuple(streets),
        buildings=tuple(layout.buildings),
        plazas=tuple(layout.plazas),
        car_parks=tuple(layout.car_parks),
        gardens=tuple(layout.gardens),
        trees=tuple(layout.trees),
        profile=profile,
        river=river,
        to_sun=(-0.42, -0.52, 0.744),
    )
    return plan, layout


def _cuts(rng: np.random.Generator, low: float, high: float, step: tuple[float, float]) -> list[float]:
    """Places of streets from low to high, in steps drawn from the range, stretched to fit."""
    n = max(1, round((high - low) / (0.5 * sum(step))))
    steps = rng.uniform(*step, n)
    return [float(v) for v in low + np.concatenate([[0.0], np.cumsum(steps)]) * (high - low) / steps.sum()]


def _along_streets(layout: Layout, streets: list[Street], xs: list[float], ys: list[float]) -> None:
    """Parked cars, trees, lamps and bins beside the streets."""
    rng = layout.rng
    for s in streets:
        crossings = ys if s.along == "y" else xs
        half = 0.5 * s.width
        for a in np.arange(s.start + 8, s.end - 8, 6.2):
            if min(abs(a - c) for c in crossings) < 9 or (
                s.along == "y" and abs(a - 0.5 * (ys[1] + ys[2])) < 18
            ):
                continue
            kind, side = rng.random(), float(rng.choice([-1, 1]))

            def put(
                offset: float, a: float = float(a), side: float = side, s: Street = s
            ) -> tuple[float, float]:
                return (a, s.at + side * offset) if s.along == "x" else (s.at + side * offset, a)

            if kind < 0.33:
                layout.add_car(*put(half - 1.0), 0.0 if s.along == "x" else 90.0)
            elif kind < 0.55:
                layout.trees.append((*put(half + 1.4), float(rng.uniform(1.2, 2.2))))
            elif kind < 0.68:
                layout.add_box(*put(half + 0.5), (0.16, 0.16, 5.5), tint=(0.4, 0.42, 0.42))
            elif kind < 0.80:
                tint = tuple(float(c) for c in rng.uniform(0.3, 0.9, 3))
                layout.add_box(*put(half + 1.5), (1.1, 0.7, 1.1), texture="plain", tint=tint, detail=(a, 0.0))


def _ground_faces(plan: GroundPlan) -> Faces:
    """Planar strips between the terrain's knots: painted within the town, fields outside."""
    w, h = plan.size
    ys = sorted({y for y, _ in plan.profile} | {-0.5 * h, 0.5 * h})
    parts = []
    for y0, y1 in pairwise(ys):
        inside = y0 >= -0.5 * h and y1 <= 0.5 * h
        for x0, x1 in ((-_LAND_M, -0.5 * w), (-0.5 * w, 0.5 * w), (0.5 * w, _LAND_M)):
            painted = inside and x0 == -0.5 * w
            z0, z1 = float(plan.height(y0)), float(plan.height(y1))
            u, v = (x0 + 0.5 * w, y0 + 0.5 * h) if painted else (x0 + _LAND_M, y0 + _LAND_M)
            parts.append(
                face(
                    (x0, y0, z0),
                    (x1 - x0, 0, 0),
                    (0, y1 - y0, z1 - z0),
                    "ground" if painted else "fields",
                    GROUND_ID,
                    uv=(u, v, x1 - x0, 0.0, 0.0, y1 - y0),
                    detail=(u, v),
                )
            )
    return Faces.concatenate(parts)


def _water_and_bridges(plan: GroundPlan) -> Faces:
    w, h = plan.size
    y0, y1 = plan.river
    across, uv = (2 * _LAND_M, 0, 0), (0.0, 0.0, 2 * _LAND_M, 0.0, 0.0, y1 - y0)
    parts = [face((-_LAND_M, y0, WATER_LEVEL_M), across, (0, y1 - y0, 0), "water", WATER_ID, uv=uv)]
    for s in plan.streets:
        if s.along != "y":
            continue
        x0, x1 = s.at - 0.5 * s.width - SIDEWALK_M, s.at + 0.5 * s.width + SIDEWALK_M
        uv = (x0 + 0.5 * w, y0 - 1 + 0.5 * h, x1 - x0, 0.0, 0.0, y1 - y0 + 2)
        edges = (x1 - x0, 0, 0), (0, y1 - y0 + 2, 0)
        parts.append(face((x0, y0 - 1, 0.03), *edges, "ground", BRIDGE_ID, uv=uv, detail=uv[:2]))
        for x in (x0, x1):
            look = {"texture": "facade_stone", "top": "plain", "detail": (x, 0.0), "tint": (0.9, 0.88, 0.85)}
            parts.append(box(x, 0.5 * (y0 + y1), -1.0, (0.4, y1 - y0 + 2, 2.0), BRIDGE_ID, **look))  # type: ignore[arg-type]
    return Faces.concatenate(parts)


def _chimney(b: Building, object_id: int) -> Faces:
    """A chimney on the front slope, always at the same place of a house."""
    a = np.radians(b.yaw_deg)
    along, across = 0.27 * b.width, -0.12 * b.depth
    x = b.x + along * np.cos(a) - across * np.sin(a)
    y = b.y + along * np.sin(a) + across * np.cos(a)
    base, size, detail = b.eaves + 0.4 * b.ridge, (0.7, 0.7, 0.6 * b.ridge + 0.8), (b.roof_u, 1.0)
    return box(
        x, y, base, size, object_id, yaw_deg=b.yaw_deg, texture="roof_brown", top="plain", detail=detail
    )


def _trees(plan: GroundPlan, rng: np.random.Generator, enu_from_town: FloatArray) -> tuple[Faces, Ellipsoids]:
    """Trunks (town axes) and crowns of three balls each (local frame)."""
    trunks, centres, radii, tints, ids = [], [], [], [], []
    for i, (x, y, radius) in enumerate(plan.trees):
        ground = float(plan.height(y))
        trunks.append(
            box(x, y, ground - 0.1, (0.3, 0.3, 1.6 * radius), TREE_ID + i, texture="wood", detail=(x, y))
        )
        tint = rng.uniform(0.7, 1.15) * np.array([rng.uniform(0.8, 1.25), 1.0, rng.uniform(0.7, 1.0)])
        for _ in range(3):
            offset = rng.normal(0, 0.33, 3) * radius * [1, 1, 0.8]
            centres.append(enu_from_town @ (np.array([x, y, ground + 1.9 * radius]) + offset))
            radii.append(radius * rng.uniform(0.6, 0.95) * np.array([1, 1, rng.uniform(0.8, 1.2)]))
            tints.append(tint)
            ids.append(TREE_ID + i)
    n = len(centres)
    crowns = Ellipsoids(
        center=np.reshape(centres, (n, 3)),
        radii=np.reshape(radii, (n, 3)),
        tint=np.reshape(tints, (n, 3)),
        texture_uv=rng.uniform(0, 500, (n, 2)),
        object_id=np.array(ids, dtype=np.int32),
    )
    return Faces.concatenate(trunks), crowns
