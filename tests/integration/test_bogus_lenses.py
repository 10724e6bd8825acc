"""Reconstructions whose focal length has run away are not taken for reconstructions."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.adjust import AdjustOptions, Known, _bundle, _drop_bogus_lenses
from ingest.colmap.bridge import SfmPhoto, posed, read_models

CAMERA = Camera(model="SIMPLE_RADIAL", width=1000, height=800, params=(900.0, 500.0, 400.0, 0.01))


def written(folder: Path, focal_px: float) -> Path:
    """A model of two photos of one camera each; the second camera has this focal length."""
    folder.mkdir(parents=True)
    photos = [SfmPhoto(name=f"{k}.jpg", camera_row=k, keypoints=np.zeros((4, 2), np.float32)) for k in (0, 1)]
    posed([CAMERA, CAMERA], photos, dict.fromkeys((0, 1), Rigid3.identity())).write(str(folder))
    model = pycolmap.Reconstruction(str(folder))
    camera = model.camera(2)
    camera.params = np.array([focal_px, *camera.params[1:]])
    model.write(str(folder))
    return folder


def test_a_model_without_a_possible_lens_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    written(tmp_path / "0", 900.0)
    written(tmp_path / "1", 2e7)
    (model,) = read_models(tmp_path)
    assert len(model.rows) == 2
    assert "found [20000000.0" in caplog.text


@pytest.mark.parametrize(("focal_px", "left"), [(900.0, [1, 2]), (9_000.0, [1, 2]), (2e5, [1]), (50.0, [1])])
def test_photos_with_a_bogus_lens_are_not_registered(
    tmp_path: Path, focal_px: float, left: list[int]
) -> None:
    model = pycolmap.Reconstruction(str(written(tmp_path / "0", focal_px)))
    _drop_bogus_lenses(model)
    assert sorted(model.reg_image_ids()) == left


def test_a_lens_that_ran_away_does_not_end_the_adjustment(tmp_path: Path) -> None:
    """The photos of other lenses would be lost with it."""
    model = pycolmap.Reconstruction(str(written(tmp_path / "0", 2e7)))
    _bundle(model, Known(photos=()), 2.0, AdjustOptions(), (1e-4,))
    assert sorted(model.reg_image_ids()) == [1]
