"""Cameras of a map against those of a laser scan: the file's format, the upright world, the figures."""

from pathlib import Path

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from tools.figures import pose_errors
from tools.laser_set import centers, robust_similarity, true_camera, true_pose, upright
from tools.laser_truth import Errors, figures_of


def _poses() -> dict[str, Rigid3]:
    rng = np.random.default_rng(0)
    return {
        f"{i}.jpg": Rigid3(rotation=so3_exp(rng.normal(0, 0.3, 3)), translation=rng.normal(0, 3, 3))
        for i in range(8)
    }


def test_a_camera_file_gives_pose_and_lens(tmp_path: Path) -> None:
    rotation, center = so3_exp(np.array([0.3, -1.0, 0.2])), np.array([-7.0, 2.0, 0.5])
    lens = np.array([[2760.0, 0, 1520.7], [0, 2764.0, 1006.8], [0, 0, 1]])
    rows = [*lens, np.zeros(3), *rotation, center, (3072, 2048)]
    file = tmp_path / "0003.camera"
    file.write_text("\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows) + "\n")
    pose = true_pose(file)
    np.testing.assert_allclose(pose.center, center, atol=1e-6)
    np.testing.assert_allclose(pose.rotation.T, rotation, atol=1e-6)
    # The middle of the picture is (1535.5, 1023.5) there, and (768, 512) in half the size here.
    np.testing.assert_allclose(true_camera(file, 1536, 1024).params, (1380, 1382, 760.6, 503.65))


def test_the_world_is_turned_upright() -> None:
    poses = _poses()
    local = upright(poses)
    up = -np.sum([pose.rotation[1] for pose in local.values()], axis=0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(centers(list(local.values())).mean(axis=0), 0.0, atol=1e-12)
    before, after = (
        [p[a] @ p[b].inverse() for a, b in zip(p, list(p)[1:], strict=False)] for p in (poses, local)
    )
    for one, other in zip(before, after, strict=True):
        np.testing.assert_allclose(one.matrix(), other.matrix(), atol=1e-9)


def test_a_moved_model_is_right_and_a_shifted_camera_is_found() -> None:
    truth = _poses()
    move = Sim3.exp([0.7, 0.2, -0.4, 1.0, 5.0, -3.0, 2.0])
    model = {name: move.act_on_pose(pose) for name, pose in truth.items()}
    back = robust_similarity(centers(list(model.values())), centers(list(truth.values())))
    exact = pose_errors({name: back.act_on_pose(pose) for name, pose in model.items()}, truth)
    assert max(exact[0]) < 1e-6
    assert max(exact[1]) < 1e-5
    shifted = truth | {
        "2.jpg": Rigid3(rotation=truth["2.jpg"].rotation, translation=truth["2.jpg"].translation + 0.05)
    }
    assert max(pose_errors(shifted, truth)[0]) == pytest.approx(0.05 * 3**0.5)


@pytest.mark.parametrize(
    ("told_m", "colmap_m", "found", "worst"),
    [
        (0.01, 0.01, 2, 1.0),
        (0.001, 0.01, 2, 10.0),
        (0.01, 0.002, 2, 5.0),
        (0.01, 0.01, 1, np.finfo(float).max),
    ],
)
def test_the_worst_ratio_is_to_the_baseline_to_the_report_or_a_loss(
    told_m: float, colmap_m: float, found: int, worst: float
) -> None:
    mine = Errors(metres=(0.01,) * found, degrees=(0.1,) * found, told_m=(told_m,), told_deg=(0.1,), wanted=2)
    theirs = Errors(metres=(colmap_m,), degrees=(0.1,))
    figures = figures_of({"map": mine}, {"map": theirs, "asked": theirs})
    assert figures["worst"] == pytest.approx(worst)
