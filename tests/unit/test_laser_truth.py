"""Cameras of a map against those of a laser scan: the file's format, and what a similarity leaves."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from tools.laser_truth import camera_file, compared, true_pose


def test_a_camera_file_gives_the_pose(tmp_path: Path) -> None:
    rotation, center = so3_exp(np.array([0.3, -1.0, 0.2])), np.array([-7.0, 2.0, 0.5])
    rows = [*np.eye(3), np.zeros(3), *rotation, center, (3072, 2048)]
    file = tmp_path / "0003.camera"
    file.write_text("\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows) + "\n")
    assert camera_file(tmp_path, "0003.png") == file
    pose = true_pose(file)
    np.testing.assert_allclose(pose.center, center, atol=1e-6)
    np.testing.assert_allclose(pose.rotation.T, rotation, atol=1e-6)
    with pytest.raises(SystemExit, match="no camera"):
        camera_file(tmp_path, "0004.png")


def test_a_moved_map_is_right_and_a_shifted_camera_is_found() -> None:
    rng = np.random.default_rng(0)
    poses = [Rigid3(rotation=so3_exp(rng.normal(0, 1, 3)), translation=rng.normal(0, 3, 3)) for _ in range(6)]
    truth = {f"{i}.png": pose for i, pose in enumerate(poses)}
    move = Sim3.exp([0.7, 0.2, -0.4, 1.0, 5.0, -3.0, 2.0])
    images = [
        SimpleNamespace(name=name, cam_from_local=move.act_on_pose(pose)) for name, pose in truth.items()
    ]
    exact = compared(SimpleNamespace(images=images), truth)  # type: ignore[arg-type]
    assert exact["largest_mm"] < 1e-3
    assert exact["largest_deg"] < 1e-5
    shifted = truth | {"2.png": Rigid3(rotation=poses[2].rotation, translation=poses[2].translation + 0.05)}
    assert compared(SimpleNamespace(images=images), shifted)["largest_mm"] > 20.0  # type: ignore[arg-type]
