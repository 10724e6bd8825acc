"""A focal length that changes within a shot is found by the adjustment; a flight ahead is no zoom."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, Terms
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.adjust import AdjustOptions, lens_prior_of
from ingest.colmap.bridge import Model
from ingest.photos.photo import Photo
from ingest.sfm.zoomed_lenses import focal_runs, zoomed_keys
from tests.support.scenes import box_points, looking_at

ZOOM = [800.0] * 5 + [860.0, 940.0, 1010.0] + [1040.0] * 4


def shot(focals: list[float], step: tuple[float, float, float], seed: int = 0) -> Block:
    """Photos of one camera, taken with these focal lengths, reconstructed as if there were one."""
    rng = np.random.default_rng(seed)
    points = box_points(rng, 400)
    start = np.array([0.0, -45.0, 30.0])
    poses: list[Rigid3] = [
        looking_at(start + k * np.array(step), np.array([0.0, 0.0, 3.0])) for k in range(len(focals))
    ]
    point_of, photo_of, pixels = [], [], []
    for k, (focal, pose) in enumerate(zip(focals, poses, strict=True)):
        xy = Camera.from_focal(960, 720, focal, "SIMPLE_RADIAL").project(pose.act(points))
        rows = np.flatnonzero(((xy > 0.0) & (xy < [960.0, 720.0])).all(axis=1))
        point_of.append(rows)
        photo_of.append(np.full(len(rows), k))
        pixels.append(xy[rows] + rng.normal(0.0, 0.4, (len(rows), 2)))
    seen = np.bincount(np.concatenate(point_of), minlength=len(points)) > 1
    keep = seen[np.concatenate(point_of)]
    camera = Camera.from_focal(960, 720, focals[0], "SIMPLE_RADIAL")
    block = Block(
        names=tuple(f"{k:06d}.jpg" for k in range(len(focals))),
        cameras=(camera,),
        camera_of=np.zeros(len(focals), dtype=np.int64),
        cam_from_block=tuple(poses),
        xyz=points,
        point_of=np.concatenate(point_of)[keep],
        photo_of=np.concatenate(photo_of)[keep],
        xy=np.concatenate(pixels)[keep],
    )
    terms = Terms(
        keypoint_px=0.5,
        lenses=(lens_prior_of(camera, None, AdjustOptions()),),
        held_photos=(0,),
        dilution=50.0,
    )
    problem = Problem(block, terms)
    problem.solve(60, 1e-6)
    return problem.block()


def test_a_zoom_while_the_camera_moves_gives_other_lenses() -> None:
    runs = focal_runs(shot(ZOOM, (4.0, 0.0, 0.0)), 0)
    assert runs is not None
    assert runs.tolist() == [0, 0, 0, 0, 0, 1, 2, 3, 4, 4, 4, 4]


@pytest.mark.parametrize("step", [(4.0, 0.0, 0.0), (0.0, 2.0, -1.0)])
def test_one_focal_length_is_no_zoom(step: tuple[float, float, float]) -> None:
    """Beside what is looked at, and towards it: a picture that grows is not enough."""
    for seed in range(5):
        assert focal_runs(shot([800.0] * 12, step, seed), 0) is None


def test_photos_in_any_order_are_taken_by_name() -> None:
    block = shot(ZOOM, (4.0, 0.0, 0.0))
    order = np.random.default_rng(1).permutation(len(ZOOM))
    place = np.argsort(order)
    mixed = replace(
        block,
        names=tuple(block.names[k] for k in order),
        cam_from_block=tuple(block.cam_from_block[k] for k in order),
        photo_of=place[block.photo_of],
    )
    runs = focal_runs(mixed, 0)
    assert runs is not None
    assert runs.tolist() == [0, 0, 0, 0, 0, 1, 2, 3, 4, 4, 4, 4]


def test_keyframes_of_a_zoom_get_keys_and_other_photos_keep_theirs() -> None:
    block = shot(ZOOM, (4.0, 0.0, 0.0))
    order = np.lexsort((block.photo_of, block.point_of))
    point_of, photo_of, xy = block.point_of[order], block.photo_of[order], block.xy[order]
    keypoint_of, features = np.zeros(len(xy), dtype=np.int64), []
    for k in range(len(ZOOM)):
        mine = photo_of == k
        keypoint_of[mine] = np.arange(mine.sum())
        features.append(SimpleNamespace(features=SimpleNamespace(xy=xy[mine])))
    model = Model(
        cameras=block.cameras,
        rows=np.arange(len(ZOOM)),
        camera_of=block.camera_of,
        cam_from_sfm=block.cam_from_block,
        xyz=block.xyz,
        point_of=point_of,
        photo_of=photo_of,
        keypoint_of=keypoint_of,
    )
    photos = [
        Photo(name=name, path=Path(name), camera_key="film|a", film="a.mp4", width=960, height=720)
        for name in block.names
    ]
    keys = zoomed_keys([model], photos, features)  # type: ignore[arg-type]
    numbers = [0, 0, 0, 0, 0, 1, 2, 3, 4, 4, 4, 4]
    assert keys == {name: f"film|a zoom {n}" for name, n in zip(block.names, numbers, strict=True)}
    assert zoomed_keys([model], [replace(p, film="") for p in photos], features) == {}  # type: ignore[arg-type]
    known = [replace(p, focal_px=800.0) for p in photos]
    assert zoomed_keys([model], known, features) == {}  # type: ignore[arg-type]


def test_two_photos_say_nothing() -> None:
    assert focal_runs(shot([800.0, 1040.0], (4.0, 0.0, 0.0)), 0) is None
