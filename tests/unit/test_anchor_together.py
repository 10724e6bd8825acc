"""All photos of a map registered to a scan at once."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.anchor import together
from ingest.register.anchor.together import register_together
from ingest.register.frame.dense.confirmation import JointEvidence, evidence_of
from tests.support.scanned_map import plain_cloud

LENS = Camera(model="PINHOLE", width=480, height=360, params=(400.0, 400.0, 240.0, 180.0))
_SIDE_M, _CELL_M, _GROUND_M = 160.0, 0.4, 30.0
# The map lies off by this, within what its placement says.
OFF = Sim3(scale=1.01, rotation=so3_exp(np.radians([3.0, -4.0, 6.0])), translation=np.array([7.0, -9.0, 3.0]))


def _town(seed: int) -> NDArray[np.float32]:
    """Blocks and lanes, of no repeating pattern."""
    rng = np.random.default_rng(seed)
    size = int(_SIDE_M / _CELL_M)
    town = np.full((size, size), 120.0, np.float32)
    for _ in range(260):
        box = cv2.boxPoints(
            (tuple(rng.uniform(0, size, 2)), tuple(rng.uniform(8, 34, 2)), float(rng.uniform(0, 90)))
        )
        cv2.fillPoly(town, [box.astype(np.int32)], float(rng.uniform(20, 240)))
    return town


def _cloud(town: NDArray[np.float32]) -> PointCloud:
    rng = np.random.default_rng(1)
    plan = rng.uniform(0.0, _SIDE_M, (90_000, 2))
    row, column = (plan[:, ::-1] / _CELL_M).astype(np.int64).T
    bare = plain_cloud(np.column_stack([plan, np.full(len(plan), _GROUND_M)]))
    return replace(bare, intensity=town[row, column].astype(np.uint8))


def _photos(town: NDArray[np.float32]) -> tuple[list[Rigid3], list[NDArray[np.uint8]], NDArray[np.float64]]:
    """Poses, pictures of other contrast than the scan's, and points on the ground."""
    rng = np.random.default_rng(2)
    poses, pictures, points = [], [], []
    x, y = np.meshgrid(np.arange(LENS.width) + 0.5, np.arange(LENS.height) + 0.5)
    rays = np.column_stack([LENS.unproject(np.column_stack([x.ravel(), y.ravel()])), np.ones(x.size)])
    for k in range(4):
        center = np.array([66.0 + 18.0 * (k % 2), 70.0 + 18.0 * (k // 2), _GROUND_M + 30.0])
        rotation = np.diag([1.0, -1.0, -1.0]) @ so3_exp([0.0, 0.0, rng.uniform(-0.2, 0.2)])
        pose = Rigid3(rotation=rotation, translation=-rotation @ center)
        ground = pose.inverse().act(30.0 * rays)
        at = (ground[:, :2] / _CELL_M - 0.5).reshape(LENS.height, LENS.width, 2).astype(np.float32)
        seen = np.abs(cv2.remap(town, at[..., 0], at[..., 1], cv2.INTER_LINEAR) - 140.0)
        poses.append(pose)
        pictures.append(seen.astype(np.uint8))
        points.append(ground[rng.integers(0, len(ground), 200)])
    return poses, pictures, np.vstack(points)


def _misplaced(poses: list[Rigid3], points: NDArray[np.float64]) -> Any:
    """A map whose frame is the scan's, moved by `OFF` about its middle."""
    middle = points.mean(axis=0)
    about = Sim3(scale=1.0, rotation=np.eye(3), translation=middle)
    move = about @ OFF @ about.inverse()
    images = [
        MapImage(image_id=k, name=str(k), sha256="", camera_id=0, cam_from_local=move.act_on_pose(pose))
        for k, pose in enumerate(poses)
    ]
    sigmas = [0.02, *np.radians([4.0, 4.0, 5.0]), 8.0, 8.0, 5.0]
    covariance = Sim3(scale=1.0, rotation=np.eye(3), translation=move.act(middle)).carried(
        np.diag(np.square(sigmas))
    )
    moved = move.act(points)
    seen = np.repeat(np.arange(len(poses)), 200)
    return SimpleNamespace(
        images=images,
        cameras=(LENS,),
        points_local=lambda _=None: moved,
        points_in=lambda image: np.flatnonzero(seen == image.image_id),
        placement=SimpleNamespace(covariance=covariance),
        move=move,
    )


def test_a_map_is_placed_by_all_its_photos() -> None:
    town = _town(3)
    poses, pictures, points = _photos(town)
    feature_map = _misplaced(poses, points)
    found = register_together(
        feature_map, feature_map.images, _cloud(town), lambda image: pictures[image.image_id], 2
    )
    assert found is not None
    assert len(found) == 2
    for image_id, registration in found.items():
        assert registration.cam_from_local is not None
        assert np.linalg.norm(registration.cam_from_local.center - poses[image_id].center) < 0.3
        assert registration.cam_from_local.angle_to_deg(poses[image_id]) < 0.5


@pytest.mark.parametrize("other", ["another town", "mirrored photos"])
def test_where_the_scan_shows_something_else_nothing_is_placed(
    other: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, pictures, points = _photos(_town(3))
    feature_map = _misplaced(poses, points)
    if other == "mirrored photos":
        pictures = [np.ascontiguousarray(picture[:, ::-1]) for picture in pictures]
    cloud = _cloud(_town(3 if other == "mirrored photos" else 8))
    asked: list[JointEvidence] = []

    def kept(*args: Any) -> JointEvidence:
        asked.append(evidence_of(*args))
        return asked[-1]

    monkeypatch.setattr(together, "evidence_of", kept)
    found = register_together(
        feature_map, feature_map.images, cloud, lambda image: pictures[image.image_id], 2
    )
    assert found is None
    assert max(one.places for one in asked) > 10


def test_chance_passes_at_its_rate() -> None:
    """Places of which as many agree by chance as elsewhere."""
    rng = np.random.default_rng(4)
    passed = 0
    for _ in range(4000):
        share = rng.uniform(0.03, 0.2)
        drawn = [JointEvidence(places=n, agreeing=float(rng.binomial(n, share))) for n in [25] * 13]
        best = max(range(4), key=lambda k: drawn[k].agreeing)  # the others are turned by right angles
        others = [one for k, one in enumerate(drawn) if k != best]
        passed += drawn[best].log_nfa(others, 4) >= 3.0
    assert passed <= 10


def test_more_that_agrees_says_more() -> None:
    empty = [JointEvidence(places=25, agreeing=0.2)] * 6
    said = [JointEvidence(places=40, agreeing=float(k)).log_nfa(empty, 4) for k in range(41)]
    assert np.isfinite(said).all()
    assert np.diff(said[4:]).min() > 0.0


def test_what_agrees_elsewhere_as_well_says_nothing() -> None:
    found = JointEvidence(places=25, agreeing=12.0)
    empty = JointEvidence(places=25, agreeing=0.5)
    assert found.log_nfa([empty] * 5, 4) > 6.0
    assert found.log_nfa([empty] * 4 + [found], 4) < found.log_nfa([empty] * 5, 4) - 2.0
    assert JointEvidence(places=0, agreeing=0.0).log_nfa([], 1) == 0.0
