"""Fills the blocks between a town's streets: terraces, houses, flats, a market hall, a park, a square."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.materials import BAY_M, FACADE_LENGTH_M, STOREY_M
from featuredb.simworld.town.scene import Building, Faces, texture_index

White = (1.0, 1.0, 1.0)


def face(
    origin: ArrayLike,
    edge_s: ArrayLike,
    edge_t: ArrayLike,
    texture: str,
    object_id: int,
    *,
    uv: Sequence[float] | None = None,
    detail: tuple[float, float] | None = None,
    tint: Sequence[float] = White,
    triangle: bool = False,
) -> Faces:
    """One face; without `uv` the texture lies along the edges in metres, starting at `detail`."""
    s, t = np.asarray(edge_s, dtype=np.float64), np.asarray(edge_t, dtype=np.float64)
    start = detail or (0.0, 0.0)
    coordinates = uv if uv is not None else (*start, np.linalg.norm(s), 0.0, 0.0, np.linalg.norm(t))
    return Faces(
        origin=np.asarray(origin, dtype=np.float64)[None],
        edge_s=s[None],
        edge_t=t[None],
        triangle=np.array([triangle]),
        texture=np.array([texture_index(texture)]),
        uv=np.array([coordinates]),
        detail_uv=np.array([detail if detail is not None else (np.nan, np.nan)]),
        tint=np.array([tint]),
        object_id=np.array([object_id]),
    )


def box(
    x: float,
    y: float,
    base: float,
    size: tuple[float, float, float],
    object_id: int,
    *,
    yaw_deg: float = 0.0,
    texture: str = "plain",
    top: str | None = None,
    detail: tuple[float, float] | None = None,
    tint: Sequence[float] = White,
) -> Faces:
    """A box standing on `base` with size (along its own x, its own y, up): four walls and a top."""
    a = np.radians(yaw_deg)
    ex, ey = np.array([np.cos(a), np.sin(a), 0.0]), np.array([-np.sin(a), np.cos(a), 0.0])
    corner = np.array([x, y, base]) - 0.5 * size[0] * ex - 0.5 * size[1] * ey
    footprint = [corner, corner + size[0] * ex, corner + size[0] * ex + size[1] * ey, corner + size[1] * ey]
    up = np.array([0.0, 0.0, size[2]])
    parts = []
    for i in range(4):
        # Each wall cuts another piece from its texture.
        start = None if detail is None else (detail[0] + 3.1 * i, detail[1])
        edge = footprint[(i + 1) % 4] - footprint[i]
        parts.append(face(footprint[i], edge, up, texture, object_id, detail=start, tint=tint))
    parts.append(
        face(corner + up, size[0] * ex, size[1] * ey, top or texture, object_id, detail=detail, tint=tint)
    )
    return Faces.concatenate(parts)


def house(building: Building, ground: float, object_id: int) -> Faces:
    """Walls and roof of a building; v = 0 of the facade texture lies at `ground`, the height at its door."""
    b = building
    corners = np.column_stack([b.footprint(), np.full(4, b.base)])
    parts = []
    for i in range(4):
        edge = corners[(i + 1) % 4] - corners[i]
        length, height = float(np.linalg.norm(edge)), b.eaves - b.base
        # Opposite walls look alike unless the building says otherwise, neighbouring ones do not.
        u = b.facade_u + (0.0 if i % 2 == 0 else b.side_u) + (b.back_u if i >= 2 else 0.0)
        uv = (u, b.base - ground, length, 0.0, 0.0, height)
        detail = (b.detail_u + 14.3 * i, 0.37 * b.detail_u)
        parts.append(
            face(corners[i], edge, (0, 0, height), b.facade, object_id, uv=uv, detail=detail, tint=b.tint)
        )
    top = corners + np.array([0.0, 0.0, b.eaves - b.base])
    parts.append(
        face(top[0], top[1] - top[0], top[3] - top[0], b.roof, object_id, detail=(b.roof_u, 0.61 * b.roof_u))
        if b.ridge <= 0
        else _gabled_roof(b, top, ground, object_id)
    )
    return Faces.concatenate(parts)


def _gabled_roof(b: Building, top: FloatArray, ground: float, object_id: int) -> Faces:
    """Two slopes with the ridge along the width, and the two gables."""
    up = np.array([0.0, 0.0, b.ridge])
    ridge0, ridge1 = 0.5 * (top[0] + top[3]) + up, 0.5 * (top[1] + top[2]) + up
    along = top[1] - top[0]
    parts = []
    for start, edge, rise, shift in (
        (top[0], along, ridge0 - top[0], 0.0),
        (top[2], -along, ridge1 - top[2], 7.7 + b.back_u),
    ):
        detail = (b.roof_u + shift, 0.43 * b.roof_u + shift)
        parts.append(face(start, edge, rise, b.roof, object_id, detail=detail))
    for start, end, apex, shift in ((top[1], top[2], ridge1, 1), (top[3], top[0], ridge0, 3)):
        edge = end - start
        u, v = b.facade_u + b.side_u + (b.back_u if shift == 3 else 0.0), b.eaves - ground
        length = float(np.linalg.norm(edge))
        parts.append(
            face(
                start,
                edge,
                apex - start,
                b.facade,
                object_id,
                uv=(u, v, length, 0.0, 0.5 * length, b.ridge),
                detail=(b.detail_u + 14.3 * shift, 0.37 * b.detail_u + v),
                tint=b.tint,
                triangle=True,
            )
        )
    return Faces.concatenate(parts)


def car(x: float, y: float, base: float, yaw_deg: float, tint: Sequence[float], object_id: int) -> Faces:
    """A car of 4.4 x 1.8 x 1.45 m: body and cabin."""
    paint = partial(box, x, y, object_id=object_id, yaw_deg=yaw_deg, texture="car")
    body = paint(base + 0.2, (4.4, 1.8, 0.65), tint=tint, detail=(0, 0))
    cabin = paint(base + 0.85, (2.3, 1.6, 0.6), tint=tuple(0.35 * t for t in tint))
    a = np.radians(yaw_deg)
    top = np.array([np.cos(a), np.sin(a), 0.0]), np.array([-np.sin(a), np.cos(a), 0.0])
    corner = np.array([x, y, base + 1.46]) - 0.9 * top[0] - 0.75 * top[1]
    lid = face(corner, 1.8 * top[0], 1.5 * top[1], "car", object_id, tint=tint)
    return Faces.concatenate([body, cabin, lid])


Rect = tuple[float, float, float, float]

_CAR_COLOURS = (
    (0.95, 0.95, 0.95),
    (0.25, 0.25, 0.27),
    (0.6, 0.6, 0.62),
    (0.75, 0.15, 0.12),
    (0.15, 0.25, 0.6),
    (0.2, 0.4, 0.25),
)
_HOUSE_FACADES = ("facade_brick", "facade_plaster", "facade_ochre", "facade_stone")
_TILED_ROOFS = ("roof_red", "roof_brown", "roof_slate")


@dataclass(slots=True, kw_only=True)
class Layout:
    """What the blocks collect, in town axes."""

    rng: np.random.Generator
    height: Callable[[float], float]
    buildings: list[Building] = field(default_factory=list)
    small: list[Faces] = field(default_factory=list)
    trees: list[tuple[float, float, float]] = field(default_factory=list)
    plazas: list[Rect] = field(default_factory=list)
    car_parks: list[Rect] = field(default_factory=list)
    gardens: list[Rect] = field(default_factory=list)
    next_id: int = 1000

    def new_id(self) -> int:
        self.next_id += 1
        return self.next_id

    def add_box(self, x: float, y: float, size: tuple[float, float, float], **look: object) -> None:
        """A box on the ground."""
        self.small.append(box(x, y, self.height(y) - 0.1, size, self.new_id(), **look))  # type: ignore[arg-type]

    def add_car(self, x: float, y: float, yaw_deg: float) -> None:
        tint = _CAR_COLOURS[int(self.rng.integers(len(_CAR_COLOURS)))]
        self.small.append(car(x, y, self.height(y), yaw_deg, tint, self.new_id()))

    def add_building(
        self,
        x: float,
        y: float,
        size: tuple[float, float],
        storeys: float,
        *,
        look: tuple[float, float, float] | None = None,
        **more: Any,
    ) -> Building:
        """A building on the terrain; `look` (facade, detail, roof offsets) is shared by identical ones."""
        if look is None:
            bay = BAY_M * float(self.rng.integers(0, int(FACADE_LENGTH_M / BAY_M)))
            look = (bay, float(self.rng.uniform(0, 500)), float(self.rng.uniform(0, 500)))
        more |= {
            "facade_u": look[0],
            "detail_u": look[1],
            "roof_u": look[2],
            "width": size[0],
            "depth": size[1],
        }
        probe = Building(x=x, y=y, base=0, eaves=1, **more)
        grounds = [self.height(float(corner[1])) for corner in probe.footprint()]
        building = replace(probe, base=min(grounds) - 0.3, eaves=max(grounds) + storeys * STOREY_M)
        self.buildings.append(building)
        return building


def terraces(layout: Layout, rect: Rect) -> None:
    """Two rows of exactly identical houses, back to back with gardens between."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    facade, roof = str(rng.choice(_HOUSE_FACADES[:3])), str(rng.choice(_TILED_ROOFS))
    look = (BAY_M * float(rng.integers(0, 6)), float(rng.uniform(0, 500)), float(rng.uniform(0, 500)))
    n = int((x1 - x0 - 2) // 6.0)
    start = 0.5 * (x0 + x1) - 0.5 * 6.0 * n
    layout.gardens.append((x0 + 1, y0 + 10, x1 - 1, y1 - 10))
    for row_y, yaw in ((y0 + 5.5, 0.0), (y1 - 5.5, 180.0)):
        for i in range(n):
            x = start + 6.0 * (i + 0.5)
            layout.add_building(
                x, row_y, (6.0, 9.0), 2, yaw_deg=yaw, ridge=3.4, facade=facade, roof=roof, look=look
            )
    for i in range(n):  # sheds and fences between the gardens
        x = start + 6.0 * i
        layout.add_box(
            x, 0.5 * (y0 + y1), (0.12, max(2.0, y1 - y0 - 21), 1.5), texture="wood", detail=(x, y0)
        )
        if rng.random() < 0.6:
            layout.add_box(
                x + 1.6, 0.5 * (y0 + y1) + rng.uniform(-3, 3), (2.2, 1.8, 2.1), texture="wood", detail=(x, 0)
            )
        if rng.random() < 0.4:
            layout.trees.append(
                (x + 4.2, 0.5 * (y0 + y1) + float(rng.uniform(-2, 2)), float(rng.uniform(1.0, 1.9)))
            )


def detached(layout: Layout, rect: Rect) -> None:
    """Houses of all kinds, each turned a little, with trees and a car."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    for x in np.arange(x0 + 8, x1 - 7, 16.5):
        for y in np.arange(y0 + 8, y1 - 7, 16.0):
            size = (float(rng.choice([9.0, 12.0])), float(rng.uniform(7.5, 9.5)))
            layout.add_building(
                x + float(rng.uniform(-1, 1)),
                y + float(rng.uniform(-1, 1)),
                size,
                float(rng.choice([1.2, 2.0])),
                yaw_deg=float(rng.choice([0, 90, 180]) + rng.uniform(-9, 9)),
                ridge=float(rng.uniform(2.4, 4.0)),
                facade=str(rng.choice(_HOUSE_FACADES)),
                roof=str(rng.choice(_TILED_ROOFS)),
                tint=_paint(rng),
            )
            layout.trees.append((x + 7.2, y + 6.8, float(rng.uniform(1.4, 2.6))))
            if rng.random() < 0.5:
                layout.add_box(x - 7.2, y + 6.5, (1.6, 1.2, 1.0), texture="wood", detail=(x, y))
            if rng.random() < 0.5:
                layout.add_car(x + 7.6, y - 2.0, 90.0)


def flats(layout: Layout, rect: Rect) -> None:
    """Slabs of flats, all the same, with flat roofs and machines on them."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    look = (0.0, float(rng.uniform(0, 500)), float(rng.uniform(0, 500)))
    length = BAY_M * int((x1 - x0 - 8) // BAY_M)
    storeys = int(rng.integers(3, 6))
    for y in np.arange(y0 + 8, y1 - 7, 21.0):
        b = layout.add_building(
            0.5 * (x0 + x1), y, (length, 12.0), storeys, facade="facade_panel", roof="roof_bitumen", look=look
        )
        _roof_machines(layout, b, 7)
        for x in np.arange(x0 + 5, x1 - 5, 9.0):
            if y + 10.5 < y1 and rng.random() < 0.7:
                layout.trees.append((x, y + 10.5, float(rng.uniform(1.5, 2.6))))


def market(layout: Layout, rect: Rect) -> None:
    """A hall with a metal roof and its car park."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    middle = y0 + 0.52 * (y1 - y0)
    b = layout.add_building(
        0.5 * (x0 + x1),
        0.5 * (middle + y1),
        (BAY_M * int((x1 - x0 - 6) // BAY_M), y1 - middle - 5),
        2.0,
        facade="facade_panel",
        roof="roof_metal",
        tint=(0.95, 0.9, 0.75),
    )
    _roof_machines(layout, b, 4)
    park = (x0 + 1, y0 + 1, x1 - 1, middle - 1.5)
    layout.car_parks.append(park)
    for x in np.arange(park[0] + 2.3, park[2] - 2.5, 2.5):
        for y in np.arange(park[1] + 2.6, park[3] - 2.4, 5.5):
            if rng.random() < 0.4:
                layout.add_car(x, y, 90.0 + float(rng.uniform(-3, 3)))


def park(layout: Layout, rect: Rect) -> None:
    """Lawn, trees, benches, a pavilion."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    layout.plazas.append((0.5 * (x0 + x1) - 1.2, y0, 0.5 * (x0 + x1) + 1.2, y1))
    layout.plazas.append((x0, 0.5 * (y0 + y1) - 1.2, x1, 0.5 * (y0 + y1) + 1.2))
    layout.gardens.append((x0 + 4, y0 + 4, x0 + 12, y0 + 9))
    for _ in range(int((x1 - x0) * (y1 - y0) / 110)):
        x, y = float(rng.uniform(x0 + 2, x1 - 2)), float(rng.uniform(y0 + 2, y1 - 2))
        if min(abs(x - 0.5 * (x0 + x1)), abs(y - 0.5 * (y0 + y1))) > 3.5:
            layout.trees.append((x, y, float(rng.uniform(1.3, 3.2))))
    for x in np.arange(x0 + 4, x1 - 3, 7.0):
        layout.add_box(x, 0.5 * (y0 + y1) + 2.0, (1.8, 0.6, 0.6), texture="wood", detail=(x, 0.0))
    x, y = 0.5 * (x0 + x1) + 8, 0.5 * (y0 + y1) + 8
    layout.add_building(x, y, (6, 6), 1.2, yaw_deg=20, ridge=2.0, facade="facade_stone", roof="roof_slate")


def square(layout: Layout, rect: Rect) -> None:
    """A paved square with a church, stalls and town houses round it."""
    x0, y0, x1, y1 = rect
    rng = layout.rng
    layout.plazas.append((x0, y0, x1, y1))
    cx, cy = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    layout.add_building(cx + 3, cy + 5, (18, 10), 2.8, ridge=6.0, facade="facade_stone", roof="roof_slate")
    layout.add_building(cx - 9.2, cy + 5, (6, 6), 6.5, ridge=5.0, facade="facade_stone", roof="roof_slate")
    for x in np.arange(x0 + 7, x1 - 6, 12.2):
        layout.add_building(
            x,
            y1 - 5.0,
            (12.0, 8.0),
            float(rng.choice([3, 4])),
            ridge=float(rng.uniform(2.5, 4)),
            facade=str(rng.choice(_HOUSE_FACADES)),
            roof=str(rng.choice(_TILED_ROOFS)),
            tint=_paint(rng),
        )
    for x in np.arange(x0 + 4, x1 - 3, 5.0):
        for y in (y0 + 4.0, y0 + 9.5):
            if rng.random() < 0.75:
                colour = tuple(float(c) for c in rng.uniform(0.35, 1.1, 3))
                layout.add_box(
                    x + float(rng.uniform(-0.6, 0.6)),
                    y,
                    (2.6, 2.0, 2.3),
                    yaw_deg=float(rng.uniform(-12, 12)),
                    texture="wood",
                    top="plain",
                    detail=(x, y),
                    tint=colour,
                )


FILLINGS: tuple[Callable[[Layout, Rect], None], ...] = (
    terraces,
    square,
    flats,
    detached,
    market,
    park,
    terraces,
    detached,
)


def _paint(rng: np.random.Generator) -> tuple[float, float, float]:
    r, g, b = rng.uniform(0.82, 1.08, 3)
    return float(r), float(g), float(b)


def _roof_machines(layout: Layout, b: Building, n: int) -> None:
    """Boxes on a flat roof: what breaks its sameness."""
    for _ in range(n):
        x = b.x + float(layout.rng.uniform(-0.42, 0.42)) * b.width
        y = b.y + float(layout.rng.uniform(-0.36, 0.36)) * b.depth
        size = tuple(layout.rng.uniform([0.8, 0.8, 0.5], [2.6, 2.0, 1.6]).tolist())
        layout.small.append(
            box(x, y, b.eaves, size, layout.new_id(), texture="plain", detail=(x, y), tint=(0.8,) * 3)
        )
