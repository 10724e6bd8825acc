"""Laws of the spread selection of keypoints."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.features.extractor import spread_strongest

WIDTH, HEIGHT, COLUMNS, ROWS = 480, 360, 24, 18


def keypoints(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places anywhere, edges included, and responses that all differ."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, [WIDTH, HEIGHT], (count, 2)).astype(np.float32)
    xy[: count // 10] = [WIDTH, HEIGHT]
    xy[count // 10 : count // 2] *= 0.2  # crowded in a corner
    return xy, rng.permutation(count).astype(np.float32)


def cells(xy: np.ndarray) -> list[tuple[int, int]]:
    return [
        (min(int(x / (WIDTH / COLUMNS)), COLUMNS - 1), min(int(y / (HEIGHT / ROWS)), ROWS - 1)) for x, y in xy
    ]


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(0, 400), st.integers(1, 500))
def test_count_order_and_fairness(seed: int, count: int, wanted: int) -> None:
    xy, response = keypoints(seed, count)
    rows = spread_strongest(xy, response, WIDTH, HEIGHT, wanted)
    assert len(rows) == min(count, wanted) == len(set(rows.tolist()))
    place = cells(xy)
    best: dict[tuple[int, int], int] = {}
    for i in np.argsort(-response):
        best.setdefault(place[i], int(i))
    leaders = rows[: len(best)]
    # The strongest of every cell come first, the stronger the earlier; the rest only after all of them.
    expected = sorted(best.values(), key=lambda i: -response[i])[: len(leaders)]
    assert leaders.tolist() == expected
    taken: dict[tuple[int, int], list[float]] = {}
    for i in rows:
        taken.setdefault(place[i], []).append(float(response[i]))
    assert all(values == sorted(values, reverse=True) for values in taken.values())
    if len(rows) < count:  # a cell is ahead of another that had more to give by one round at most
        left = {place[i] for i in set(range(count)) - set(rows.tolist())}
        fewest = min(len(taken.get(cell, [])) for cell in left)
        assert max(len(values) for values in taken.values()) <= fewest + 1


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 300), st.integers(1, 300))
def test_the_order_of_the_keypoints_does_not_matter(seed: int, count: int, wanted: int) -> None:
    xy, response = keypoints(seed, count)
    order = np.random.default_rng(seed + 1).permutation(count)
    rows = spread_strongest(xy, response, WIDTH, HEIGHT, wanted)
    shuffled = spread_strongest(xy[order], response[order], WIDTH, HEIGHT, wanted)
    assert order[shuffled].tolist() == rows.tolist()
