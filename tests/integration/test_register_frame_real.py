"""A real drone photo registered to a real scan, from EXIF alone and from a wrong prior."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from ingest.register.frame.register import register_frame
from ingest.register.frame.views import FrameOptions
from tools.commands import cloud_of
from tools.frame_real_photos import exif_prior, lens, wrong_prior

# Of all 18 photos, by bundle adjustment.
LENS = "SIMPLE_RADIAL:2916.2,2011.0,1153.6,0.02"


@pytest.mark.real_data
@pytest.mark.evaluation
def test_two_priors_end_at_one_pose(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "brighton"
    cloud = cloud_of(folder / "model.laz", tmp_path / "db")
    data = (folder / "images" / "DJI_0026.JPG").read_bytes()
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    camera = lens(LENS, image.shape[1], image.shape[0])
    options = FrameOptions(threads=1)
    first = register_frame(image, camera, exif_prior(data, cloud), cloud, options)
    assert first.cam_from_local is not None, first.message
    prior = wrong_prior(first.cam_from_local, np.random.default_rng(0))
    second = register_frame(image, camera, prior, cloud, options)
    assert second.cam_from_local is not None, second.message
    assert np.linalg.norm(second.cam_from_local.center - first.cam_from_local.center) < 0.05
    assert second.cam_from_local.angle_to_deg(first.cam_from_local) < 0.05
    assert len(second.pixels) > 300
