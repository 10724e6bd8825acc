"""Focal lengths known beforehand: they decide where photos cannot, and lose where photos know better."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from ingest.colmap_anchored import AnchoredOptions, FixedPoints, adjust_anchored
from ingest.focal_prior import FocalPriorOptions
from tests.support.new_photos import NewPhotos, take_photos
from tests.support.scenes import CAMERA, looking_at, random_descriptors

TRUE_PX = CAMERA.focal_px


def nadir_line(seed: int) -> NewPhotos:
    """Photos straight down on nearly flat ground: focal length and height are one."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-60, 60, 500), rng.uniform(-25, 25, 500), rng.uniform(0, 1, 500)])
    poses: list[Rigid3] = []
    for k in range(5):
        spot = np.array([-24.0 + 12.0 * k, 0.0, 0.0])
        poses.append(looking_at(spot + np.array([0.0, -0.1, 40.0]), spot))
    return take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        poses,
        sfm_from_local=Sim3.identity(),
        noise_px=0.5,
        point_noise_m=0.1,
        pose_noise_m=0.1,
    )


def focal_after(new: NewPhotos, start_px: float, exif_px: float | None, weight: float) -> float:
    camera = Camera(
        model="SIMPLE_RADIAL",
        width=CAMERA.width,
        height=CAMERA.height,
        params=(start_px, CAMERA.width / 2, CAMERA.height / 2, 0.0),
    )
    options = replace(AnchoredOptions(), max_error_px=60.0, focal_prior=FocalPriorOptions(weight=weight))
    keypoints: list[FloatArray] = list(new.keypoints().values())
    known = {} if exif_px is None else {0: exif_px}
    done = adjust_anchored(
        replace(new.model, cameras=(camera,)), keypoints, FixedPoints.none(), [], options, known
    )
    return done.model.cameras[0].focal_px


def test_over_flat_ground_the_prior_decides() -> None:
    for seed in range(3):
        new = nadir_line(seed)
        free = focal_after(new, 1.1 * TRUE_PX, None, 100.0)
        held = focal_after(new, 1.1 * TRUE_PX, TRUE_PX, 100.0)
        assert abs(held / TRUE_PX - 1.0) < 0.005
        assert abs(free / TRUE_PX - 1.0) > 4.0 * abs(held / TRUE_PX - 1.0)


def test_a_wrong_prior_loses_to_photos_that_know() -> None:
    """Photos from many directions tell the focal length; EXIF names that of another mode of the camera."""
    rng = np.random.default_rng(4)
    points = rng.uniform((-15, -15, 0), (15, 15, 12), (400, 3))
    around = [
        np.array([40 * np.cos(a), 40 * np.sin(a), h]) for a, h in zip(np.arange(6), (8, 25) * 3, strict=True)
    ]
    new = take_photos(
        rng,
        points,
        random_descriptors(rng, len(points)),
        [looking_at(place, np.array([0.0, 0.0, 5.0])) for place in around],
        sfm_from_local=Sim3.identity(),
        noise_px=0.5,
        point_noise_m=0.05,
        pose_noise_m=0.05,
    )
    assert focal_after(new, 1.05 * TRUE_PX, 1.3 * TRUE_PX, 100.0) == pytest.approx(TRUE_PX, rel=0.005)


def test_the_gauge_is_that_of_the_photos() -> None:
    """Without fixed points the first photo stays, although the prior's images are constant too."""
    new = nadir_line(2)
    keypoints: list[FloatArray] = list(new.keypoints().values())
    done = adjust_anchored(new.model, keypoints, FixedPoints.none(), [], AnchoredOptions(), {0: TRUE_PX})
    moved = done.model.cam_from_sfm[0] @ new.model.cam_from_sfm[0].inverse()
    assert np.abs(moved.log()).max() < 1e-9


def test_no_weight_is_no_prior() -> None:
    new = nadir_line(1)
    assert focal_after(new, TRUE_PX, 2.0 * TRUE_PX, 0.0) == focal_after(new, TRUE_PX, None, 100.0)


@pytest.mark.parametrize("change", [{"sigma_rel": 0.0}, {"weight": -1.0}])
def test_senseless_options_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match="out of range"):
        FocalPriorOptions(**change)
