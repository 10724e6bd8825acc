"""A moved map against the same scene built at the new place."""

from dataclasses import fields, replace

import numpy as np
import pytest

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapObservations
from featuredb.maps.move import covariance_in_frame, in_frame, move_map
from tests.support.maps import EASTING, EPSG, HEIGHT, NORTHING, assert_same_map, random_map

_MOVE = Sim3.exp([0.02, 0.1, -0.05, 0.4, 12.0, -7.0, 3.0])
_FAR = LocalFrame.from_utm(EASTING + 900.0, NORTHING - 400.0, HEIGHT + 30.0, EPSG)


def test_identity_keeps_every_bit() -> None:
    feature_map = random_map(3)
    moved = move_map(feature_map, Sim3.identity(), covariance=feature_map.placement.covariance)
    assert_same_map(feature_map, moved)


@pytest.mark.parametrize("frame", [None, _FAR])
def test_points_and_cameras_move_alike(frame: LocalFrame | None) -> None:
    feature_map = random_map(1)
    there = frame or feature_map.frame
    moved = move_map(feature_map, in_frame(_MOVE, there, feature_map.frame))
    np.testing.assert_allclose(
        moved.points_local(there), _MOVE.act(feature_map.points_local(there)), atol=1e-6
    )
    there_from_map = there.enu_from(feature_map.frame)
    for old, new in zip(feature_map.images, moved.images, strict=True):
        center = there_from_map.act(old.cam_from_local.center)
        np.testing.assert_allclose(
            there_from_map.act(new.cam_from_local.center), _MOVE.act(center), atol=1e-6
        )


def test_pixels_stay_where_they_were() -> None:
    """What a camera sees does not change when the world moves with it."""
    feature_map = random_map(2)
    moved = move_map(feature_map, in_frame(_MOVE, _FAR, feature_map.frame))
    for old, new in zip(feature_map.images, moved.images, strict=True):
        before = old.cam_from_local.act(feature_map.points_local())
        after = new.cam_from_local.act(moved.points_local())
        np.testing.assert_allclose(after / _MOVE.scale, before, atol=1e-5)


def test_point_covariances_turn_and_grow() -> None:
    feature_map = random_map(1)
    moved = move_map(feature_map, _MOVE)
    rows, columns = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
    for upper, found in zip(feature_map.points.covariance[:5], moved.points.covariance[:5], strict=True):
        full = np.zeros((3, 3))
        for value, i, j in zip(upper, rows, columns, strict=True):
            full[i, j] = full[j, i] = value
        linear = _MOVE.scale * _MOVE.rotation
        expected = linear @ full @ linear.T
        np.testing.assert_allclose(
            found, [expected[i, j] for i, j in zip(rows, columns, strict=True)], rtol=1e-4
        )


def test_pose_covariance_is_that_of_moved_samples() -> None:
    """Samples of the pose, each moved, spread as the moved covariance says."""
    feature_map = random_map(1)
    image = feature_map.images[1]
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03]) ** 2
    rng = np.random.default_rng(0)
    samples = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    moved_pose = _MOVE.act_on_pose(image.cam_from_local)
    logs = [
        (_MOVE.act_on_pose(Rigid3.exp(xi) @ image.cam_from_local) @ moved_pose.inverse()).log()
        for xi in samples
    ]
    with_covariance = replace(
        feature_map, images=(replace(image, covariance=covariance),), observations=_none(feature_map)
    )
    found = move_map(with_covariance, _MOVE).images[0].covariance
    assert found is not None
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.std(logs, axis=0), rtol=0.05)


def _none(feature_map: FeatureMap) -> MapObservations:
    seen = feature_map.observations
    return MapObservations(**{f.name: getattr(seen, f.name)[:0] for f in fields(MapObservations)})


def test_placement_is_carried_along() -> None:
    feature_map = random_map(5)
    moved = move_map(feature_map, _MOVE)
    np.testing.assert_allclose(
        moved.placement.local_from_sfm.matrix(),
        _MOVE.matrix() @ feature_map.placement.local_from_sfm.matrix(),
        rtol=1e-12,
        atol=1e-9,
    )
    # A place of the map is as uncertain as before, turned and grown with it.
    place = np.array([30.0, -20.0, 5.0])
    before, after = point_jacobian(place), point_jacobian(_MOVE.act(place))
    linear = _MOVE.scale * _MOVE.rotation
    expected = linear @ before @ feature_map.placement.covariance @ before.T @ linear.T
    np.testing.assert_allclose(after @ moved.placement.covariance @ after.T, expected, rtol=1e-9)


def test_frames_can_be_changed_and_changed_back() -> None:
    own = random_map(0).frame
    there = in_frame(_MOVE, own, _FAR)
    point = np.array([[5.0, 6.0, 7.0]])
    far_from_own = _FAR.enu_from(own)
    np.testing.assert_allclose(
        there.act(far_from_own.act(point)), far_from_own.act(_MOVE.act(point)), atol=1e-9
    )
    covariance = np.diag([1e-6, 1e-6, 2e-6, 3e-6, 0.01, 0.02, 0.03])
    back = covariance_in_frame(covariance_in_frame(covariance, own, _FAR), _FAR, own)
    np.testing.assert_allclose(back, covariance, atol=1e-9)
