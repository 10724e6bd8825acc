"""An index of segments takes over what another one has, and finds the same as one made anew."""

import pickle

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.index import segment_index
from featuredb.index.segment import Segment, segment_of
from featuredb.index.segment_index import SegmentIndex
from tests.support.scenes import box_points, noisy, random_descriptors, ring, scene_map


def segment(seed: int) -> Segment:
    rng = np.random.default_rng(seed)
    return segment_of(
        scene_map(
            points=box_points(rng, 200),
            descriptors=random_descriptors(rng, 200),
            poses=ring(8),
            map_id=f"place-{seed}",
        )
    )


def nearest_rows(index: SegmentIndex, segments: list[Segment]) -> NDArray[np.bool_]:
    """(n,) whether descriptors like those of the segments find their own rows."""
    descriptors = np.concatenate([one.descriptors for one in segments])
    asked = noisy(np.random.default_rng(9), descriptors, 3.0)
    found = index.search(asked, 4)
    assert found.max() < len(index) == len(descriptors)
    return np.asarray((found == np.arange(len(asked))[:, None]).any(axis=1))


def test_new_segments_are_added_and_old_ones_left_out_wherever_they_are() -> None:
    a, b, c, d = (segment(k) for k in range(4))
    first = SegmentIndex.of([a, b, c])
    assert nearest_rows(first, [a, b, c]).mean() > 0.99
    for now in ([a, b, c, d], [d, c, a], [b], [d, b]):
        then = SegmentIndex.of(now, first)
        assert then._parts[0].index is first._parts[0].index
        assert nearest_rows(then, now).mean() > 0.99
        again = pickle.loads(pickle.dumps(then))
        np.testing.assert_array_equal(again.search(d.descriptors[:20], 3), then.search(d.descriptors[:20], 3))
    # What one took over, the next takes over from it.
    once = SegmentIndex.of([d, c, a], first)
    assert SegmentIndex.of([b, d], once)._parts[0].index is first._parts[0].index


def test_what_changes_too_much_is_indexed_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, c, d = (segment(k) for k in range(4))
    first = SegmentIndex.of([a, b])
    monkeypatch.setattr(segment_index, "_MOST_APART", 250)
    assert SegmentIndex.of([a, b, c], first)._parts[0].index is first._parts[0].index
    for now in ([a, b, c, d], [c, d]):
        then = SegmentIndex.of(now, first)
        assert len(then._parts) == 1
        assert nearest_rows(then, now).mean() > 0.99
