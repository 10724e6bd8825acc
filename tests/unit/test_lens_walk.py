"""The focal length of a film's lens, estimated with every frame's pose."""

import numpy as np

from featuredb.features.exif.read import is_of_film, shot_model, unnamed_model
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import look_pose
from reloc.tracking.pose_fit import STILL_S, FittedPose, LensSigmas, LensWalk, fit_pose

CAMERA = Camera(model="RADIAL", width=1280, height=720, params=(970.0, 641.0, 359.0, -0.03, 0.01))
POSE = look_pose([3.0, -2.0, 50.0], 40.0, -55.0)


def points_in_view(rng: np.random.Generator, count: int = 150) -> np.ndarray:
    pixels = rng.uniform((200, 120), (1080, 600), (count, 2))
    rays = np.concatenate([CAMERA.unproject(pixels), np.ones((count, 1))], axis=1)
    return POSE.inverse().act(rays * rng.uniform(35, 70, (count, 1)))


def fitted(camera: Camera, start: Camera, rng: np.random.Generator, doubt: LensSigmas) -> FittedPose:
    points = points_in_view(np.random.default_rng(7))
    pixels = camera.project(POSE.act(points)) + rng.normal(0, 0.4, (len(points), 2))
    found = fit_pose(start, pixels, points, POSE, doubt)
    assert found is not None
    return found


def test_the_covariance_is_that_of_many_runs_with_lenses_that_are_not_known() -> None:
    """Focal length fitted along; principal point and distortion are only allowed for."""
    rng = np.random.default_rng(1)
    doubt = LensSigmas(focal_rel=0.1, center_px=5.0, radial=0.02)
    squares, focals = [], []
    for _ in range(200):
        off = rng.normal(0, (0.02, doubt.center_px, doubt.center_px, doubt.radial))
        f, cx, cy, k1, k2 = CAMERA.params
        params = (f * float(np.exp(off[0])), cx + off[1], cy + off[2], k1 + off[3], k2)
        found = fitted(CAMERA, Camera(model="RADIAL", width=1280, height=720, params=params), rng, doubt)
        turn = Rigid3(rotation=found.cam_from_local.rotation.T @ POSE.rotation, translation=np.zeros(3))
        error = np.concatenate([turn.log()[:3], found.cam_from_local.center - POSE.center])
        squares.append(float(error @ np.linalg.solve(found.covariance, error)))
        focals.append(np.log(found.focal_px / CAMERA.focal_px))
    assert 4.5 < np.mean(squares) < 8.0
    assert np.abs(focals).max() < 0.02


def test_a_given_lens_is_left_as_it_is() -> None:
    found = fitted(CAMERA, CAMERA, np.random.default_rng(2), LensSigmas())
    assert found.focal_px == CAMERA.focal_px
    assert found.focal_rel == 0.0


def test_a_zoom_is_followed_and_a_lens_that_stands_still_is_known_better() -> None:
    rng = np.random.default_rng(3)
    lens = LensWalk(camera=CAMERA, rel=0.005, lent=True)
    ramp = np.clip((np.arange(150) - 50) / 50.0, 0.0, 1.0)
    zooming, off, rel = [], [], []
    for frame, share in enumerate(ramp):
        true = CAMERA.with_focal(CAMERA.focal_px * 1.5 ** float(share))
        found = fitted(true, lens.camera, rng, lens.doubt)
        if lens.surprised(found.focal_px, found.focal_rel):
            lens.zooms()
            found = fitted(true, lens.camera, rng, lens.doubt)
        lens.take(found.focal_px, found.focal_rel, frame / 25.0)
        zooming.append(lens.zooming)
        rel.append(lens.rel)
        off.append(np.log(found.focal_px / true.focal_px))
    assert not any(zooming[:50])
    assert all(zooming[55:100])
    assert not any(zooming[-10:])
    assert np.abs(off).max() < 0.02
    assert max(rel[20:50]) < rel[0]


def test_frames_that_are_far_apart_say_nothing_of_whether_a_zoom_has_ended() -> None:
    lens = LensWalk(camera=CAMERA, rel=0.005, lent=True)
    lens.zooms()
    for frame in range(4):
        lens.take(CAMERA.focal_px, 0.005, frame * 1.5 * STILL_S)
    assert lens.zooming


def test_the_lenses_of_a_film_are_told_by_its_bytes_whatever_the_shot() -> None:
    film, other = unnamed_model("ab" * 32), unnamed_model("ab" * 7 + "cd" * 25)
    for shot in (0, 1, 11):
        assert is_of_film(f"film|{shot_model(film, shot)}|960x540|unknown", film)
        assert not is_of_film(f"film|{shot_model(other, shot)}|960x540|unknown", film)
    assert not is_of_film(f"dji|{film}|960x540|unknown", film)
