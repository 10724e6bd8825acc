"""Answers in words: where the camera looks, how sure that is, and what the photo's own position did."""

import re

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.geo.geopose import BODY_FROM_CAM
from featuredb.geometry.camera import Camera
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rotation import quaternion_from_matrix
from reloc.service.handler import reply_from_result
from reloc.wire.query import LocaliseReply, OwnPositionUse, Quaternion
from reloc.wording import describe
from tests.support.service import localised, not_localised


@pytest.fixture(scope="module")
def reply() -> LocaliseReply:
    result = localised(3, Camera.from_focal(640, 480, 600.0))
    return reply_from_result(result, request_id="r", timings_ms={"total": 1.0})


@pytest.mark.parametrize("angles", [(123.4, -20.0, 3.0), (350.0, 10.0, -5.0), (40.0, -75.0, 0.0)])
def test_the_angles_are_those_of_a_gimbal(reply: LocaliseReply, angles: tuple[float, float, float]) -> None:
    """Built by the rotation that telemetry is read with, which knows nothing of GeoPose."""
    x, y, z, w = quaternion_from_matrix((BODY_FROM_CAM @ cam_from_enu(*angles)).T)
    text = describe("a.jpg", reply.model_copy(update={"quaternion": Quaternion(x=x, y=y, z=z, w=w)}), "db")
    said = re.search(r"looks +heading ([-+.0-9]+) .* pitch ([-+.0-9]+), roll ([-+.0-9]+)", text)
    assert said is not None
    assert [float(v) for v in said.groups()] == pytest.approx(angles, abs=0.006)
    top = re.search(r"top points to ([.0-9]+)", text)
    assert (top is not None) == (angles[1] < -60.0)
    if top is None:  # two points of the horizon, 10 degrees to the right of the heading and to its left
        aside = np.radians(angles[0] + np.array([10.0, -10.0]))
        right, left = np.column_stack([np.sin(aside), np.cos(aside), 0.0 * aside]) @ cam_from_enu(*angles).T
        assert ("right end is higher" in text) == (right[1] / right[2] < left[1] / left[2])
    if top is not None:
        assert float(top.group(1)) == pytest.approx(angles[0], abs=0.006)


def test_a_nadir_photo_says_where_its_top_points(reply: LocaliseReply) -> None:
    """A degree off the vertical the axis may point anywhere in plan; the top does not."""
    for aside in (30.0, 200.0):
        # Level in the picture's own axes: the top to 70 degrees, then the axis tilted aside by a degree.
        level = cam_from_enu(70.0, -90.0, 0.0)
        tilt = cam_from_enu(aside, -89.0, 0.0).T @ cam_from_enu(aside, -90.0, 0.0)
        x, y, z, w = quaternion_from_matrix((BODY_FROM_CAM @ level @ tilt.T).T)
        said = describe("a.jpg", reply.model_copy(update={"quaternion": Quaternion(x=x, y=y, z=z, w=w)}), "d")
        top = re.search(r"top points to ([.0-9]+)", said)
        assert top is not None
        assert float(top.group(1)) == pytest.approx(70.0, abs=1.0)
        assert re.search(r"pitch -89\.00", said) is not None


def test_the_radius_of_95_per_cent_is_that_of_the_covariance(reply: LocaliseReply) -> None:
    covariance = np.diag([1e-6] * 3 + [4.0, 4.0, 9.0])
    wide = reply.model_copy(update={"covariance": tuple(tuple(row) for row in covariance.tolist())})
    across, up = 2.0 * np.sqrt(chi2.ppf(0.95, 2)), 3.0 * np.sqrt(chi2.ppf(0.95, 1))
    assert f"  95 %      {across:.3f} m horizontally, {up:.3f} m vertically" in describe("a.jpg", wide, "db")


def test_the_answer_says_what_the_photos_own_position_did(reply: LocaliseReply) -> None:
    assert "prior" not in describe("a.jpg", reply, "db")
    for role, distance_m, words in (
        ("agrees", 3.25, "EXIF position, 3.2 m away horizontally, agrees"),
        ("decided", 12.0, "12.0 m away horizontally, decided; --no-exif-prior leaves it out"),
        ("contradicted", 312_400.0, "312.4 km away horizontally, is not what the photo shows"),
    ):
        own = OwnPositionUse(role=role, distance_m=distance_m)
        assert words in describe("a.jpg", reply.model_copy(update={"exif_prior": own}), "db")
    lost = reply_from_result(not_localised(3), request_id="r", timings_ms={"total": 12.0})
    helpless = lost.model_copy(update={"exif_prior": OwnPositionUse(role="no_help", distance_m=None)})
    assert "EXIF position was tried, and did not help" in describe("a.jpg", helpless, "db")


def test_more_inliers_than_matches_explain_themselves(reply: LocaliseReply) -> None:
    text = describe("a.jpg", reply.model_copy(update={"inliers": 428, "matches": 212}), "db")
    assert "428 inliers (212 matches led to the pose, which was then used to find more), residual" in text


@pytest.mark.parametrize("reason", ["TOO_FEW_MATCHES", "TOO_FEW_INLIERS"])
def test_the_first_thought_about_a_photo_that_fits_nothing_is_another_place(reason: str) -> None:
    lost = reply_from_result(not_localised(3), request_id="r", timings_ms={"total": 12.0})
    text = describe("a.jpg", lost.model_copy(update={"reason": reason}), "db")
    assert "  try: it may show another place; if not, " in text
