"""Cameras of photos, local frames, settings of structure from motion, and which models are kept."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.maps.feature_map import GeoPrior
from ingest.colmap.bridge import Model, without_impossible
from ingest.fingerprint import digest, options_fingerprint
from ingest.photos.photo import Photo, answered_positions, local_frame_of, photo_cameras
from ingest.reconstruction import MapMakingOptions
from ingest.sfm.mapper import SfmOptions, SfmTask, SfmView, disjoint, mapping_settings
from tests.support.planar_map import CAMERA

_PHOTO = Photo(
    name="a.jpg", path=Path("a.jpg"), width=4000, height=3000, camera_key="dji", focal_px=2800.0, sha256="aa"
)


def test_photos_of_one_camera_share_intrinsics() -> None:
    other = replace(_PHOTO, name="c.jpg", camera_key="phone", focal_px=None, width=3000, height=4000)
    photos = [_PHOTO, replace(_PHOTO, name="b.jpg"), other]
    cameras, rows = photo_cameras(photos, "shared", "SIMPLE_RADIAL")
    assert rows == [0, 0, 1]
    assert [(c.width, c.height, c.focal_px, known) for c, known in cameras] == [
        (4000, 3000, 2800.0, True),
        (3000, 4000, pytest.approx(4800.0), False),
    ]
    _, rows = photo_cameras(photos, "per-image", "SIMPLE_RADIAL")
    assert rows == [0, 1, 2]


def test_photos_that_name_no_camera_share_with_none() -> None:
    photos = [replace(_PHOTO, name=n, camera_key="") for n in ("a", "b")]
    assert photo_cameras(photos, "shared", "SIMPLE_RADIAL")[1] == [0, 1]


def test_photos_that_name_no_camera_share_with_those_of_their_owner_day_and_size() -> None:
    noon = datetime(2024, 8, 11, 12, 0, tzinfo=UTC)
    mine = replace(_PHOTO, camera_key="", focal_px=None, owner="elif", capture_time=noon)
    others = [
        replace(mine, capture_time=noon + timedelta(hours=3)),
        replace(mine, capture_time=datetime(2024, 8, 11, 23, 0, tzinfo=timezone(timedelta(hours=-5)))),
        replace(mine, owner="greta"),
        replace(mine, width=3000, height=4000),
        replace(mine, focal_px=2800.0),
        replace(mine, owner=""),
        replace(mine, capture_time=None),
        replace(mine, capture_time=None),
    ]
    photos = [replace(p, name=str(k)) for k, p in enumerate([mine, *others])]
    assert photo_cameras(photos, "shared", "SIMPLE_RADIAL")[1] == [0, 0, 1, 2, 3, 4, 5, 6, 6]
    assert photo_cameras(photos, "per-image", "SIMPLE_RADIAL")[1] == list(range(9))


def _at(latitude: float, longitude: float, height: float | None) -> Photo:
    prior = GeoPrior(
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        sigma_horizontal_m=3.0,
        sigma_vertical_m=5.0,
    )
    return replace(_PHOTO, gps=prior)


def test_a_stray_position_does_not_move_the_frame() -> None:
    photos = [_at(48.99 + 1e-4 * k, 8.41, 200.0 + k) for k in range(5)] + [_at(-33.0, 151.0, 9000.0)]
    frame = local_frame_of(photos)
    assert frame is not None
    assert frame.latitude_deg == pytest.approx(48.99, abs=1e-3)
    assert frame.longitude_deg == pytest.approx(8.41, abs=1e-3)
    assert frame.height_m == pytest.approx(202.0, abs=3.0)
    assert local_frame_of([_PHOTO]) is None


def test_measured_centres_are_those_that_somebody_answers_for() -> None:
    tagged = [_at(48.99 + 1e-4 * k, 8.41, 200.0 + k) for k in range(5)]
    photos = [_PHOTO, replace(tagged[0], gps_is_hint=True), *tagged[1:4], _at(48.99, 8.41, None)]
    frame = local_frame_of(tagged)
    assert frame is not None
    rows, positions, sigmas = answered_positions(photos, frame)
    assert rows.tolist() == [2, 3, 4]  # no position, a hint and one without height say nothing
    np.testing.assert_allclose(sigmas, np.tile([3.0, 3.0, 5.0], (3, 1)))
    np.testing.assert_allclose(np.diff(positions[:, 2]), 1.0, atol=1e-2)


def _model(rows: list[int]) -> Model:
    """Photos that all see the same forty points."""
    count = len(rows)
    return Model(
        cameras=(CAMERA,),
        rows=np.array(rows),
        camera_of=np.zeros(count, np.int64),
        cam_from_sfm=tuple(Rigid3.identity() for _ in rows),
        xyz=np.zeros((40, 3)),
        point_of=np.repeat(np.arange(40), count),
        photo_of=np.tile(np.arange(count), 40),
        keypoint_of=np.repeat(np.arange(40), count),
    )


def test_small_models_are_dropped_and_a_photo_is_in_one_model_only() -> None:
    """The second model loses the photo that it shares with the first, and what hung on that photo alone."""
    models = [_model([0, 1, 2, 3]), _model([3, 4, 5]), _model([6, 7, 8]), _model([9, 10])]
    assert [m.rows.tolist() for m in disjoint(models, 3)] == [[0, 1, 2, 3], [6, 7, 8]]
    parts = disjoint(models, 2)
    assert [m.rows.tolist() for m in parts] == [[0, 1, 2, 3], [4, 5], [6, 7, 8], [9, 10]]
    assert (parts[1].track_lengths() == 2).all()
    chain = _model([3, 11, 12])
    apart = replace(chain, point_of=chain.point_of + 40 * (chain.photo_of == 2))  # 12 sees nothing of 11's
    apart = replace(apart, xyz=np.zeros((80, 3)))
    assert [m.rows.tolist() for m in disjoint([models[0], apart], 2)] == [[0, 1, 2, 3]]


def test_pixel_thresholds_grow_with_the_image() -> None:
    small = mapping_settings(SfmOptions(), 800)
    large = mapping_settings(SfmOptions(), 4000)
    for name in ("mapper.filter_max_reproj_error", "mapper.init_max_error", "mapper.abs_pose_max_error"):
        assert large[name] == pytest.approx(2.5 * small[name])
    assert mapping_settings(SfmOptions(refine_focal=False), 800)["ba_refine_focal_length"] is False


def test_what_no_pixel_is_of_is_no_observation() -> None:
    """Past 46 degrees this lens's distortion turns back; behind the camera there is no picture."""
    lens = Camera(model="SIMPLE_RADIAL", width=640, height=480, params=(300.0, 320.0, 240.0, -0.3))
    poses = (Rigid3.identity(), Rigid3.from_matrix(np.c_[np.eye(3), [-1.0, 0.0, 0.0]]))
    xyz = np.array([[0.2, 0.1, 2.0], [2.6, 0.0, 2.0], [0.3, 0.0, -2.0], [0.4, -0.2, 3.0]])
    model = Model(
        cameras=(lens,),
        rows=np.arange(2),
        camera_of=np.zeros(2, dtype=np.int64),
        cam_from_sfm=poses,
        xyz=xyz,
        point_of=np.repeat(np.arange(4), 2),
        photo_of=np.tile(np.arange(2), 4),
        keypoint_of=np.arange(8),
    )
    assert np.isfinite(lens.project(poses[1].act(xyz[1:2]))).all()  # one photo does see the second point
    left = without_impossible(model)
    np.testing.assert_array_equal(left.xyz, xyz[[0, 3]])
    assert left.point_of.tolist() == [0, 0, 1, 1]
    assert left.photo_of.tolist() == [0, 1, 0, 1]
    assert left.keypoint_of.tolist() == [0, 1, 6, 7]
    assert without_impossible(left) is left


def test_the_trials_for_photos_with_few_points_are_bounded() -> None:
    """COLMAP can take longer for one photo than for all others together."""
    options = pycolmap.IncrementalPipelineOptions()
    assert options.structure_less_registration_fallback is True  # as the settings leave it
    assert options.mapper.abs_pose_min_inlier_ratio < 0.3  # the number of trials goes with its sixth power
    assert mapping_settings(SfmOptions(), 800)["mapper.abs_pose_min_inlier_ratio"] == 0.6


def test_keys_follow_the_content() -> None:
    view = SfmView(name="a.jpg", camera_row=0, features=Path("work/features/sift/aa.npz"))
    task = SfmTask(cameras=((CAMERA, True),), views=(view,), matches=(), options=SfmOptions())
    others = [
        replace(task, options=SfmOptions(seed=1)),
        replace(task, views=(replace(view, features=Path("work/features/sift/bb.npz")),)),
        replace(task, views=(replace(view, features=Path("work/features/other/aa.npz")),)),
        replace(task, views=(replace(view, prior_position=(0.0, 0.0, 0.0), prior_sigma_m=(1.0, 1.0, 1.0)),)),
        replace(task, matches=((0, 1, Path("work/matches/ratio/aa/aa_bb.npz")),)),
    ]
    assert len({task.key(), *(other.key() for other in others)}) == 6
    # Where the work folder lies does not matter.
    elsewhere = replace(view, features=Path("/mnt/features/sift/aa.npz"))
    assert replace(task, views=(elsewhere,)).key() == task.key()


def test_fingerprints_tell_options_apart_and_digests_do_not_run_together() -> None:
    assert options_fingerprint(SfmOptions()) == options_fingerprint(SfmOptions())
    assert options_fingerprint(SfmOptions()) != options_fingerprint(SfmOptions(seed=2))
    assert MapMakingOptions().fingerprint != MapMakingOptions(cameras="per-image").fingerprint
    assert digest("ab", "c") != digest("a", "bc")
