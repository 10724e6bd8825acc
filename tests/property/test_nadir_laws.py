"""Laws of the view from straight above."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.geometry.arrays import FloatArray
from featuredb.lidar.ortho import GAP_M, SPLAT_SPACINGS, STEP_M, seen_from_above

SPACING_M = 0.4


def scene(seed: int) -> FloatArray:
    """Ground, a few boxes and crowns, scattered points between."""
    rng = np.random.default_rng(seed)
    xyz = np.column_stack([rng.uniform(0, 20, (3000, 2)), rng.normal(0, 0.02, 3000)])
    for _ in range(4):
        x, y, size, height = rng.uniform(2, 18), rng.uniform(2, 18), rng.uniform(1, 4), rng.uniform(0.5, 9)
        on = (np.abs(xyz[:, :2] - [x, y]) < size).all(axis=1) & (rng.random(len(xyz)) < 0.7)
        xyz[on, 2] = height
    return xyz


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000))
def test_the_highest_point_around_is_seen(seed: int) -> None:
    xyz = scene(seed)
    seen = seen_from_above(xyz, SPACING_M)
    assert seen[xyz[:, 2].argmax()]
    # Whatever is hidden has something above it within the reach of a splat or a gap.
    reach = GAP_M + 2 * SPLAT_SPACINGS * SPACING_M
    for i in np.flatnonzero(~seen)[:20]:
        near = np.hypot(*(xyz[:, :2] - xyz[i, :2]).T) < reach * np.sqrt(2)
        assert xyz[near, 2].max() > xyz[i, 2] + STEP_M


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.integers(0, 10_000))
def test_what_is_below_everything_hides_nothing(seed: int, other: int) -> None:
    xyz = scene(seed)
    cellar = np.column_stack([np.random.default_rng(other).uniform(0, 20, (500, 2)), np.full(500, -4.0)])
    # The corners stay, so that the cells lie as before.
    frame = np.array([[0.0, 0.0, -4.0], [20.0, 20.0, -4.0]])
    before = seen_from_above(np.concatenate([xyz, frame]), SPACING_M)[: len(xyz)]
    after = seen_from_above(np.concatenate([xyz, frame, cellar]), SPACING_M)[: len(xyz)]
    assert not (before & ~after).any()


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.integers(-500, 500), st.integers(-500, 500), st.floats(-100, 3000))
def test_the_view_does_not_depend_on_where_the_scene_is(seed: int, east: int, north: int, up: float) -> None:
    xyz = scene(seed)
    moved = xyz + np.array([680_000.0 + east, 5_334_000.0 + north, float(round(up))])
    same = seen_from_above(moved, SPACING_M) == seen_from_above(xyz, SPACING_M)
    # Coordinates are kept to float32 within a tile: a point at a limit may fall to the other side.
    assert same.mean() > 0.999
