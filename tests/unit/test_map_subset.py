"""Parts of a map: some of its images, some of its points."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.maps.subset import only_images, only_points
from tests.support.maps import assert_same_map, random_map


def test_images_take_their_cameras_observations_and_points_along() -> None:
    whole = random_map(1)
    part = only_images(whole, [1, 3])  # both of the second camera
    assert [i.image_id for i in part.images] == [1, 3]
    assert part.cameras == (whole.cameras[1],)
    assert part.camera_keys == (whole.camera_keys[1],)
    assert {i.camera_id for i in part.images} == {0}
    assert set(part.observations.image_id.tolist()) == {1, 3}
    seen = whole.observations
    for k in range(len(whole.points)):
        views = set(seen.image_id[seen.point_index == k].tolist()) & {1, 3}
        rows = np.flatnonzero((part.points.utm == whole.points.utm[k]).all(axis=1))
        assert len(rows) == (len(views) >= 2)
        for row in rows:
            assert part.points.track_length[row] == 2
            mine = part.observations.descriptors[part.observations.point_index == row]
            theirs = seen.descriptors[(seen.point_index == k) & np.isin(seen.image_id, [1, 3])]
            np.testing.assert_array_equal(mine, theirs)


def test_an_image_that_sees_a_point_twice_counts_once() -> None:
    whole = random_map(2)
    seen = whole.observations
    twice = replace(seen, point_index=np.zeros_like(seen.point_index), image_id=np.ones_like(seen.image_id))
    assert len(only_images(replace(whole, observations=twice), [1, 2]).points) == 0


def test_all_images_are_the_map_itself_and_unknown_ones_an_error() -> None:
    whole = random_map(3)
    assert only_images(whole, range(4)) is whole
    assert_same_map(only_points(whole, np.ones(len(whole.points), np.bool_)), whole)
    with pytest.raises(InvalidValueError, match=r"expected ids of its images, found \[7\]"):
        only_images(whole, [0, 7])
