"""The vertical of a map without a place, from how its photos were held."""

import numpy as np

from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from ingest.own_frame import as_looked_at, held_of, vertical_of
from tests.support.planar_map import view


def _turned(poses: list[Rigid3], world_turn: np.ndarray) -> list[Rigid3]:
    return [Rigid3(rotation=p.rotation @ world_turn.T, translation=p.translation) for p in poses]


def test_level_photos_tell_up_in_any_frame_of_theirs() -> None:
    rng = np.random.default_rng(3)
    turn = so3_exp(rng.normal(0, 2, 3))
    for tilt in (0.0, 45.0, 85.0):
        poses = [
            Rigid3(rotation=so3_exp([0, 0, rng.normal(0, 0.01)]) @ p.rotation, translation=p.translation)
            for p in (view(e, 0, 40, tilt, heading) for e, heading in enumerate(range(0, 360, 30)))
        ]
        up = vertical_of(_turned(poses, turn))
        assert up is not None
        assert np.degrees(np.arccos(np.clip(up @ turn @ [0, 0, 1], -1.0, 1.0))) < 1.0


def test_a_photo_held_upright_among_level_ones_does_not_count() -> None:
    rng = np.random.default_rng(4)
    poses = [view(e, 0, 2, 85.0, h) for e, h in enumerate(range(0, 180, 15))]
    poses[3] = Rigid3(rotation=so3_exp([0, 0, np.pi / 2]) @ poses[3].rotation, translation=np.zeros(3))
    poses = [
        Rigid3(rotation=so3_exp([0, 0, rng.normal(0, 0.01)]) @ p.rotation, translation=p.translation)
        for p in poses
    ]
    up = vertical_of(poses)
    assert up is not None
    assert np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))) < 1.0


def test_photos_that_all_look_one_way_do_not_tell_up() -> None:
    rng = np.random.default_rng(5)
    poses = [
        Rigid3(
            rotation=so3_exp(rng.normal(0, 0.02, 3)) @ view(e, 0, 40, 0.0, 0.0).rotation,
            translation=np.zeros(3),
        )
        for e in range(12)
    ]
    assert vertical_of(poses) is None


def test_photos_held_upright_tell_up_by_their_orientation() -> None:
    """Half of them are stored lying on a side, either one, and EXIF says so."""
    rng = np.random.default_rng(6)
    level = [
        Rigid3(rotation=so3_exp([0, 0, rng.normal(0, 0.01)]) @ p.rotation, translation=p.translation)
        for p in (view(e, 0, 2, 85.0, h) for e, h in enumerate(range(0, 180, 15)))
    ]
    # Stored turned by a quarter to the left, to be looked at turned to the right (6); and the other way (8).
    orientations = [1, 6, 6, 8] * 3
    stored = [
        Rigid3(
            rotation=so3_exp([0, 0, {1: 0.0, 6: -np.pi / 2, 8: np.pi / 2}[o]]) @ p.rotation,
            translation=p.translation,
        )
        for p, o in zip(level, orientations, strict=True)
    ]
    assert vertical_of(stored) is None
    up = vertical_of(as_looked_at(stored, orientations))
    assert up is not None
    assert np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0))) < 1.0
    held = held_of(stored, (), None, orientations)
    assert held is not None
    assert len(held.directions) == len(stored)
    assert held.down[2] < 0.0
