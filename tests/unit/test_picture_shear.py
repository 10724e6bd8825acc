"""What a rolling shutter leaves in residuals, against pictures that are sheared by a known amount."""

from dataclasses import replace

import numpy as np
import pytest

from featuredb.adjust.terms import Block
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.colmap.picture_shear import picture_shear

_PHOTOS, _POINTS = 6, 400


def block() -> Block:
    """Photos that look down at one field of points, without noise."""
    rng = np.random.default_rng(3)
    camera = Camera.from_focal(1200, 900, 1000.0, "OPENCV")
    xyz = np.column_stack([rng.uniform(-20, 20, (_POINTS, 2)), rng.uniform(-2, 2, _POINTS)])
    poses = tuple(
        Rigid3(rotation=np.diag([1.0, -1.0, -1.0]), translation=np.array([k - 2.5, 0.0, 40.0]))
        for k in range(_PHOTOS)
    )
    photo_of, point_of = (v.ravel() for v in np.indices((_PHOTOS, _POINTS)))
    xy = np.concatenate([camera.project(pose.act(xyz)) for pose in poses])
    return Block(
        names=tuple(f"{k}.jpg" for k in range(_PHOTOS)),
        cameras=(camera,),
        camera_of=np.zeros(_PHOTOS, dtype=np.int64),
        cam_from_block=poses,
        xyz=xyz,
        point_of=point_of.astype(np.int64),
        photo_of=photo_of.astype(np.int64),
        xy=xy,
    )


@pytest.mark.parametrize("rows", [(0.004, 0.0), (0.0, 0.004), (0.003, -0.003)])
def test_half_of_a_displacement_by_rows_is_a_shear(rows: tuple[float, float]) -> None:
    """The other half is what poses take: here the shear alone is put in, of changing sign."""
    exact = block()
    sign = np.where(exact.photo_of % 2, 1.0, -1.0)
    x, y = (exact.xy - [600.0, 450.0]).T
    across, along = 0.5 * rows[0] * sign, -0.5 * rows[1] * sign
    sheared = np.column_stack([across * y + along * x, across * x - along * y])
    noise = np.random.default_rng(4).normal(0.0, 0.2, sheared.shape)
    found = picture_shear(replace(exact, xy=exact.xy + sheared + noise))
    assert found.across == pytest.approx(abs(rows[0]) / 2, abs=1e-4)
    assert found.along == pytest.approx(abs(rows[1]) / 2, abs=1e-4)


def test_noise_and_a_few_wrong_observations_are_no_shear() -> None:
    exact = block()
    rng = np.random.default_rng(5)
    xy = exact.xy + rng.normal(0.0, 0.3, exact.xy.shape)
    xy[rng.random(len(xy)) < 0.03] += 30.0
    assert picture_shear(replace(exact, xy=xy)).size < 1e-4


def test_what_poses_hide_is_as_large() -> None:
    exact = block()
    turned = 0.002 * (exact.xy - [600.0, 450.0])[:, ::-1]
    hidden = picture_shear(replace(exact, xy=exact.xy + turned)).hidden(np.full(_PHOTOS, 40.0))
    assert np.sqrt(hidden[:, 2, 2]) == pytest.approx(np.full(_PHOTOS, 0.002), rel=1e-3)
    assert np.allclose(hidden[:, 5, 5], 0.0, atol=1e-9)


def test_photos_with_few_observations_tell_nothing() -> None:
    exact = block()
    few = exact.point_of < 40
    part = replace(exact, point_of=exact.point_of[few], photo_of=exact.photo_of[few], xy=exact.xy[few] + 5.0)
    assert picture_shear(part).size == 0.0
