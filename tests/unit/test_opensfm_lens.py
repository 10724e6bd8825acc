"""Lenses go to OpenSfM and come back: they draw the same pixels."""

from typing import Any

import numpy as np
import pytest

from featuredb.errors import IngestError
from featuredb.export.formats.opensfm import opensfm_camera
from featuredb.geometry.camera import Camera
from ingest.models_in.opensfm_parts import camera_from_opensfm
from tests.integration.test_export_opensfm import CAMERAS


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_every_lens_comes_back(camera: Camera) -> None:
    back = camera_from_opensfm(opensfm_camera(camera), "here")
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (50, 2)), np.ones(50)])
    np.testing.assert_allclose(back.project(points), camera.project(points), atol=1e-9)


def test_opensfms_own_fisheye() -> None:
    """r = f theta (1 + k1 theta^2 + k2 theta^4); at 45 degrees to the right, by hand."""
    entry = {"projection_type": "fisheye", "width": 1000, "height": 800, "focal": 0.5, "k1": 0.1, "k2": 0.01}
    theta = np.pi / 4
    right = 500.0 + 500.0 * theta * (1 + 0.1 * theta**2 + 0.01 * theta**4)
    np.testing.assert_allclose(camera_from_opensfm(entry, "here").project((1.0, 0.0, 1.0)), [[right, 400.0]])


GOOD = {"projection_type": "perspective", "width": 1000, "height": 800, "focal": 0.9, "k1": 0.0, "k2": 0.0}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"projection_type": "spherical"}, "found 'spherical'.*undistort"),
        ({"projection_type": "dual"}, "undistort"),
        ({"projection_type": "brown"}, "expected focal_x and focal_y"),
        ({"focal": float("nan")}, "focal: .*finite number, found nan"),
        ({"focal": -0.9}, "focal length"),
        ({"focal": 10**400}, "focal: .*valid number"),
        ({"focal": True}, "focal: .*valid number, found True"),
        ({"k1": "0"}, "k1: .*valid number, found '0'"),
        ({"width": 1000.5}, "width: .*fractional part, found 1000.5"),
        ({"width": 1e12}, "whole number"),
        ({"height": 0}, "whole number"),
    ],
)
def test_what_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(IngestError, match=message):
        camera_from_opensfm(GOOD | change, "here")
