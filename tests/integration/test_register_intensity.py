"""A photo against laser intensity whose contrast is another: search, confirmation, refusals."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import rotation_angle, so3_exp
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import render
from ingest.register.frame.candidates import agreement_elsewhere
from ingest.register.frame.dense.confirmation import confirm_pose
from ingest.register.frame.register import register_frame
from ingest.register.frame.views import FrameOptions, FrameViews, first_look
from ingest.register.frame_registration import FramePrior
from tests.support.clouds import build_cloud

CAMERA = Camera(
    model="SIMPLE_RADIAL", width=320, height=240, params=(300.0, 163.0, 118.0, -0.06)
)  # principal point and distortion as a real lens has them


def _patchwork(rng: np.random.Generator, cells: int) -> NDArray[np.float64]:
    """Fields of constant value between random straight borders, in [0, 1)."""
    seeds = rng.random((140, 2)) * cells
    values = rng.random(140)
    y, x = np.mgrid[:cells, :cells]
    _, nearest = cKDTree(seeds).query(np.stack([y.ravel(), x.ravel()], axis=1))
    return values[nearest].reshape(cells, cells)


@lru_cache(maxsize=3)
def _ground(seed: int, period: int | None = None) -> tuple[PointCloud, PointCloud]:
    """The same place as laser and as light see it: (scan with speckle, dense cloud with other contrast).

    With a period its pattern repeats itself after so many cells.
    """
    rng = np.random.default_rng(seed)
    cells = 520
    material = _patchwork(rng, cells)
    if period is not None:
        material = np.tile(material[:period, :period], (4, 4))[:cells, :cells]
    y, x = np.mgrid[:cells, :cells] * 0.13 - 33.8
    z = 1.5 * np.sin(x / 9.0) * np.cos(y / 7.0)
    high = np.zeros((cells, cells))
    for r, c in rng.integers(60, cells - 100, (6, 2)):
        high[r : r + 48, c : c + 64] = rng.uniform(3.0, 7.0)
    xyz = np.stack([x, y, z + high], axis=-1).reshape(-1, 3)
    frame = LocalFrame(latitude_deg=45.0, longitude_deg=7.0, height_m=0.0)
    laser = 40 + 170 * material + rng.normal(0, 12, material.shape)
    light = 200 * np.abs(material - 0.45) ** 0.7 + 30  # no function of the other's values turns one into it
    some = rng.random(len(xyz)) < 0.6
    scan = build_cloud(
        frame,
        "unknown",
        xyz[some] + rng.normal(0, 0.03, (int(some.sum()), 3)),
        intensity=np.clip(laser, 0, 255).astype(np.uint8).ravel()[some],
    )
    seen = build_cloud(frame, "unknown", xyz, intensity=np.clip(light, 0, 255).astype(np.uint8).ravel())
    return scan, seen


def _pose(east: float, north: float, up: float, heading_deg: float, tilt_deg: float) -> Rigid3:
    nadir = np.diag([1.0, -1.0, -1.0])
    turn = so3_exp([0.0, 0.0, np.radians(heading_deg)])
    rotation = so3_exp([np.radians(tilt_deg), 0.0, 0.0]) @ nadir @ turn
    return Rigid3(rotation=rotation, translation=-rotation @ np.array([east, north, up]))


TRUTH = _pose(3.0, -4.0, 42.0, 25.0, 12.0)


def _photo(seed: int, period: int | None = None) -> NDArray[np.uint8]:
    seen = render(_ground(seed, period)[1], CAMERA, TRUTH)
    assert seen.intensity is not None
    noisy = cv2.GaussianBlur(seen.intensity.astype(np.float32), (0, 0), 0.7)
    noisy += np.random.default_rng(99).normal(0, 4, noisy.shape).astype(np.float32)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def _errors(pose: Rigid3) -> tuple[float, float]:
    metres = float(np.linalg.norm(pose.center - TRUTH.center))
    return metres, float(np.degrees(rotation_angle(pose.rotation @ TRUTH.rotation.T)))


def _prior() -> FramePrior:
    turn = so3_exp(np.radians([3.0, -2.5, 4.0]))
    rotation = turn @ TRUTH.rotation
    center = TRUTH.center + np.array([6.0, -5.0, 4.0])
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        sigma_horizontal_m=5.0,
        sigma_vertical_m=5.0,
        sigma_heading_deg=4.0,
        sigma_tilt_deg=3.0,
    )


def test_found_from_afar_and_confirmed() -> None:
    found = register_frame(_photo(0), CAMERA, _prior(), _ground(0)[0], FrameOptions(threads=1))
    assert found.accepted, found.message
    assert found.cam_from_local is not None
    metres, degrees = _errors(found.cam_from_local)
    assert metres < 0.5  # a pixel is 0.14 m on the ground; position and tilt trade
    assert degrees < 0.6
    assert found.source == "intensity"


def test_another_place_is_not_confirmed() -> None:
    found = register_frame(_photo(0), CAMERA, _prior(), _ground(1)[0], FrameOptions(threads=1))
    assert not found.accepted


@pytest.mark.evaluation
def test_the_photo_agrees_with_other_places_where_the_pattern_repeats_itself() -> None:
    """Copies lie 23 m apart, the places that are searched 21 m beside the pose."""
    found = []
    for period in (None, 180):
        photo, scan = _photo(0, period), _ground(0, period)[0]
        look = first_look(scan, CAMERA, _prior().cam_from_local)
        assert look is not None
        views = FrameViews(photo, CAMERA, scan, look, FrameOptions(threads=1))
        found.append(agreement_elsewhere(views, _prior(), TRUTH, "intensity", 2, 100.0))
    assert [places for places, _ in found] == [2, 2]
    assert found[0][1] < 1.0
    assert found[1][1] > 5.0


def test_a_pose_that_is_a_few_metres_off_is_not_confirmed() -> None:
    wrong = Rigid3(rotation=TRUTH.rotation, translation=TRUTH.translation + np.array([2.5, 1.0, 0.0]))
    views = _views(_photo(0))
    assert confirm_pose(views, CAMERA, TRUTH, "intensity").confirmed
    assert not confirm_pose(views, CAMERA, wrong, "intensity").confirmed


def test_an_empty_photo_confirms_nothing() -> None:
    flat = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    assert not confirm_pose(_views(flat), CAMERA, TRUTH, "intensity").confirmed


def _views(photo: NDArray[np.uint8]) -> FrameViews:
    scan = _ground(0)[0]
    look = first_look(scan, CAMERA, TRUTH)
    assert look is not None
    return FrameViews(photo, CAMERA, scan, look, FrameOptions(threads=1))
