"""Photos of a small simulated town registered to its scan; a photo that does not belong is refused."""

import re
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.errors import ImageError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.render.cloud import PointCloud
from featuredb.simworld.camera.photograph import render_view
from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.town.town import make_town
from ingest.register.frame.register import register_frame
from ingest.register.frame.views import FrameOptions, available_sources, turned_about_vertical
from ingest.register.frame_registration import FramePrior
from tests.support.clouds import build_cloud

CAMERA = Camera(model="SIMPLE_RADIAL", width=800, height=600, params=(640.0, 398.0, 303.0, 0.02))
OPTIONS = FrameOptions(threads=1)


@dataclass(frozen=True)
class Place:
    """A town's scan with and without colour, and a photo with its true pose."""

    coloured: PointCloud
    intensity: PointCloud
    photo: NDArray[np.uint8]
    truth: Rigid3


@lru_cache(maxsize=1)
def place() -> Place:
    """A photo from 55 m, 30 degrees off the nadir; colours from one exact nadir view."""
    scene = make_town(5, size_m=(160.0, 150.0), texel_m=0.1)
    scan = scan_town(scene, AirborneScanOptions(seed=5, margin_m=0.0, density_per_m2=6.0))
    keep = ~scan.outlier
    xyz, raw = scan.xyz[keep], scan.intensity[keep].astype(np.float64)
    low, high = np.percentile(raw, (1, 99))
    grey = np.clip((raw - low) / (high - low) * 255.0, 0, 255).astype(np.uint8)
    down = np.diag([1.0, -1.0, -1.0])
    over = Rigid3(rotation=down, translation=-down @ np.array([0.0, 0.0, 400.0]))
    wide = Camera(model="SIMPLE_PINHOLE", width=900, height=800, params=(2200.0, 450.0, 400.0))
    above = render_view(scene, wide, over, moment=3)
    pixels = np.clip(np.floor(wide.project(over.act(xyz))).astype(int), 0, (899, 799))
    rgb = above[pixels[:, 1], pixels[:, 0]]
    rotation = so3_exp([0.0, 0.0, 0.6]) @ so3_exp([-0.5, 0.0, 0.0]) @ down @ so3_exp([0.0, 0.0, 0.4])
    truth = Rigid3(rotation=rotation, translation=-rotation @ np.array([6.0, -18.0, 55.0]))
    photo = cv2.cvtColor(render_view(scene, CAMERA, truth, moment=1), cv2.COLOR_RGB2GRAY)
    return Place(
        coloured=build_cloud(scan.frame, "ellipsoidal", xyz, rgb=rgb),
        intensity=build_cloud(scan.frame, "ellipsoidal", xyz, intensity=grey),
        photo=np.asarray(photo, dtype=np.uint8),
        truth=truth,
    )


def prior_off(truth: Rigid3, metres: float, degrees: float, heading_sigma: float = 6.0) -> FramePrior:
    rotation = truth.rotation @ so3_exp(np.radians(degrees) * np.array([0.6, -0.48, 0.64]))
    center = truth.center + metres * np.array([0.64, 0.6, 0.48])
    return FramePrior(
        cam_from_local=Rigid3(rotation=rotation, translation=-rotation @ center),
        sigma_horizontal_m=9.0,
        sigma_vertical_m=9.0,
        sigma_heading_deg=heading_sigma,
        sigma_tilt_deg=6.0,
    )


def test_coloured_scan_from_a_prior_wrong_by_15_m_and_10_degrees() -> None:
    here = place()
    found = register_frame(here.photo, CAMERA, prior_off(here.truth, 15.0, 10.0), here.coloured, OPTIONS)
    assert found.accepted, found.message
    assert found.cam_from_local is not None
    assert found.covariance is not None
    assert np.linalg.norm(found.cam_from_local.center - here.truth.center) < 0.05
    assert found.cam_from_local.angle_to_deg(here.truth) < 0.05
    error = (here.truth @ found.cam_from_local.inverse()).log()
    assert error @ np.linalg.solve(found.covariance, error) < 40.0  # 1 in a million of chi-square over six
    assert found.source == "rgb"
    assert found.camera == CAMERA
    residual = CAMERA.project(found.cam_from_local.act(found.points_local)) - found.pixels
    assert np.median(np.linalg.norm(residual, axis=1)) < 3.0
    assert {"search prior's view", "fit", "confirm", "verdict"} <= set(found.seconds)


def test_a_heading_that_nobody_knows_is_found() -> None:
    here = place()
    prior = prior_off(here.truth, 10.0, 6.0, heading_sigma=180.0)
    turned = turned_about_vertical(prior.cam_from_local, 140.0)
    found = register_frame(here.photo, CAMERA, replace(prior, cam_from_local=turned), here.coloured, OPTIONS)
    assert found.cam_from_local is not None, found.message
    assert np.linalg.norm(found.cam_from_local.center - here.truth.center) < 0.05


def test_prior_over_nothing_finds_no_scan() -> None:
    here = place()
    away = prior_off(here.truth, 4000.0, 0.0)
    found = register_frame(here.photo, CAMERA, away, here.coloured, OPTIONS)
    assert found.reason == "NO_SCAN"
    assert found.cam_from_local is None
    assert re.search(
        r"0 % of what the prior sees and lies \d\.\d km to the south-west of the camera", found.message
    )


def test_prior_that_claims_too_much_is_contradicted() -> None:
    here = place()
    prior = prior_off(here.truth, 8.0, 2.0)
    sharp = FramePrior(
        cam_from_local=prior.cam_from_local,
        sigma_horizontal_m=0.5,
        sigma_vertical_m=0.5,
        sigma_heading_deg=6.0,
        sigma_tilt_deg=6.0,
    )
    assert register_frame(here.photo, CAMERA, sharp, here.coloured, OPTIONS).reason == "CONTRADICTS_PRIOR"


def test_image_of_another_size_is_an_error() -> None:
    here = place()
    with pytest.raises(ImageError, match="800x600"):
        register_frame(here.photo[:-1], CAMERA, prior_off(here.truth, 1.0, 1.0), here.coloured, OPTIONS)


def test_sources_follow_what_the_scan_has() -> None:
    assert available_sources(place().coloured) == ("rgb", "shaded")
    assert available_sources(place().intensity) == ("intensity", "shaded")


@pytest.mark.evaluation
def test_intensity_alone_from_a_wrong_prior() -> None:
    """The pose is found; so small and wide a photo is at the limit of what is believed."""
    here = place()
    found = register_frame(here.photo, CAMERA, prior_off(here.truth, 15.0, 10.0), here.intensity, OPTIONS)
    pose = Rigid3.from_matrix(found.evidence["pose_tried"])
    assert np.linalg.norm(pose.center - here.truth.center) < 0.6
    assert pose.angle_to_deg(here.truth) < 0.6
    assert found.evidence["confirmation"]["confirmed"]
    assert found.evidence["confirmation"]["log_nfa"] > 9.0  # more than photos of other towns reach


@pytest.mark.slow
def test_mirrored_photo_is_refused() -> None:
    here = place()
    mirrored = np.ascontiguousarray(here.photo[:, ::-1])
    found = register_frame(mirrored, CAMERA, prior_off(here.truth, 5.0, 3.0), here.intensity, OPTIONS)
    assert not found.accepted
