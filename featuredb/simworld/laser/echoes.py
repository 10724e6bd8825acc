"""What comes back of each laser beam: leaves let part of the light through, edges split it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.simworld.laser.beams import NOTHING, Crossings, Hits

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
