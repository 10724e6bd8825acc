"""Orientations of keypoints that have lost theirs, against those that the extractor gave them."""

from collections import Counter

import numpy as np

from featuredb.features.extractor import extract, orientations_at
from tests.support import planar_map as field


def test_the_extractors_keypoints_get_their_orientations_back() -> None:
    """To 0.1 degrees for 99 of 100 that have one orientation; the others' are one of theirs."""
    photo = field.render(field.field_texture(1), field.view(3.0, 5.0, 42.0, 8.0, 30.0), seed=1)
    found = extract(photo)
    angles = orientations_at(photo, found.xy, found.scale)
    assert angles.dtype == np.float32
    assert ((angles >= 0) & (angles < 360)).all()
    off = np.abs((angles - found.angle + 180.0) % 360.0 - 180.0)
    places = [tuple(row) for row in np.column_stack([found.xy, found.scale]).tolist()]
    count = Counter(places)
    alone = np.array([count[place] == 1 for place in places])
    assert alone.sum() > 1000
    assert np.percentile(off[alone], 99) < 0.1
    best: dict[tuple[float, ...], float] = {}
    for place, error in zip(places, off.tolist(), strict=True):
        best[place] = min(error, best.get(place, 360.0))
    assert np.percentile(list(best.values()), 98) < 1.0


def test_a_turned_photo_turns_them() -> None:
    photo = field.render(field.field_texture(2), field.view(0.0, 0.0, 45.0, 0.0, 0.0), seed=2)
    found = extract(photo)
    clockwise = np.ascontiguousarray(np.rot90(photo, -1))
    turned = np.column_stack([photo.shape[0] - found.xy[:, 1], found.xy[:, 0]]).astype(np.float32)
    before = orientations_at(photo, found.xy, found.scale)
    change = orientations_at(clockwise, turned, found.scale) - before
    off = np.abs((change - 90.0 + 180.0) % 360.0 - 180.0)
    assert len(found) > 500
    assert np.median(off) < 1.0
    assert np.mean(off < 5.0) > 0.8  # the others have two directions about as strong


def test_no_keypoints_no_orientations() -> None:
    photo = np.zeros((100, 100), np.uint8)
    assert orientations_at(photo, np.zeros((0, 2), np.float32), np.zeros(0, np.float32)).shape == (0,)
    one = orientations_at(photo, np.array([[50, 50]], np.float32), np.array([5], np.float32))
    assert one.tolist() == [0.0]
