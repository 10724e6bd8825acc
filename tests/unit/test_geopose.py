"""GeoPose: directions known by hand, the answer's own ENU, the JSON of the standard and its refusals."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from featuredb.errors import InvalidValueError
from featuredb.geo.geopose import GeoPose, geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3

FRAME = LocalFrame(latitude_deg=49.0, longitude_deg=8.4, height_m=120.0)
EAST, NORTH, UP = np.eye(3)


def camera_looking(forward: FloatArray, image_up: FloatArray, center: FloatArray | None = None) -> Rigid3:
    """cam_from_local of a camera whose optical axis and image top point along local directions."""
    rotation = np.stack([np.cross(forward, image_up), -image_up, forward])
    position = np.zeros(3) if center is None else center
    return Rigid3(rotation=rotation, translation=-rotation @ position)


def test_level_camera_to_the_east_has_the_identity() -> None:
    pose = geopose_from_camera(camera_looking(EAST, UP), FRAME)
    np.testing.assert_allclose(pose.quaternion_xyzw, [0, 0, 0, 1], atol=1e-12)
    assert pose.latitude_deg == pytest.approx(49.0, abs=1e-11)
    assert pose.longitude_deg == pytest.approx(8.4, abs=1e-11)
    assert pose.height_m == pytest.approx(120.0, abs=1e-8)


def test_body_axes_are_forward_left_up() -> None:
    pose = geopose_from_camera(camera_looking(NORTH, UP), FRAME)
    # Columns: forward is north, left is west, up is up; a quarter turn about up.
    np.testing.assert_allclose(pose.true_enu_from_body, np.column_stack([NORTH, -EAST, UP]), atol=1e-12)
    np.testing.assert_allclose(pose.quaternion_xyzw, [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


DOWN_45 = np.array([0.0, np.sqrt(0.5), -np.sqrt(0.5)])
UP_45 = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize(
    ("forward", "image_up", "heading_pitch_roll"),
    [
        (NORTH, UP, (0, 0, 0)),
        (EAST, UP, (90, 0, 0)),
        (-EAST, UP, (270, 0, 0)),
        (DOWN_45, UP_45, (0, -45, 0)),
        (UP_45, -DOWN_45, (0, 45, 0)),
        (NORTH, EAST, (0, 0, 90)),  # the camera's top leans to the right
        (-UP, NORTH, (0, -90, 0)),  # nadir: heading is that of the image's top
        (-UP, EAST, (90, -90, 0)),
        (UP, -NORTH, (0, 90, 0)),  # zenith: heading is that of the image's bottom
    ],
)
def test_angles_for_people(
    forward: FloatArray, image_up: FloatArray, heading_pitch_roll: tuple[float, float, float]
) -> None:
    angles = geopose_from_camera(camera_looking(forward, image_up), FRAME).heading_pitch_roll_deg
    difference = (np.array(angles) - heading_pitch_roll + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)
    assert 0 <= angles[0] < 360


def test_yaw_pitch_roll_are_the_standards_turns() -> None:
    for yaw, pitch, roll in ((30.0, 20.0, -40.0), (-170.0, -80.0, 100.0), (90.0, 0.0, 0.0)):
        # Intrinsic z, y', x'' right-handed turns, as GeoPose's Basic-YPR has them.
        x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_quat()
        pose = GeoPose(latitude_deg=0, longitude_deg=0, height_m=0, quaternion_xyzw=(x, y, z, w))
        np.testing.assert_allclose(pose.yaw_pitch_roll_deg, [yaw, pitch, roll], atol=1e-9)


def test_rotation_is_that_of_the_answers_own_position() -> None:
    # 200 km east of the origin: the pose of a level camera there is not level in the frame at the origin.
    there = LocalFrame(latitude_deg=49.0, longitude_deg=11.1, height_m=300.0)
    level_there = camera_looking(NORTH, UP)
    cam_from_here = level_there @ there.enu_from(FRAME)
    pose = geopose_from_camera(cam_from_here, FRAME)
    assert pose.latitude_deg == pytest.approx(49.0, abs=1e-11)
    assert pose.longitude_deg == pytest.approx(11.1, abs=1e-11)
    angles = (np.array(pose.heading_pitch_roll_deg) + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(angles, [0.0, 0.0, 0.0], atol=1e-9)
    # Taken for a rotation of the frame at the origin, it would be wrong by degrees.
    wrong_deg = cam_from_here.angle_to_deg(camera_looking(NORTH, UP))
    assert wrong_deg > 2.0


def test_json_is_the_standards() -> None:
    pose = GeoPose(
        latitude_deg=47.7, longitude_deg=-122.3, height_m=11.5, quaternion_xyzw=(0.5, 0.5, 0.5, 0.5)
    )
    document = pose.to_json()
    assert document == {
        "position": {"lat": 47.7, "lon": -122.3, "h": 11.5},
        "quaternion": {"x": 0.5, "y": 0.5, "z": 0.5, "w": 0.5},
    }


def test_rounded_quaternions_are_brought_to_unit_length() -> None:
    pose = GeoPose(latitude_deg=0, longitude_deg=0, height_m=0, quaternion_xyzw=(0.0, 0.0, -0.707, -0.707))
    np.testing.assert_allclose(pose.quaternion_xyzw, [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {"latitude_deg": 90.5},
        {"latitude_deg": float("nan")},
        {"longitude_deg": -180.5},
        {"height_m": float("inf")},
        {"quaternion_xyzw": (0.0, 0.0, 0.0, 0.0)},
        {"quaternion_xyzw": (0.0, 0.0, 0.0, 1.01)},
        {"quaternion_xyzw": (0.1, 0.0, 0.0, 1.0)},
        {"quaternion_xyzw": (0.0, 0.0, 0.0, float("nan"))},
    ],
)
def test_bad_members_are_refused(change: dict[str, Any]) -> None:
    good: dict[str, Any] = {
        "latitude_deg": 1.0,
        "longitude_deg": 2.0,
        "height_m": 3.0,
        "quaternion_xyzw": (0.0, 0.0, 0.0, 1.0),
    }
    assert GeoPose(**good).height_m == 3.0
    with pytest.raises(InvalidValueError, match="GeoPose"):
        GeoPose(**good | change)
