"""Levels of detail for any cloud: a permutation, nodes that hold what they say, levels with their spacing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial import cKDTree

from featuredb.geo.local_frame import LocalFrame
from featuredb.render.cloud import point_spacing
from tests.support.clouds import build_cloud

FRAME = LocalFrame(latitude_deg=-33.0, longitude_deg=151.0, height_m=20.0)


@settings(deadline=None, max_examples=40)
@given(
    npst.arrays(
        np.float32,
        st.tuples(st.integers(1, 300), st.just(3)),
        elements=st.floats(-500, 500, width=32),
    )
)
def test_levels_are_a_permutation_and_nodes_hold_their_points(xyz: np.ndarray) -> None:  # type: ignore[type-arg]
    number = np.arange(len(xyz))
    cloud = build_cloud(
        FRAME,
        "unknown",
        xyz,
        rgb=np.column_stack([number & 255, number >> 8, 0 * number]).astype(np.uint8),
    )
    assert cloud.rgb is not None
    rows = cloud.rgb[:, 0].astype(int) + 256 * cloud.rgb[:, 1].astype(int)
    assert np.array_equal(np.sort(rows), number)
    assert np.array_equal(cloud.xyz, xyz[rows])
    nodes = cloud.nodes
    owner = np.repeat(np.arange(len(nodes)), nodes.count)
    assert (cloud.xyz >= nodes.box_min[owner]).all()
    assert (cloud.xyz <= nodes.box_max[owner]).all()
    assert (np.diff(nodes.level) >= 0).all()
    assert cloud.spacing_m is not None
    assert (cloud.spacing_m > 0).all()


def test_each_level_halves_the_spacing() -> None:
    """Drawing levels 0..l leaves no place on a surface further from a point than its spacing tells."""
    rng = np.random.default_rng(2)
    xy = rng.uniform(0, 40, (40_000, 2))
    cloud = build_cloud(
        FRAME,
        "unknown",
        np.column_stack([xy, np.sin(xy[:, 0] / 5)]),
    )
    nodes = cloud.nodes
    level = np.repeat(nodes.level, nodes.count)
    places = np.column_stack([*rng.uniform(2, 38, (2, 3000)), np.zeros(3000)])
    places[:, 2] = np.sin(places[:, 0] / 5)
    previous = np.inf
    for current in range(int(nodes.level.max()) + 1):
        spacing = float(np.median(nodes.spacing_m[nodes.level == current]))
        distance, _ = cKDTree(cloud.xyz[level <= current]).query(places)
        assert np.quantile(distance, 0.95) < 1.2 * spacing
        assert np.median(distance) > 0.2 * spacing
        assert spacing < 0.75 * previous
        previous = spacing


@pytest.mark.parametrize("step", [0.1, 0.7, 3.0])
def test_point_spacing_is_that_of_the_surface(step: float) -> None:
    """A dense floor and a wall with four times the spacing: each point knows its own."""
    rng = np.random.default_rng(4)
    n, m = 20_000, 1250
    side = step * np.sqrt(n)
    floor = np.column_stack([*rng.uniform(0, side, (2, n)), np.zeros(n)])
    wall = np.column_stack([np.full(m, 0.5 * side), *rng.uniform(0.1 * side, side, (2, m))])
    spacing = point_spacing(np.concatenate([floor, wall]))
    assert np.median(spacing[:n]) == pytest.approx(step, rel=0.2)
    assert np.median(spacing[n:]) == pytest.approx(0.9 * 4 * step, rel=0.3)
