"""Compiled loops that order points into levels of detail; import through `compiled_module`."""

import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled

Int64 = NDArray[np.int64]

# In a cell that tells a point's spacing: fewer make it uncertain by more than a third, more blur the step
# from a dense roof to a sparse wall.
_NEIGHBOURS = 8


@compiled
def _spread(value: int) -> int:
    """The 21 bits of a number moved apart, with two zero bits between them."""
    v = value & 0x1FFFFF
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@compiled
def morton_codes(xyz: NDArray[np.float32], origin: NDArray[np.float64], cell_m: float) -> Int64:
    """(n,) int64 Morton codes of the cells of edge cell_m that hold the points; 21 bits per axis."""
    codes = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        x = int((xyz[i, 0] - origin[0]) / cell_m)
        y = int((xyz[i, 1] - origin[1]) / cell_m)
        z = int((xyz[i, 2] - origin[2]) / cell_m)
        codes[i] = _spread(x) | (_spread(y) << 1) | (_spread(z) << 2)
    return codes


@compiled
def occupied(codes: Int64, shift: int) -> int:
    """How many cells of 2^(shift / 3) edges hold sorted codes."""
    n, last = 0, -1
    for i in range(len(codes)):
        cell = codes[i] >> shift
        if cell != last:
            n += 1
            last = cell
    return n


@compiled
def assign_levels(
    xyz: NDArray[np.float32], codes: Int64, origin: NDArray[np.float64], cell_m: float, finest: int
) -> NDArray[np.uint8]:
    """(n,) level of each point of a cloud sorted by code: one in each cell of a level, the rest finest.

    Of each cell that no coarser level has a point in, the point nearest to its centre is taken.
    """
    level = np.full(len(codes), finest, np.uint8)
    for current in range(finest):
        shift = 3 * (finest - current)
        edge = cell_m * 2.0 ** (finest - current)
        first = 0
        while first < len(codes):
            cell = codes[first] >> shift
            end, taken = first, False
            while end < len(codes) and codes[end] >> shift == cell:
                taken = taken or level[end] < current
                end += 1
            if not taken:
                level[_most_central(xyz, first, end, origin, edge)] = current
            first = end
    return level


@compiled
def _most_central(
    xyz: NDArray[np.float32], first: int, end: int, origin: NDArray[np.float64], edge: float
) -> int:
    best, best_d2 = first, np.inf
    for i in range(first, end):
        d2 = 0.0
        for a in range(3):
            f = (xyz[i, a] - origin[a]) / edge
            d2 += (f - np.floor(f) - 0.5) ** 2
        if d2 < best_d2:
            best, best_d2 = i, d2
    return best


@compiled
def node_runs(
    codes: Int64, level: NDArray[np.uint8], current: int, finest: int, cell_bits: int, cell_m: float
) -> tuple[Int64, NDArray[np.float32]]:
    """Nodes of one level: how many of its points lie in each, and the spacing of all points up to that level.

    A node is a cell of 2^cell_bits spacings of its level that holds a point of the level. Its spacing is
    that of points spread evenly over as many squares, four spacings wide, as have a point in them.
    """
    cell_shift = 3 * (finest - current + cell_bits)
    probe_shift = 3 * (finest - current + 2)
    probe_m = cell_m * 2.0 ** (finest - current + 2)
    count, spacing = [], []
    first = 0
    while first < len(codes):
        cell = codes[first] >> cell_shift
        end, own, drawn, probes, last = first, 0, 0, 0, -1
        while end < len(codes) and codes[end] >> cell_shift == cell:
            if level[end] <= current:
                drawn += 1
                own += level[end] == current
                probe = codes[end] >> probe_shift
                probes += probe != last
                last = probe
            end += 1
        if own:
            count.append(own)
            spacing.append(probe_m * np.sqrt(probes / drawn))
        first = end
    return np.array(count, dtype=np.int64), np.array(spacing, dtype=np.float32)


@compiled
def spacing_of_codes(codes: Int64, cell_m: float) -> NDArray[np.float32]:
    """(n,) metres between neighbours, for points sorted by code.

    Each point takes the smallest cell around it that holds `_NEIGHBOURS` points, as if they lay on a surface
    through it. Points without so many around them keep the widest spacing.
    """
    spacing = np.zeros(len(codes), np.float32)
    for level in range(21):
        edge = cell_m * 2.0**level
        first, open_points = 0, False
        while first < len(codes):
            cell = codes[first] >> (3 * level)
            end = first
            while end < len(codes) and codes[end] >> (3 * level) == cell:
                end += 1
            value = edge / np.sqrt(end - first)
            if end - first >= _NEIGHBOURS or level == 20:
                for i in range(first, end):
                    if spacing[i] == 0.0:
                        spacing[i] = value
            else:
                open_points = True
            first = end
        if not open_points:
            break
    return spacing
