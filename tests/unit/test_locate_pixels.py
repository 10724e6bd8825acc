"""Places of pixels: rays against a scan and a map, covariances against draws, edges, refusals, boxes."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_exp
from featuredb.render.cloud import PointCloud
from reloc.answered_view import AnsweredView
from reloc.pixels.locate import geojson, locate, read_coco
from reloc.pixels.surfaces import MapSurface, ScanSurface, fit_patch, resampled, window_camera
from tests.support.clouds import build_cloud
from tests.support.scanned_map import EPSG, FRAME

LENS = Camera(
    model="OPENCV", width=800, height=600, params=(700.0, 705.0, 402.0, 297.0, 0.03, -0.02, 1e-3, 2e-3)
)
NOISE_M = 0.02


def view_of(pose: Rigid3, covariance: FloatArray | None = None, camera: Camera = LENS) -> AnsweredView:
    return AnsweredView(
        frame=FRAME,
        camera=camera,
        cam_from_local=pose,
        covariance=np.eye(6) * 1e-12 if covariance is None else covariance,
        epsg=EPSG,
        height_datum="ellipsoidal",
    )


def looking(center: tuple[float, float, float], at: tuple[float, float, float]) -> Rigid3:
    forward = np.subtract(at, center) / np.linalg.norm(np.subtract(at, center))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Rigid3(rotation=rotation, translation=-rotation @ np.array(center))


def step(seed: int = 0, noise_m: float = NOISE_M) -> PointCloud:
    """Ground at z = 0 with a slab of 4 m on it for x > 5, sixteen points a square metre, no walls."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-40, 40, (100_000, 2))
    z = np.where(xy[:, 0] > 5, 4.0, 0.0) + rng.normal(0, noise_m, len(xy))
    return build_cloud(FRAME, "ellipsoidal", np.column_stack([xy, z]))


POSE = looking((-3.0, -20.0, 30.0), (0.0, 0.0, 0.0))
CLOUD = step()


def true_place(view: AnsweredView, pixel: FloatArray, z: float) -> FloatArray:
    ray, center = view.rays(pixel[None])[0], view.cam_from_local.center
    return center + ray * (z - center[2]) / ray[2]


def test_a_pixel_is_where_its_ray_meets_the_scan() -> None:
    view = view_of(POSE)
    on_ground, on_slab = np.array([200.0, 350.5]), np.array([650.0, 300.0])
    found = locate(view, ScanSurface(cloud=CLOUD), [on_ground, on_slab])
    for place, pixel, z in zip(found, (on_ground, on_slab), (0.0, 4.0), strict=True):
        assert place.reason is None
        assert not place.at_edge
        assert place.utm is not None
        local = FRAME.enu_from_utm(place.utm, EPSG)
        np.testing.assert_allclose(local, true_place(view, pixel, z), atol=0.02)
        assert place.vertical_68_m is not None
        assert 0.002 < place.vertical_68_m < NOISE_M


def test_a_level_place_is_known_as_well_as_its_scan_is_rounded() -> None:
    """All its points have one height: what they are off by together does not show in how they scatter."""
    (place,) = locate(view_of(POSE), ScanSurface(cloud=step(noise_m=0.0)), [(200.0, 350.5)])
    assert place.covariance is not None
    assert place.covariance[2, 2] > 0.99 * 0.01**2 / 12.0
    assert np.linalg.cond(place.covariance) < 1e12


def test_bounds_hold_when_pose_and_lens_are_off_as_their_covariance_says() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(14, 14)) * 0.3 + np.eye(14)
    root *= np.array([4e-4] * 3 + [0.05] * 3 + [1.0, 1.0, 1.0, 1.0, 1e-3, 1e-3, 2e-4, 2e-4])[:, None]
    covariance = root @ root.T
    true = view_of(POSE)
    squared = []
    for _ in range(60):
        error = root @ rng.normal(size=14)
        back = POSE.inverse()
        turned = so3_exp(error[:3]).T @ back.rotation
        pose = Rigid3(rotation=turned, translation=back.translation - error[3:6]).inverse()
        camera = Camera(
            model="OPENCV", width=800, height=600, params=tuple(np.array(LENS.params) - error[6:])
        )
        pixel = rng.uniform([50, 250], [250, 550])
        (place,) = locate(view_of(pose, covariance, camera), ScanSurface(cloud=CLOUD, common_m=0.0), [pixel])
        assert place.utm is not None
        assert place.covariance is not None
        assert not place.at_edge
        miss = FRAME.enu_from_utm(place.utm, EPSG) - true_place(true, pixel, 0.0)
        squared.append(float(miss @ np.linalg.solve(place.covariance, miss)))
    # Three standard deviations of counts of 60.
    assert abs(np.mean(np.array(squared) < chi2.ppf(0.68, 3)) - 0.68) < 0.18
    assert abs(np.mean(np.array(squared) < chi2.ppf(0.95, 3)) - 0.95) < 0.085


def test_at_an_edge_the_covariance_covers_both_surfaces() -> None:
    unsure = np.diag([1e-3**2] * 3 + [0.1**2] * 3)
    view = view_of(POSE, unsure)
    edge = LENS.project(POSE.act(np.array([[5.0, 0.0, 4.0]])))[0]
    (place,) = locate(view, ScanSurface(cloud=CLOUD), [edge])
    assert place.at_edge
    assert "another surface" in place.detail
    assert place.utm is not None
    assert place.covariance is not None
    local = FRAME.enu_from_utm(place.utm, EPSG)
    for z in (0.0, 4.0):
        miss = local - true_place(view, edge, z)
        assert miss @ np.linalg.solve(place.covariance, miss) < chi2.ppf(0.95, 3)


def test_what_has_no_place_is_refused() -> None:
    low = looking((-30.0, -20.0, 0.4), (30.0, 10.0, 0.0))
    flat = step(noise_m=0.001)
    sky, horizon = np.array([400.0, 10.0]), LENS.project(low.act(np.array([[-3.0, -6.5, 0.0]])))[0]
    unsure = np.diag([5e-3**2] * 3 + [0.1**2] * 3)
    above, grazing, outside = locate(
        view_of(low, unsure), ScanSurface(cloud=flat), [sky, horizon, [900.0, 10.0]]
    )
    assert (above.reason, grazing.reason, outside.reason) == ("NO_SURFACE", "GRAZING", "OUTSIDE")
    assert above.utm is None
    assert grazing.covariance is None


def test_a_map_gives_the_plane_of_its_points_and_nothing_beside_them() -> None:
    rng = np.random.default_rng(3)
    xy = rng.uniform([-20, -15], [4, 15], (400, 2))
    points = np.column_stack([xy, 0.1 * xy[:, 0] + rng.normal(0, 0.03, 400)])
    view = view_of(POSE)
    pixel = LENS.project(POSE.act(np.array([[-8.0, 2.0, -0.8]])))[0]
    beside = LENS.project(POSE.act(np.array([[12.0, 2.0, 0.5]])))[0]
    place, nothing = locate(view, MapSurface(points=points), [pixel, beside])
    assert place.utm is not None
    assert place.surface == "map"
    assert nothing.reason == "NO_SURFACE"
    np.testing.assert_allclose(FRAME.enu_from_utm(place.utm, EPSG), [-8.0, 2.0, -0.8], atol=0.08)


def test_a_plane_is_that_of_the_surface_that_was_asked_for() -> None:
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.normal(0, 0.01, 50)])
    wall = np.column_stack([rng.uniform(-1, 1, 30), np.full(30, 0.4), rng.uniform(0, 2, 30)])
    patch = fit_patch(np.concatenate([ground, wall]), np.zeros(3), np.array([0.0, 0.0, 9.0]), 0.05)
    assert patch is not None
    assert patch.normal[2] > 0.999
    assert abs(patch.scatter_m - 0.01) < 0.004
    assert patch.fitted_m < 0.004
    assert fit_patch(ground[:5], np.zeros(3), np.array([0.0, 0.0, 9.0]), 0.05) is None


@pytest.mark.parametrize("zoom", [1.0, 0.37])
def test_a_window_shows_the_picture_around_a_pixel(zoom: float) -> None:
    pixel, points = np.array([610.3, 122.8]), np.array([[3.0, -1.7, 10.0], [2.9, -2.0, 9.0]])
    window, corner, scale = window_camera(LENS, pixel, 40.0, zoom)
    np.testing.assert_allclose(window.project(points) / scale + corner, LENS.project(points), atol=1e-9)
    middle = (pixel - corner) * scale
    assert (np.abs(middle - window.width / 2) <= 1.0).all()


@pytest.mark.parametrize("model", ["OPENCV", "SIMPLE_RADIAL"])
def test_a_smaller_picture_of_any_shape_shows_the_same(model: str) -> None:
    """Of a panorama, and of one that becomes a few pixels wide, where rows are not whole."""
    points = np.array([[3.0, -0.1, 10.0], [-2.0, 0.1, 9.0]])
    for width, height, zoom in ((12_000, 400, 0.083), (800, 600, 0.006)):
        lens = Camera.from_focal(width, height, 0.9 * width, model)
        small = resampled(lens, zoom)
        scale = small.width / width
        np.testing.assert_allclose(small.project(points), lens.project(points) * scale, atol=1e-9)
        assert 0 <= small.height - height * scale < 1


def test_a_doubt_of_the_surface_is_a_doubt_of_each_place() -> None:
    scan = ScanSurface(cloud=CLOUD, doubt="heights of an unknown datum")
    (place,) = locate(view_of(POSE), scan, [(200.0, 350.5)])
    assert "heights of an unknown datum" in place.detail


def test_boxes_of_another_photo_or_another_size_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "boxes.json"
    box = {"image_id": "other.jpg", "bbox": [190.0, 300.0, 20.0, 50.0]}
    file.write_text(json.dumps([box]))
    with pytest.raises(InvalidValueError, match=r"boxes of a\.jpg, found none"):
        read_coco(file, "a.jpg", "bottom", (800, 600))
    file.write_text(json.dumps([{**box, "image_id": 17}]))
    marks, says_size = read_coco(file, "a.jpg", "bottom", (800, 600))
    assert (len(marks), says_size) == (1, False)
    image = {"id": 3, "file_name": "a.jpg", "width": 600, "height": 800}
    file.write_text(json.dumps({"images": [image], "annotations": [{**box, "image_id": 3}]}))
    with pytest.raises(InvalidValueError, match=r"800x600 pixels, .* found those of 600x800"):
        read_coco(file, "a.jpg", "bottom", (800, 600))
    (mark,), says_size = read_coco(file, "a.jpg", "bottom", (600, 800))
    assert says_size
    assert mark.pixel == (200.0, 350.0)


def test_boxes_come_as_coco_and_places_go_as_geojson(tmp_path: Path) -> None:
    box = {"id": 7, "image_id": 3, "category_id": 2, "bbox": [190.0, 300.0, 20.0, 50.5]}
    annotations = {
        "images": [{"id": 3, "file_name": "day/a.jpg"}, {"id": 4, "file_name": "b.jpg"}],
        "annotations": [box, {**box, "id": 8, "image_id": 4}],
        "categories": [{"id": 2, "name": "car"}],
    }
    file = tmp_path / "boxes.json"
    file.write_text(json.dumps(annotations))
    (mark,), _ = read_coco(file, "elsewhere/a.jpg", "bottom", (800, 600))
    assert mark.pixel == (200.0, 350.5)
    assert mark.properties["category"] == "car"
    file.write_text(json.dumps([{**box, "image_id": "a", "score": 0.5}, {**box, "image_id": "b"}]))
    (mark,), _ = read_coco(file, "a.jpg", "centre", (800, 600))
    assert mark.pixel == (200.0, 325.25)
    assert mark.properties["score"] == 0.5
    with pytest.raises(InvalidValueError, match=r"boxes of c\.jpg"):
        read_coco(file, "c.jpg", "centre", (800, 600))
    file.write_text('{"images": 3}')
    with pytest.raises(InvalidValueError, match="COCO"):
        read_coco(file, "c.jpg", "centre", (800, 600))
    view = view_of(POSE)
    places = locate(view, ScanSurface(cloud=CLOUD), [mark.pixel, (-1.0, 0.0)])
    document = geojson(places, [mark, mark], "a.jpg")
    longitude, latitude, height = document["features"][0]["geometry"]["coordinates"]
    local = FRAME.enu_from_geodetic((latitude, longitude, height))
    np.testing.assert_allclose(local, true_place(view, np.array(mark.pixel), 0.0), atol=0.02)
    assert document["features"][1]["geometry"] is None
    assert document["features"][1]["properties"]["reason"] == "OUTSIDE"
