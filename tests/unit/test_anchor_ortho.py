"""A picture from above is found by its edges in one of other brightness, and its mirror image is not."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import MapImage
from featuredb.maps.move import moved_image
from featuredb.maps.unplaced_map import OwnFrame
from ingest.register.anchor.files import PhotoFiles
from ingest.register.anchor.start import from_ortho
from ingest.register.anchor.start.from_ortho import best_place, found_by_ortho
from ingest.register.anchor.start.ortho import FloatImage, OrthoPicture
from tests.support.scanned_map import plain_cloud

_SIDE, _CELL_M = 180, 1.1
_TURN, _SIZE_M = np.radians(131.0), 0.62  # of the cells of the map's picture
_AT = np.array([108.0, 84.0])  # its middle on the scan, cells


def _town(seed: int) -> FloatImage:
    """Ground, streets and roofs, each of a brightness of its own."""
    rng = np.random.default_rng(seed)
    picture = np.full((_SIDE, _SIDE), 90.0, np.float32)
    for _ in range(9):
        start, end = rng.integers(0, _SIDE, (2, 2))
        cv2.line(picture, start.tolist(), end.tolist(), float(rng.uniform(20, 60)), 5)
    for _ in range(60):
        center, size = rng.uniform(0, _SIDE, 2).tolist(), rng.uniform(8, 22, 2).tolist()
        roof = cv2.boxPoints((center, size, float(rng.uniform(0, 90))))
        cv2.fillPoly(picture, [np.round(roof).astype(np.int32)], float(rng.uniform(100, 250)))
    return picture


def _picture(gray: FloatImage, cell: float) -> OrthoPicture:
    valid = np.ones(gray.shape, np.bool_)
    return OrthoPicture(
        gray=gray, valid=valid, height=np.zeros(gray.shape), corner=np.array([40.0, -7.0]), cell=cell
    )


def _of_photos(town: FloatImage, side: int = 130, at: FloatArray = _AT) -> OrthoPicture:
    """A part of the town turned and in finer cells, bright where the scan is dark and in between."""
    cos, sin = np.cos(_TURN) * _SIZE_M / _CELL_M, np.sin(_TURN) * _SIZE_M / _CELL_M
    turn = np.array([[cos, -sin], [sin, cos]])
    whole = np.column_stack([turn, at - turn @ [side / 2, side / 2]])
    whole[:, 2] += turn @ [0.5, 0.5] - 0.5  # OpenCV's half pixel
    part = cv2.warpAffine(town, whole, (side, side), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    noise = np.random.default_rng(5).normal(0.0, 4.0, part.shape)
    return _picture(np.asarray(np.abs(part - 140.0) + noise, np.float32), cell=0.3)


@pytest.fixture(autouse=True)
def _few_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(from_ortho, "_LEAST_SHARE", 0.28)
    monkeypatch.setattr(from_ortho, "_SIZE_STEP", 0.1)
    monkeypatch.setattr(from_ortho, "_TURN_STEP", np.radians(8.0))
    monkeypatch.setattr(from_ortho, "_AGAIN", 8)


def test_a_picture_is_found_by_its_edges() -> None:
    town = _town(1)
    found = best_place(_of_photos(town), _picture(town, _CELL_M))
    assert found is not None
    found, over_chance, elsewhere = found
    assert over_chance > 1.5 * elsewhere
    assert found.size == pytest.approx(_SIZE_M, rel=0.04)
    assert np.degrees(found.turn) % 360.0 == pytest.approx(131.0, abs=3.0)
    assert np.linalg.norm(found.middle - ([40.0, -7.0] + _AT * _CELL_M)) < 3.0


def test_a_round_picture_is_found_in_the_corner_of_the_scan() -> None:
    """The corners of its file would lie beside the scan."""
    town, at = _town(1), np.array([40.0, 41.0])
    picture = _of_photos(town, at=at)
    row, column = np.mgrid[: picture.gray.shape[0], : picture.gray.shape[1]] + 0.5 - picture.gray.shape[0] / 2
    found = best_place(replace(picture, valid=np.hypot(row, column) < 62.0), _picture(town, _CELL_M))
    assert found is not None
    found, over_chance, elsewhere = found
    assert over_chance > 1.2 * elsewhere
    assert found.size == pytest.approx(_SIZE_M, rel=0.04)
    assert np.linalg.norm(found.middle - ([40.0, -7.0] + at * _CELL_M)) < 3.0


def test_a_mirrored_picture_is_not_found() -> None:
    town = _town(1)
    found = best_place(_of_photos(town).mirrored(), _picture(town, _CELL_M))
    assert found is not None
    assert found[1] < found[2]


def test_on_a_scan_of_a_few_cells_nothing_is_found() -> None:
    town = _town(1)
    assert best_place(_of_photos(town), _picture(np.ascontiguousarray(town[:12, :12]), _CELL_M)) is None


def test_a_map_is_found_by_its_photo(tmp_path: Path) -> None:
    """A photo of the town from above, 40 m up in a frame of its own, and the town as a laser saw it."""
    town = _town(4)
    side_m = _SIDE * _CELL_M
    rng = np.random.default_rng(1)
    plan = rng.uniform(0.0, side_m, (40_000, 2))
    row, column = (plan[:, ::-1] / _CELL_M).astype(np.int64).T
    bare = plain_cloud(np.column_stack([plan, np.full(len(plan), 30.0)]))
    cloud = replace(bare, intensity=town[row, column].astype(np.uint8))
    # A camera 100 m above, looking down, its image's top to the south-west.
    lens = Camera(model="PINHOLE", width=400, height=300, params=(400.0, 400.0, 200.0, 150.0))
    center = np.array([95.0, 105.0, 130.0])
    rotation = np.diag([1.0, -1.0, -1.0]) @ so3_exp([0.0, 0.0, np.radians(140.0)])
    pose = Rigid3(rotation=rotation, translation=-rotation @ center)
    x, y = np.meshgrid(np.arange(400) + 0.5, np.arange(300) + 0.5)
    rays = np.column_stack([lens.unproject(np.column_stack([x.ravel(), y.ravel()])), np.ones(x.size)])
    seen = pose.inverse().act(100.0 * rays)[:, :2] / _CELL_M - 0.5
    at = seen.reshape(300, 400, 2).astype(np.float32)
    photo = np.abs(cv2.remap(town, at[..., 0], at[..., 1], cv2.INTER_LINEAR) - 140.0)
    assert cv2.imwrite(str(tmp_path / "a.png"), photo.astype(np.uint8))
    own_from_local = Sim3(
        scale=0.4, rotation=so3_exp([0.0, 0.0, 1.0]), translation=np.array([7.0, -3.0, 5.0])
    )
    ground = pose.inverse().act(100.0 * rays[rng.integers(0, len(rays), 900)])
    image = MapImage(image_id=0, name="a.png", sha256="", camera_id=0, cam_from_local=pose)
    unplaced: Any = SimpleNamespace(
        frame=OwnFrame(metric=False, upright=True),
        points=SimpleNamespace(xyz=own_from_local.act(ground)),
        images=(moved_image(image, own_from_local),),
        cameras=(lens,),
    )
    photos = PhotoFiles(folder=tmp_path, paths={0: tmp_path / "a.png"}, missing={})
    found = found_by_ortho(unplaced, cloud, photos)
    assert found is not None
    off = found.local_from_own @ own_from_local
    assert off.scale == pytest.approx(1.0, rel=0.03)
    assert np.degrees(np.abs(off.log()[1:4])).max() < 3.0
    assert np.linalg.norm(off.act(ground.mean(axis=0)) - ground.mean(axis=0)) < 4.0
