"""Answers on Earth: radii and covariances against Monte-Carlo, coordinates against pyproj itself."""

import numpy as np
import pyproj
import pytest

from featuredb.geometry.camera import Camera
from featuredb.geometry.error_radius import error_radius
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, so3_log
from featuredb.geometry.sim3 import Sim3
from featuredb.index.area import Area, build_area
from featuredb.maps.feature_map import FeatureMap
from reloc.localise.answer import make_answer
from reloc.localise.lens_prior import lens_of, with_lens
from reloc.localise.pose import PoseHypothesis, PoseUncertainty
from reloc.localise.result import LocalisedPose
from tests.support.scenes import EPSG, box_points, looking_at, random_descriptors, ring, scene_map

POSE = looking_at(np.array([38.0, 22.0, 33.0]), np.array([0.0, 0.0, 3.0]))
PLACED = np.diag([0.01, 0.02, 0.01, 0.03, 0.5, 0.8, 1.5]) ** 2


def a_map(map_id: str = "a", east_m: float = 0.0, placed: np.ndarray = PLACED) -> FeatureMap:
    rng = np.random.default_rng(0)
    return scene_map(
        points=box_points(rng, 60),
        descriptors=random_descriptors(rng, 60),
        poses=ring(4),
        map_id=map_id,
        east_m=east_m,
        placement_covariance=placed,
    )


def answer_of(
    maps: list[FeatureMap], pose: Rigid3, rows: np.ndarray, measured: np.ndarray | None = None
) -> LocalisedPose:
    area = build_area(maps, frame=maps[0].frame)
    hypothesis = PoseHypothesis(
        cam_from_local=pose,
        camera=Camera.from_focal(1000, 800, 900.0),
        camera_source="request",
        inliers=np.ones(len(rows), dtype=bool),
    )
    uncertainty = PoseUncertainty(
        joint=np.zeros((6, 6)) if measured is None else measured,
        residual_rms_px=0.5,
    )
    return make_answer(area, hypothesis, uncertainty, np.zeros((len(rows), 2)), rows, want_inliers=True)


@pytest.mark.parametrize(
    "covariance",
    [
        np.diag([4.0]),
        np.diag([1.0, 1.0]),
        np.diag([9.0, 1.0]),
        np.diag([100.0, 1e-3]),
        np.array([[2.0, 1.2], [1.2, 1.0]]),
        np.diag([1.0, 1.0, 1.0]),
        np.diag([25.0, 4.0, 1.0]),
        np.diag([1.0, 1.0, 30.0]),
        np.array([[3.0, 1.0, 0.5], [1.0, 2.0, -0.7], [0.5, -0.7, 1.0]]),
    ],
)
@pytest.mark.parametrize("share", [0.68, 0.95])
def test_the_radius_against_monte_carlo(covariance: np.ndarray, share: float) -> None:
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(np.zeros(len(covariance)), covariance, 200_000)
    expected = np.quantile(np.linalg.norm(drawn, axis=1), share)
    assert error_radius(covariance, share) == pytest.approx(expected, rel=0.03)


def test_radius_of_nothing_is_zero() -> None:
    assert error_radius(np.zeros((2, 2))) == 0.0
    assert error_radius(np.diag([1.0])) == pytest.approx(0.9945, abs=1e-3)  # 68 %, not one sigma's 68.27 %


def rows_of(area: Area, number: int) -> np.ndarray:
    return np.arange(*area.point_start[number : number + 2])


def test_the_placement_moves_the_camera_as_the_covariance_says() -> None:
    """Sim3 perturbations of the whole map carry the camera along, and axes turn."""
    main = a_map("main", east_m=30_000.0)
    other = a_map("other")
    in_other = other.frame.enu_from(main.frame)
    pose = POSE @ in_other.inverse()  # in the frame of `other`, which is the area's
    rows = rows_of(build_area([other, main], frame=other.frame), 1)
    answer = answer_of([other, main], pose, rows)
    assert answer.map_ids == ("main",)
    rng = np.random.default_rng(1)
    half = np.linalg.cholesky(PLACED)
    world_from_cam = POSE.inverse()
    true_from_main = main.frame.true_enu_from_enu(POSE.center)
    drawn = []
    for _ in range(6000):
        moved = Sim3.exp(half @ rng.normal(size=7))
        turned = moved.rotation @ world_from_cam.rotation
        rotation = so3_log(turned @ world_from_cam.rotation.T)
        shift = moved.act(world_from_cam.translation) - world_from_cam.translation
        drawn.append(np.concatenate([true_from_main @ rotation, true_from_main @ shift]))
    expected = np.cov(np.array(drawn).T)
    scale = np.sqrt(np.diag(expected))
    difference = (answer.covariance - expected) / np.outer(scale, scale)
    assert np.abs(difference).max() < 0.06
    # Scale and turns act at the camera's distance from the map's origin, not only its shift.
    assert answer.covariance[3, 3] > 1.3 * 0.5**2


def test_measured_covariance_is_added_in_true_axes() -> None:
    """30 km east of the area's origin, true north is 0.3 degrees off the area's."""
    here, away = a_map("a", placed=np.zeros((7, 7))), a_map("b", east_m=30_000.0, placed=np.zeros((7, 7)))
    pose = POSE @ here.frame.enu_from(away.frame).inverse()
    measured = np.zeros((6, 6))
    measured[3, 3] = 1.0
    rows = rows_of(build_area([here, away], frame=here.frame), 1)
    covariance = answer_of([here, away], pose, rows, measured).covariance
    # An independent route to the axes: displacements of geodetic positions by pyproj.
    to_geodetic = here.frame.geodetic_from_enu(np.array([pose.center, pose.center + np.array([1.0, 0, 0])]))
    ecef = pyproj.Transformer.from_crs(4979, 4978)
    start, end = (np.array(ecef.transform(lat, lon, h)) for lat, lon, h in to_geodetic)
    lat, lon = np.radians(to_geodetic[0][:2])
    axes = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    east_of_area = axes @ (end - start)
    np.testing.assert_allclose(covariance[3:, 3:], np.outer(east_of_area, east_of_area), atol=1e-6)
    assert abs(covariance[3, 4]) > 1e-3  # the axes do differ


def test_coordinates_agree_with_pyproj() -> None:
    feature_map = a_map()
    answer = answer_of([feature_map], POSE, np.arange(20))
    lat, lon = answer.geopose.latitude_deg, answer.geopose.longitude_deg
    easting, northing = pyproj.Transformer.from_crs(4326, EPSG).transform(lat, lon)
    np.testing.assert_allclose(answer.utm[:2], [easting, northing], atol=1e-4)
    assert answer.utm[2] == pytest.approx(answer.geopose.height_m, abs=1e-4)
    assert answer.epsg == EPSG
    # A point seen by the camera, once through the answer in UTM and once in the local frame.
    rotation = matrix_from_quaternion(answer.cam_from_utm_xyzw)
    target = feature_map.points.utm[3]
    scale = pyproj.Proj(EPSG).get_factors(lon, lat).meridional_scale
    offset = target - answer.utm
    offset[:2] /= scale
    seen = rotation @ offset
    expected = POSE.act(feature_map.frame.enu_from_utm(target, EPSG))
    np.testing.assert_allclose(seen, expected, atol=2e-3)
    # Grid axes and the GeoPose's true axes differ by the meridian convergence.
    body_from_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    true_from_cam = answer.geopose.true_enu_from_body @ body_from_cam
    turn = so3_log(rotation.T @ true_from_cam.T)
    convergence = np.radians(pyproj.Proj(EPSG).get_factors(lon, lat).meridian_convergence)
    np.testing.assert_allclose(turn, [0, 0, convergence], atol=2e-6)


def test_inliers_and_maps_are_named_most_first() -> None:
    maps = [a_map("few"), a_map("many", east_m=100.0)]
    area = build_area(maps, frame=maps[0].frame)
    rows = np.concatenate([rows_of(area, 0)[:5], rows_of(area, 1)[:9]])
    answer = answer_of(maps, POSE, rows)
    assert answer.map_ids == ("many", "few")
    assert [entry.map_id for entry in answer.lineage] == ["many", "few"]
    assert answer.inliers is not None
    assert answer.inliers.map_rows == (1,) * 5 + (0,) * 9
    point = maps[0].points.utm[area.point_row[rows[:1]][0]]
    np.testing.assert_allclose(answer.inliers.utm[0], point, atol=1e-4)
    point = maps[1].points.utm[area.point_row[rows[-1:]][0]]
    np.testing.assert_allclose(answer.inliers.utm[-1], point, atol=1e-4)


def test_what_pixels_show_has_the_covariance_of_pose_and_lens_together() -> None:
    """By drawing poses and lenses: those answered are OPENCV's, those estimated have an aspect."""
    rng = np.random.default_rng(5)
    area = build_area([a_map()])
    camera = Camera(
        model="OPENCV", width=1000, height=800, params=(900.0, 903.0, 500.0, 400.0, 0.02, 0.01, 1e-3, 0.0)
    )
    hypothesis = PoseHypothesis(
        cam_from_local=POSE,
        camera=camera,
        camera_source="estimated",
        inliers=np.ones(20, dtype=bool),
    )
    scale = np.array([1e-3] * 3 + [0.05] * 3 + [3.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4])
    root = rng.normal(size=(14, 14)) * scale[:, None]
    rows = np.arange(20)
    uncertainty = PoseUncertainty(joint=root @ root.T, residual_rms_px=0.5)
    answer = make_answer(area, hypothesis, uncertainty, np.zeros((20, 2)), rows, want_inliers=False)
    assert answer.view_covariance is not None
    errors = rng.normal(size=(20_000, 14)) @ root.T
    params = np.array([with_lens(camera, lens_of(camera) + e).params for e in errors[:, 6:]]) - camera.params
    drawn = np.cov(np.column_stack([errors[:, :6], params]).T)
    sigma = np.sqrt(np.diag(drawn))
    # The map's placement adds to the pose alone; four standard deviations of 20,000 draws.
    np.testing.assert_allclose(
        (answer.view_covariance / np.outer(sigma, sigma))[:, 6:],
        (drawn / np.outer(sigma, sigma))[:, 6:],
        atol=0.04,
    )
    exact = make_answer(
        area, hypothesis, uncertainty, np.zeros((20, 2)), rows, want_inliers=False, told=camera
    )
    assert exact.view_covariance is None
