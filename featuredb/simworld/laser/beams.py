"""Laser beams of one flight strip, and where they meet the faces and crowns of a scene: exact, in float64.

A strip's beams form a grid: one row per scan line, one column per angle. What a face covers in the grid
follows from its corners, so that a face costs a few array operations over its window, as in `raster.py`.

What comes back of each beam: leaves let part of the light through, edges split it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.town.scene import Ellipsoids, Faces

NOTHING = -1
_ROOF_OF_THE_WORLD = 0.95  # faces must stay below this share of the flying height


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beams:
    """Beams in flight axes: x along the track, y to the left of it, z up, metres; the track is y = 0.

    Attributes:
        x0, dx: the first scan line's start along the track, and the distance between scan lines. Within a
            line the aircraft moves on by one dx.
        height: of the track over z = 0.
        angles: (columns,) rad off the nadir, ascending, positive to the left.
        direction: (rows, columns, 3) unit vectors; they may differ from the angles by up to `sway` rad.
        sway: bound of the directions' deviation, rad.
    """

    x0: float
    dx: float
    height: float
    angles: FloatArray
    direction: FloatArray
    sway: float

    @property
    def shape(self) -> tuple[int, int]:
        return self.direction.shape[0], self.direction.shape[1]

    def start_x(self, rows: slice, columns: slice) -> FloatArray:
        """Along-track position (rows, columns) from which the beams leave; y is 0 and z the height."""
        row = np.arange(rows.start, rows.stop)[:, None]
        column = np.arange(columns.start, columns.stop)[None] / len(self.angles)
        return np.asarray(self.x0 + self.dx * (row + column), dtype=np.float64)

    def windows(self, corners: FloatArray) -> NDArray[np.int64]:
        """Windows (n, 4) row0, column0, row1, column1 of beams that may meet n boxes of corners (n, k, 3)."""
        drop = np.maximum(self.height - corners[..., 2], (1 - _ROOF_OF_THE_WORLD) * self.height)
        margin = np.tan(2 * self.sway) * drop
        across = np.arctan2(corners[..., 1], drop)
        first = np.searchsorted(self.angles, across.min(axis=1) - 2 * self.sway)
        last = np.searchsorted(self.angles, across.max(axis=1) + 2 * self.sway)
        low = np.floor(((corners[..., 0] - margin).min(axis=1) - self.x0) / self.dx) - 1
        high = np.ceil(((corners[..., 0] + margin).max(axis=1) - self.x0) / self.dx) + 1
        rows = self.shape[0]
        window = np.stack([low.clip(0, rows), first, high.clip(0, rows), last], axis=1)
        return np.asarray(window, dtype=np.int64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hits:
    """Where each beam meets the nearest face.

    Attributes:
        distance: (rows, columns) float64, metres along the beam, infinity where there is none.
        face: (rows, columns) int32, NOTHING where there is none.
    """

    distance: FloatArray
    face: NDArray[np.int32]


def hit_faces(beams: Beams, faces: Faces) -> Hits:
    """The first outside of a face on every beam; `faces` in flight axes."""
    normal = np.cross(faces.edge_s, faces.edge_t)
    square = np.einsum("ij,ij->i", normal, normal)
    # For a hit q from the face's origin: s = q . along_s, t = q . along_t.
    along_s = np.cross(faces.edge_t, normal) / square[:, None]
    along_t = np.cross(normal, faces.edge_s) / square[:, None]
    fourth = np.where(faces.triangle[:, None], faces.edge_t, faces.edge_s + faces.edge_t)
    corners = faces.origin[:, None] + np.stack(
        [np.zeros_like(fourth), faces.edge_s, fourth, faces.edge_t], axis=1
    )
    distance = np.full(beams.shape, np.inf)
    face = np.full(beams.shape, NOTHING, np.int32)
    for i, window in _windows(beams, corners):
        d = beams.direction[window]
        toward = d @ normal[i]
        start_x = beams.start_x(*window)
        offset = float(normal[i] @ faces.origin[i]) - normal[i, 2] * beams.height - normal[i, 0] * start_x
        r = offset / np.where(toward < 0, toward, -1.0)  # beams that see the inside are left out below
        q0 = start_x - faces.origin[i, 0]
        q1, q2 = -faces.origin[i, 1], beams.height - faces.origin[i, 2]
        s, t = (q0 * a[0] + (q1 * a[1] + q2 * a[2]) + r * (d @ a) for a in (along_s[i], along_t[i]))
        outer = s + t if faces.triangle[i] else np.maximum(s, t)
        seen = (toward < 0) & (r > 0) & (s >= 0) & (t >= 0) & (outer <= 1) & (r < distance[window])
        distance[window][seen] = r[seen]
        face[window][seen] = i
    return Hits(distance=distance, face=face)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossings:
    """Every passage of a beam through a crown.

    Attributes:
        beam: (n,) int64, row of the flattened grid of beams.
        enter, leave: (n,) metres along the beam.
        ellipsoid: (n,) int32.
    """

    beam: NDArray[np.int64]
    enter: FloatArray
    leave: FloatArray
    ellipsoid: NDArray[np.int32]


def cross_ellipsoids(beams: Beams, ellipsoids: Ellipsoids, center: FloatArray) -> Crossings:
    """All passages of beams through crowns.

    Args:
        center: (n, 3) of the ellipsoids in flight axes. Crowns are as wide as they are deep (their two
            horizontal radii are equal), so that turning about the vertical leaves the radii as they are.
    """
    radii = ellipsoids.radii
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    boxes = center[:, None] + signs[None] * radii[:, None]
    flat = np.arange(beams.shape[0] * beams.shape[1]).reshape(beams.shape)
    parts: list[tuple[NDArray[np.int64], FloatArray, FloatArray, NDArray[np.int32]]] = []
    for i, window in _windows(beams, boxes):
        d = beams.direction[window] / radii[i]
        start_x = (beams.start_x(*window) - center[i, 0]) / radii[i, 0]
        y, z = -center[i, 1] / radii[i, 1], (beams.height - center[i, 2]) / radii[i, 2]
        a = np.einsum("...i,...i->...", d, d)
        b = start_x * d[..., 0] + y * d[..., 1] + z * d[..., 2]
        discriminant = b * b - a * (start_x**2 + y * y + z * z - 1.0)
        hit = discriminant > 0
        if hit.any():
            a, b, root = a[hit], b[hit], np.sqrt(discriminant[hit])
            parts.append(
                (flat[window][hit], (-b - root) / a, (-b + root) / a, np.full(len(a), i, dtype=np.int32))
            )
    if not parts:
        empty = np.zeros(0)
        return Crossings(
            beam=empty.astype(np.int64), enter=empty, leave=empty, ellipsoid=empty.astype(np.int32)
        )
    beam, enter, leave, ellipsoid = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Crossings(beam=beam, enter=enter, leave=leave, ellipsoid=ellipsoid)


def _windows(beams: Beams, corners: FloatArray) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """Which of n primitives the strip may meet, with their windows in the grid."""
    window = beams.windows(corners)
    for i in np.flatnonzero((window[:, 0] < window[:, 2]) & (window[:, 1] < window[:, 3])):
        row0, column0, row1, column1 = window[i].tolist()
        yield int(i), (slice(row0, row1), slice(column0, column1))


RANGE_RESOLUTION_M = 0.6  # nearer echoes of one beam merge: 4 ns pulses
_FREE_PATH_M = 1.1  # mean way of a beam between two leaves or twigs that it notices
_LEAF_SHARE = 0.45  # of the light that is left goes to each of them
_EDGE_SHARE = 0.35  # of the footprint may lie on the far side of an edge
_MAX_RETURNS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Echoes:
    """Echoes of many beams, by beam and then by distance.

    Attributes:
        beam: (n,) int64, row of the flattened grid.
        distance: (n,) metres along the beam, without noise.
        energy: (n,) share of the beam's light that fell on what answers.
        face: (n,) int32 index of the face, NOTHING for leaves. ellipsoid: (n,) int32, NOTHING for faces.
    """

    beam: NDArray[np.int64]
    distance: FloatArray
    energy: FloatArray
    face: NDArray[np.int32]
    ellipsoid: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.beam)

    def take(self, rows: NDArray[np.bool_]) -> "Echoes":
        """The echoes of these rows."""
        return Echoes(**{name: getattr(self, name)[rows] for name in Echoes.__dataclass_fields__})


def echoes_of(hits: Hits, aside: Hits, crossings: Crossings, rng: np.random.Generator) -> Echoes:
    """Echoes of a strip.

    Leaves are met as a Poisson process along the way through crowns, so that crowns which overlap are denser.

    Args:
        hits: of the beams' axes. aside: of rays within the beams' footprints; where they meet something
            clearly nearer or farther, the beam has two echoes.
        crossings: of the axes through crowns.
    """
    leaves = _leaf_hits(crossings, hits, rng)
    first, second = hits.distance.ravel(), aside.distance.ravel()
    hit = np.flatnonzero(np.isfinite(first))
    split = np.isfinite(second) & (np.abs(second - first) > RANGE_RESOLUTION_M)
    edge = np.flatnonzero(split & np.isfinite(first))
    parts = [
        (leaves[0], leaves[1], np.ones(len(leaves[0])), np.full(len(leaves[0]), NOTHING), leaves[2]),
        (hit, first[hit], np.where(split[hit], 1 - _EDGE_SHARE, 1.0), hits.face.ravel()[hit], _none(hit)),
        (edge, second[edge], np.full(len(edge), _EDGE_SHARE), aside.face.ravel()[edge], _none(edge)),
    ]
    beam, distance, share, face, ellipsoid = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((distance, beam))
    beam, distance, share = beam[order], distance[order], share[order]
    is_leaf = ellipsoid[order] != NOTHING
    # What is left of the light after the leaves before: each takes its share.
    before = np.cumsum(is_leaf) - is_leaf
    before -= before[_first_of_run(beam)]
    left = (1.0 - _LEAF_SHARE) ** before
    echoes = Echoes(
        beam=beam,
        distance=distance,
        energy=left * np.where(is_leaf, _LEAF_SHARE, share),
        face=face[order].astype(np.int32),
        ellipsoid=ellipsoid[order].astype(np.int32),
    )
    return echoes.take(_resolved(echoes))


def return_numbers(beam: NDArray[np.int64]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return number and number of returns (n,) of echoes that are ordered by beam, counted from 1."""
    first = _first_of_run(beam)
    number = np.arange(len(beam)) - first + 1
    _, count = np.unique(beam, return_counts=True)
    return number.astype(np.uint8), np.repeat(count, count).astype(np.uint8)


def _none(like: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.full(len(like), NOTHING)


def _leaf_hits(
    crossings: Crossings, hits: Hits, rng: np.random.Generator
) -> tuple[NDArray[np.int64], FloatArray, NDArray[np.int32]]:
    """Beam, distance and ellipsoid of what is met inside crowns, before anything hard."""
    count = rng.poisson((crossings.leave - crossings.enter) / _FREE_PATH_M)
    beam = np.repeat(crossings.beam, count)
    enter, leave = np.repeat(crossings.enter, count), np.repeat(crossings.leave, count)
    distance = enter + (leave - enter) * rng.random(len(beam))
    ahead = distance < hits.distance.ravel()[beam]
    return beam[ahead], distance[ahead], np.repeat(crossings.ellipsoid, count)[ahead]


def _first_of_run(beam: NDArray[np.int64]) -> NDArray[np.int64]:
    """Row of the first element of each element's run of equal values."""
    starts = np.concatenate([[True], beam[1:] != beam[:-1]]) if len(beam) else np.zeros(0, bool)
    return np.maximum.accumulate(np.where(starts, np.arange(len(beam)), 0))


def _resolved(echoes: Echoes) -> NDArray[np.bool_]:
    """Which echoes the receiver tells apart: far enough behind the one kept before, and not too many."""
    keep = np.ones(len(echoes), dtype=bool)
    first = _first_of_run(echoes.beam)
    rank = np.arange(len(echoes)) - first
    last = np.full(len(echoes), -np.inf)  # by run, at its first row: distance of the last echo kept
    kept = np.zeros(len(echoes), dtype=np.int64)
    for k in range(int(rank.max()) + 1 if len(rank) else 0):
        rows = np.flatnonzero(rank == k)
        run = first[rows]
        good = (echoes.distance[rows] - last[run] > RANGE_RESOLUTION_M) & (kept[run] < _MAX_RETURNS)
        keep[rows] = good
        last[run[good]] = echoes.distance[rows[good]]
        kept[run[good]] += 1
    return keep
