"""Joint errors of a map: their storage, and what they make of a pose that was found by its points."""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import Area, build_area
from featuredb.maps.error_modes import ErrorModes, without_modes
from featuredb.maps.subset import only_images
from reloc.localise.answer import shape_covariance
from reloc.localise.lens_prior import lens_of
from reloc.localise.pose import PoseHypothesis
from tests.support.scenes import box_points, looking_at, random_descriptors, ring, scene_map

_LENS = Camera(
    model="OPENCV", width=1000, height=800, params=(900.0, 901.0, 503.0, 398.0, 0.01, 0.002, 1e-4, -2e-4)
)


def test_provenance_keeps_them() -> None:
    rng = np.random.default_rng(0)
    modes = ErrorModes(
        image_id=np.array([3, 0, 7]), poses=rng.normal(size=(3, 6, 5)), lenses=rng.normal(size=(2, 8, 5))
    )
    written = json.loads(json.dumps({"version": "1"} | modes.as_provenance()))
    read = ErrorModes.of_provenance(written, 2)
    assert read is not None
    np.testing.assert_array_equal(read.image_id, modes.image_id)
    np.testing.assert_allclose(read.poses, modes.poses, rtol=1e-6)
    np.testing.assert_allclose(read.lenses, modes.lenses, rtol=1e-6)
    assert ErrorModes.of_provenance({"version": "1"}, 2) is None
    assert without_modes(written) == {"version": "1"}


@pytest.mark.parametrize(
    "wrong",
    [
        [],
        {"image_id": [0], "modes": 2, "poses": "AAAA", "lenses": ""},
        {"image_id": [0]},
        "text",
        {"image_id": [1 << 70]},
    ],
)
def test_what_is_not_ours_is_an_error(wrong: object) -> None:
    with pytest.raises(InvalidValueError, match="error_modes: expected"):
        ErrorModes.of_provenance({"error_modes": wrong}, 1)


@pytest.mark.parametrize("lens_of_photo", ["the map's", "the map's, smaller", "its own"])
def test_a_pose_is_off_as_the_map_is(lens_of_photo: str) -> None:
    """One mode, applied to the images and the lens of a map; its points triangulated and a photo located."""
    rng = np.random.default_rng(4)
    points, poses = box_points(rng, 80), ring(6)
    feature_map = replace(
        scene_map(points=points, descriptors=random_descriptors(rng, 80), poses=poses), cameras=(_LENS,)
    )
    area = build_area([feature_map])
    rows = area.points_of_images(np.arange(6))
    truth = looking_at(np.array([20.0, -30.0, 28.0]), np.array([0.0, 2.0, 4.0]))
    step = 1e-4
    mode = rng.normal(size=(6, 6)) * np.repeat([1e-3, 5e-4], 3) * step
    lens = np.array([5.0, 4.0, 3.0, -2.0, 5e-3, 3e-3, 2e-4, 3e-4]) * step
    off = replace(_LENS, params=tuple(np.array(_LENS.params) + lens))
    right, wrong = _LENS, off
    if lens_of_photo == "the map's, smaller":
        right, wrong = right.scaled_to(500, 400), wrong.scaled_to(500, 400)
    elif lens_of_photo == "its own":
        right = wrong = replace(_LENS, params=(850.0, 850.0, *_LENS.params[2:]))
    seen = right.project(truth.act(area.points.whole()))
    reach = area.image_reach
    moved = [
        Rigid3.exp(np.concatenate([m[:3], m[3:] * far])) @ pose
        for m, far, pose in zip(mode, reach, poses, strict=True)
    ]
    shifted = np.array([_triangulated(area, p, poses, moved, off) for p in rows])
    found = _located(truth, shifted, seen[rows], wrong)
    modes = ErrorModes(
        image_id=np.arange(6), poses=mode[:, :, None] / step, lenses=lens[None, :, None] / step
    )
    pose = PoseHypothesis(
        cam_from_local=truth,
        camera=right,
        camera_source="map",
        inliers=np.ones(len(rows), np.bool_),
    )
    covariance = shape_covariance(area, 0, pose, rows, modes)
    assert covariance is not None
    error = np.concatenate([_turn(truth.rotation.T @ found.rotation), truth.center - found.center])
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(deviation[:6], np.abs(error) / step, rtol=0.02, atol=2e-6)
    if lens_of_photo == "its own":
        assert covariance.shape == (6, 6)
    else:  # the lens that is answered is the map's, too: it errs together with the pose, and which way
        lent = lens_of(right) - lens_of(wrong)
        np.testing.assert_allclose(covariance[:6, 6:] * step**2, np.outer(error, lent), rtol=0.03, atol=1e-13)
    # Images that the modes do not know: nothing can be said. A fisheye is no lens of the map.
    fisheye = replace(_LENS, model="OPENCV_FISHEYE")
    assert shape_covariance(area, 0, replace(pose, camera=fisheye), rows, modes) is not None
    fewer = ErrorModes(image_id=np.arange(5), poses=modes.poses[:5], lenses=modes.lenses)
    assert shape_covariance(area, 0, pose, rows, fewer) is None


def _triangulated(
    area: Area, row: int, poses: Sequence[Rigid3], moved: Sequence[Rigid3], lens: Camera
) -> FloatArray:
    """Where a point comes to lie whose pixels are those of the true poses and lens."""
    start = area.points[np.array(row)]
    images = area.images_that_see(np.array([row]))[0]
    xy = [_LENS.project(poses[i].act(start[None]))[0] for i in images]

    def residual(x: FloatArray) -> FloatArray:
        return np.concatenate(
            [lens.project(moved[i].act(x[None]))[0] - p for i, p in zip(images, xy, strict=True)]
        )

    return np.asarray(least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x)


def _located(start: Rigid3, points: FloatArray, xy: FloatArray, lens: Camera) -> Rigid3:
    def residual(twist: FloatArray) -> FloatArray:
        return (lens.project((Rigid3.exp(twist) @ start).act(points)) - xy).ravel()

    found = least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=[1e-3] * 6)
    return Rigid3.exp(found.x) @ start


def _turn(rotation: FloatArray) -> FloatArray:
    return np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]])


def test_a_part_of_a_map_keeps_its_part_of_them() -> None:
    rng = np.random.default_rng(2)
    modes = ErrorModes(
        image_id=np.arange(4), poses=rng.normal(size=(4, 6, 3)), lenses=rng.normal(size=(2, 8, 3))
    )
    whole = scene_map(points=box_points(rng, 40), descriptors=random_descriptors(rng, 40), poses=ring(4))
    cameras = (whole.cameras[0], _LENS)
    images = tuple(replace(image, camera_id=k % 2) for k, image in enumerate(whole.images))
    whole = replace(whole, cameras=cameras, images=images, provenance=modes.as_provenance())
    part = only_images(whole, [1, 3])
    kept = ErrorModes.of_provenance(part.provenance, 1)
    assert kept is not None
    assert part.cameras == (_LENS,)
    np.testing.assert_allclose(kept.poses, modes.poses[[1, 3]], rtol=1e-6)
    np.testing.assert_allclose(kept.lenses, modes.lenses[1:], rtol=1e-6)
    assert build_area([part]).modes_of(0) is not None


@pytest.mark.parametrize("lenses", [0, 3])
def test_broken_ones_are_left_out_and_said(lenses: int, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(2)
    whole = scene_map(points=box_points(rng, 40), descriptors=random_descriptors(rng, 40), poses=ring(4))
    wrong = ErrorModes(image_id=np.arange(4), poses=np.ones((4, 6, 1)), lenses=np.ones((lenses, 8, 1)))
    assert build_area([replace(whole, provenance=wrong.as_provenance())]).modes_of(0) is None
    assert "1 cameras" in caplog.text
    caplog.clear()
    assert build_area([replace(whole, provenance={"error_modes": 7})]).modes_of(0) is None
    assert "expected image_id" in caplog.text
