"""Faces of simple solids: boxes, houses, walls. All functions are pure and give `Faces` in town axes."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from featuredb.geometry.arrays import FloatArray
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
    parts.append(_flat_roof(b, top, object_id) if b.ridge <= 0 else _gabled_roof(b, top, ground, object_id))
    return Faces.concatenate(parts)


def _flat_roof(b: Building, top: FloatArray, object_id: int) -> Faces:
    detail = (b.roof_u, 0.61 * b.roof_u)
    return face(top[0], top[1] - top[0], top[3] - top[0], b.roof, object_id, detail=detail)


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
