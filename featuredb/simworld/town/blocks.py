"""Fills the blocks between a town's streets: terraces, houses, flats, a market hall, a park, a square."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from featuredb.simworld.town.materials import BAY_M, FACADE_LENGTH_M, STOREY_M
from featuredb.simworld.town.scene import Building, Faces
from featuredb.simworld.town.solids import box, car

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
