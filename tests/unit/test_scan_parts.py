"""Parts of adding a scan, without files: outliers, intensities, levels, frames of millions of points."""

import numpy as np
from scipy.spatial.distance import cdist

from featuredb.lidar.clean import (
    COARSEST_SPACING_M,
    OutlierOptions,
    find_outliers,
    finest_level,
    order_by_level,
    outlier_ratio,
)
from featuredb.lidar.spill import stretch_of
from tests.support.las_files import grid_points


def ground_with_strays(seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A surface of half a metre's spacing and 40 points astray: alone, in pairs, high and low."""
    rng = np.random.default_rng(seed)
    ground = grid_points(5000, seed)
    strays = ground[rng.choice(len(ground), 30, replace=False)]
    strays[:, 2] += rng.choice([-1, 1], 30) * rng.uniform(4.0, 60.0, 30)
    pairs = strays[:10] + rng.uniform(-0.3, 0.3, (10, 3))
    points = np.concatenate([ground, strays, pairs])
    return points - points.min(axis=0), np.arange(len(points)) >= len(ground)


def test_outliers_are_found_and_nothing_else() -> None:
    points, stray = ground_with_strays()
    found = find_outliers(points, len(points), 0.5, OutlierOptions())
    np.testing.assert_array_equal(found, stray)


def test_density_that_changes_makes_no_outliers() -> None:
    rng = np.random.default_rng(0)
    distance = np.exp(rng.uniform(np.log(0.5), np.log(40.0), 20_000))  # around a scanner on a tripod
    angle = rng.uniform(0, 2 * np.pi, len(distance))
    points = np.column_stack(
        [distance * np.cos(angle), distance * np.sin(angle), rng.normal(0, 0.01, 20_000)]
    )
    assert find_outliers(points, len(points), 0.5, OutlierOptions()).sum() <= 4


def test_the_ratio_is_that_of_brute_force() -> None:
    points, _ = ground_with_strays()
    points = points[np.argsort(points[:, 0])][:600]
    reach, k = 3.0, 8
    distance = cdist(points, points)
    np.fill_diagonal(distance, np.inf)
    order = np.argsort(distance, axis=1)[:, :k]
    nearest = np.take_along_axis(distance, order, axis=1)
    mean = np.minimum(nearest, reach).mean(axis=1)
    theirs = np.where(nearest <= reach, mean[order], np.nan)
    expected = np.full(len(points), np.inf)
    some = (nearest <= reach).sum(axis=1) >= OutlierOptions().fewest
    expected[some] = mean[some] / np.nanmedian(theirs[some], axis=1)
    np.testing.assert_allclose(
        outlier_ratio(points, len(points), reach, OutlierOptions()), expected, rtol=1e-5
    )


def test_borders_of_blocks_make_no_difference() -> None:
    points, _ = ground_with_strays()
    options = OutlierOptions()
    whole = find_outliers(points, len(points), 0.5, options)
    middle = float(np.median(points[:, 0]))
    for inside in (points[:, 0] < middle, points[:, 0] >= middle):
        beside = ~inside & (np.abs(points[:, 0] - middle) <= options.margin_m(0.5))
        rows = np.concatenate([np.flatnonzero(inside), np.flatnonzero(beside)])
        piece = find_outliers(points[rows], int(inside.sum()), 0.5, options)
        np.testing.assert_array_equal(piece, whole[inside])
        alone = outlier_ratio(points[inside], int(inside.sum()), options.reach_m(0.5), options)
        with_margin = outlier_ratio(points[rows], int(inside.sum()), options.reach_m(0.5), options)
        assert (alone != with_margin).any()  # the margin is needed


def test_intensities_are_stretched_between_percentiles() -> None:
    rng = np.random.default_rng(1)
    raw = np.concatenate([rng.integers(100, 1100, 98_000), rng.integers(1100, 60_000, 2_000)]).astype(
        np.uint16
    )
    stretch = stretch_of(np.bincount(raw, minlength=65536), 1.0, 99.0)
    assert stretch is not None
    low, high = np.percentile(raw, [1, 99])
    assert abs(stretch.low - low) <= 2
    assert abs(stretch.high - high) <= 0.02 * high
    values = np.array([0, int(stretch.low), int((stretch.low + stretch.high) / 2), int(stretch.high), 65535])
    np.testing.assert_allclose(stretch.apply(values.astype(np.uint16)), [0, 0, 127.5, 255, 255], atol=1.0)


def test_equal_intensities_are_none() -> None:
    assert stretch_of(np.bincount(np.full(100, 7), minlength=65536), 1.0, 99.0) is None
    nearly = stretch_of(np.bincount(np.r_[np.full(1000, 7), 9], minlength=65536), 1.0, 99.0)
    assert nearly is not None
    assert (nearly.low, nearly.high) == (7.0, 9.0)


def test_levels_hold_each_point_once_and_one_per_cell() -> None:
    utm = grid_points(20_000, 5, spacing=0.3)
    finest = finest_level(0.3)
    assert COARSEST_SPACING_M / 2**finest <= 0.3 < 2 * COARSEST_SPACING_M / 2**finest
    order = order_by_level(utm, finest)
    np.testing.assert_array_equal(np.sort(order.order), np.arange(len(utm)))
    assert (np.diff(order.level.astype(int)) >= 0).all()
    ordered = utm[order.order]
    for level in range(finest):
        cell = COARSEST_SPACING_M / 2**level
        drawn = np.floor(ordered[order.level <= level] / cell).astype(np.int64)
        own = np.floor(ordered[order.level == level] / cell).astype(np.int64)
        # Every cell that holds a point has one by now, and a level adds at most one to a cell.
        assert len(np.unique(drawn, axis=0)) == len(np.unique(np.floor(utm / cell).astype(np.int64), axis=0))
        assert len(np.unique(own, axis=0)) == len(own)
        spacing = order.spacing_m[order.level == level]
        assert 0.5 * cell < np.median(spacing) < 1.5 * cell


def test_levels_of_pieces_are_those_of_the_whole() -> None:
    utm = grid_points(20_000, 6, spacing=0.3)
    border = 500_016.0  # an edge of the grid's coarsest cells
    whole = order_by_level(utm, 4)
    level = np.empty(len(utm), int)
    level[whole.order] = whole.level
    for piece in (utm[:, 0] < border, utm[:, 0] >= border):
        part = order_by_level(utm[piece], 4)
        of_part = np.empty(int(piece.sum()), int)
        of_part[part.order] = part.level
        assert (of_part != level[piece]).mean() < 1e-3  # rounding of 0.03 mm at a cell's edge
