"""A lens that mapping leads to where EXIF's cannot be: mapped again with it held; which of both counts."""

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from ingest.colmap.bridge import read_models, verify_pair
from ingest.sfm import mapper
from ingest.sfm.held_lens import impossible
from ingest.sfm.mapper import SfmOptions, SfmTask, SfmView, reconstruct
from ingest.workspace import write_arrays
from tests.support.scenes import looking_at

TRUE = Camera.from_focal(1000, 700, 900.0, "SIMPLE_RADIAL")


def _flight(folder: Path, exif_px: float, seed: int) -> SfmTask:
    """Nine photos from above, with EXIF's focal length."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform([-45.0, -40.0, 0.0], [45.0, 40.0, 4.0], (1200, 3))
    keypoints: list[FloatArray] = []
    inside = []
    for k in range(9):
        eye = np.array([12.0 * (k % 3 - 1), 10.0 * (k // 3 - 1), 50.0 + rng.uniform(-2, 2)])
        pose = looking_at(eye, eye * [1, 1, 0] + rng.uniform(-2, 2, 3))
        pixels = TRUE.project(pose.act(ground))
        inside.append(((pixels > 0) & (pixels < [TRUE.width, TRUE.height])).all(axis=1))
        keypoints.append(pixels + rng.normal(0.0, 0.3, pixels.shape))
    matches = []
    for i, j in combinations(range(9), 2):
        common = np.flatnonzero(inside[i] & inside[j])
        rows = np.column_stack([common, common]).astype(np.uint32)
        a, b = (keypoints[n].astype(np.float32) for n in (i, j))
        pair = verify_pair(TRUE, a, TRUE, b, rows, focal_known=True, max_error_px=4.0, seed=0)
        file = folder / "matches" / f"{i}_{j}.npz"
        write_arrays(file, pair.arrays())
        matches.append((i, j, file))
    views = []
    for k, xy in enumerate(keypoints):
        file = folder / f"{k}.npz"
        write_arrays(file, {"xy": xy.astype(np.float32)})
        views.append(SfmView(name=f"{k}.jpg", camera_row=0, features=file))
    told = Camera.from_focal(TRUE.width, TRUE.height, exif_px, "SIMPLE_RADIAL")
    return SfmTask(cameras=((told, True),), views=tuple(views), matches=tuple(matches), options=SfmOptions())


def _made(task: SfmTask, folder: Path) -> list[tuple[int, float]]:
    """Photos and focal length of each model with photos."""
    reconstruct(task, folder)
    return [(len(m.rows), m.cameras[0].focal_px) for m in read_models(folder) if len(m.rows)]


def test_photos_that_lead_mapping_astray_are_mapped_with_the_lens_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a bad pair to begin with: the lens has run away, and only four photos fit it."""
    begun = mapper.run_incremental

    def begin(database: Path, images: Path, output: Path, settings: dict[str, Any], *rest: Any) -> Any:
        found = begun(database, images, output, settings, *rest)
        if settings["ba_refine_focal_length"]:
            model = pycolmap.Reconstruction(str(output / "0"))
            for frame_id in sorted(model.reg_frame_ids())[4:]:
                pycolmap.ObservationManager(model).deregister_frame(frame_id)
            camera = model.camera(1)
            camera.params = np.array([6000.0, *camera.params[1:]])
            model.write(str(output / "0"))
        return found

    monkeypatch.setattr(mapper, "run_incremental", begin)
    ((photos, focal_px),) = _made(_flight(tmp_path, 900.0, seed=1), tmp_path / "models")
    assert photos == 9
    assert focal_px == pytest.approx(TRUE.focal_px, rel=0.02)


def test_a_wrong_focal_length_in_exif_makes_no_map_worse(tmp_path: Path) -> None:
    """Held at a third of the true one the photos fit nearly as well, and the map would be taken for right."""
    ((photos, focal_px),) = _made(_flight(tmp_path, 270.0, seed=1), tmp_path / "models")
    assert photos == 9
    assert focal_px == pytest.approx(TRUE.focal_px, rel=0.1)


def test_which_focal_lengths_cannot_be() -> None:
    found = impossible([262.0, 1200.0, 500.0, 900.0, 3500.0], [1265.0, 1265.0, 1265.0, np.nan, 1265.0])
    np.testing.assert_array_equal(found, [True, False, False, False, True])
