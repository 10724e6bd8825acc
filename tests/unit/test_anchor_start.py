"""Starts of a registration: the map's placement, rough poses, picked points, and the files they come from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from featuredb.errors import GeodesyError, RegistrationError
from featuredb.geometry.camera import Camera
from featuredb.geometry.camera_angles import cam_from_enu
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from ingest.register.anchor.start.first_place import check_on_scan
from ingest.register.anchor.start.picks import KNOWN_FOCAL_REL, Picks, pose_from_picks, read_picks
from ingest.register.anchor.start.priors import (
    MIN_SIGMA_HORIZONTAL_M,
    MIN_SIGMA_VERTICAL_M,
    RoughPose,
    height_shift,
    image_named,
    prior_from_map,
    read_pose,
)
from tests.support.clouds import build_cloud
from tests.support.maps import EASTING, EPSG, HEIGHT, NORTHING, random_map

CAMERA = Camera(model="SIMPLE_RADIAL", width=1600, height=1200, params=(1300.0, 800.0, 600.0, 0.02))


def looking_down(height_m: float = 60.0, yaw_deg: float = 30.0) -> Rigid3:
    rotation = cam_from_enu(yaw_deg, -90.0, 0.0)
    return Rigid3(rotation=rotation, translation=-rotation @ np.array([5.0, -3.0, height_m]))


def picks_at(pose: Rigid3, count: int = 9, noise_px: float = 1.0, seed: int = 0) -> tuple[Picks, np.ndarray]:
    """Picks of points in view, and the points."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-25, 30, (count, 2)), rng.uniform(0, 8, count)])
    pixels = CAMERA.project(pose.act(points)) + rng.normal(0, noise_px, (count, 2))
    return Picks(image="a.jpg", pixels=pixels, utm=points), points


def test_picks_give_the_pose() -> None:
    truth = looking_down()
    picks, points = picks_at(truth)
    prior, fit = pose_from_picks(picks, points, CAMERA, truth, KNOWN_FOCAL_REL)
    assert np.linalg.norm(prior.cam_from_local.center - truth.center) < 0.3
    assert prior.cam_from_local.angle_to_deg(truth) < 0.3
    assert fit.wrong == ()
    assert MIN_SIGMA_HORIZONTAL_M <= prior.sigma_horizontal_m < 2.0


def test_an_outlier_among_the_picks_is_named_and_left_out() -> None:
    truth = looking_down()
    picks, points = picks_at(truth)
    pixels = picks.pixels.copy()
    pixels[4] += (150.0, -90.0)
    prior, fit = pose_from_picks(replace(picks, pixels=pixels), points, CAMERA, truth, KNOWN_FOCAL_REL)
    assert fit.wrong == (4,)
    assert np.linalg.norm(prior.cam_from_local.center - truth.center) < 0.3


def test_the_covariance_of_picked_poses_is_honest() -> None:
    truth = looking_down()
    sigma_px = 0.00075 * CAMERA.width
    squared = []
    for seed in range(30):
        picks, points = picks_at(truth, count=8, noise_px=sigma_px, seed=seed)
        rng = np.random.default_rng(1000 + seed)
        _, fit = pose_from_picks(
            picks, points + rng.normal(0, 0.2, points.shape), CAMERA, truth, KNOWN_FOCAL_REL
        )
        error = (truth @ fit.cam_from_local.inverse()).log()
        squared.append(float(error @ np.linalg.solve(fit.covariance, error)))
    # Six degrees of freedom; residuals of few picks make it a little conservative.
    assert 2.0 < np.mean(squared) < 7.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: (p.pixels[:3], p.utm[:3]), "expected at least 4, found 3"),
        (lambda p: (p.pixels[::-1], p.utm), "contradict each other"),
        (
            lambda p: (p.pixels, np.column_stack([p.utm[:, 1], p.utm[:, 0], p.utm[:, 2]])),
            "are easting and northing",
        ),
    ],
)
def test_picks_that_cannot_be_used(change: object, message: str) -> None:
    picks, _ = picks_at(looking_down())
    pixels, utm = change(picks)  # type: ignore[operator]
    with pytest.raises(RegistrationError, match=message):
        pose_from_picks(
            Picks(image="a.jpg", pixels=pixels, utm=utm), utm, CAMERA, looking_down(), KNOWN_FOCAL_REL
        )


def test_picks_close_together_leave_the_pose_open() -> None:
    truth = looking_down()
    rng = np.random.default_rng(3)
    points = np.array([5.0, -3.0, 0.0]) + rng.uniform(-0.2, 0.2, (8, 3))
    picks = Picks(image="a.jpg", pixels=CAMERA.project(truth.act(points)), utm=points)
    with pytest.raises(RegistrationError, match="spread them"):
        pose_from_picks(picks, points, CAMERA, truth, KNOWN_FOCAL_REL)


def test_angles_against_scipy() -> None:
    """East-north-up to camera, from yaw, pitch, roll in north-east-down axes as gimbals have."""
    ned_from_enu = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    camera_from_body = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    for yaw, pitch, roll in ((0, 0, 0), (90, -90, 0), (37, -62, 11), (-120, 15, -40)):
        body_from_ned = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix().T
        expected = camera_from_body @ body_from_ned @ ned_from_enu
        np.testing.assert_allclose(cam_from_enu(yaw, pitch, roll), expected, atol=1e-12)


def test_a_rough_pose_looks_where_it_says() -> None:
    feature_map = random_map(1)
    utm = np.array([EASTING + 40.0, NORTHING - 20.0, HEIGHT + 90.0])
    target = np.array([EASTING + 80.0, NORTHING + 50.0, HEIGHT])
    place = dict(zip(("easting", "northing", "height"), utm.tolist(), strict=True))
    rough = RoughPose.model_validate(place | {"look_at": target.tolist()})
    prior = rough.prior(feature_map.frame, feature_map.epsg)
    seen = prior.cam_from_local.act(feature_map.frame.enu_from_utm(target, EPSG))
    assert seen[2] > 0
    # UTM's scale and the Earth's curvature leave centimetres in a hundred metres.
    np.testing.assert_allclose(seen[:2] / seen[2], 0.0, atol=2e-3)


def flat_map(sigma: float = 0.02) -> FeatureMap:
    """A map whose images look down and whose placement has a plain covariance."""
    base = random_map(2, points=400, extent_m=100.0)
    covariance = np.diag([1e-4, sigma**2, sigma**2, (2 * sigma) ** 2, 9.0, 9.0, 100.0])
    placement = replace(base.placement, covariance=covariance, local_from_sfm=Sim3.identity())
    images = tuple(replace(image, cam_from_local=looking_down()) for image in base.images)
    return replace(base, placement=placement, images=images)


def test_heights_are_compared_where_map_and_scan_meet() -> None:
    feature_map = flat_map()
    points = feature_map.points_local()
    rng = np.random.default_rng(0)
    grid = rng.uniform(-60, 60, (40_000, 2))
    # The scan is the map's own surface 8.5 m higher, with trees over a fifth of it.
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(points[:, :2]).query(grid)
    heights = points[nearest, 2] + 8.5 + 15.0 * (rng.uniform(size=len(grid)) < 0.2)
    cloud = build_cloud(feature_map.frame, "unknown", np.column_stack([grid, heights]))
    shift = height_shift(feature_map, cloud)
    assert shift is not None
    assert shift.shift_m == pytest.approx(8.5, abs=0.3)
    prior = prior_from_map(feature_map, feature_map.images[0], shift)
    image = feature_map.images[0]
    np.testing.assert_allclose(
        prior.cam_from_local.center, image.cam_from_local.center + np.array([0, 0, shift.shift_m]), atol=1e-9
    )
    assert prior.sigma_vertical_m == pytest.approx(max(shift.sigma_m, MIN_SIGMA_VERTICAL_M))
    far = build_cloud(feature_map.frame, "unknown", np.column_stack([grid + 5000.0, heights]))
    assert height_shift(feature_map, far) is None


def test_the_prior_of_a_placement_has_its_sigmas() -> None:
    prior = prior_from_map(flat_map(), flat_map().images[0], None)
    assert prior.sigma_vertical_m == pytest.approx(10.0, abs=0.2)
    assert prior.sigma_heading_deg == pytest.approx(np.degrees(0.04))
    assert prior.sigma_tilt_deg == pytest.approx(np.degrees(0.02))
    # 60 m above the pivot, 0.02 rad of tilt are 1.2 m beside the 3 m of the translation.
    assert prior.sigma_horizontal_m == pytest.approx(np.hypot(3.0, 0.02 * 60.0), abs=0.1)


def test_images_by_name() -> None:
    feature_map = random_map(1)
    name = feature_map.images[2].name
    assert image_named(feature_map, name).image_id == 2
    assert image_named(feature_map, name.rsplit("/", 1)[-1]).image_id == 2
    with pytest.raises(RegistrationError, match=r"no image is called 'none\.jpg'"):
        image_named(feature_map, "none.jpg")


def test_files_of_picks(tmp_path: Path) -> None:
    path = tmp_path / "picks.csv"
    path.write_text("# mine\n\n10.5, 20.5, 500000, 5000000, 100\n11, 21, 500001, 5000001, 101\n")
    (picks,) = read_picks(path, "a.jpg")
    assert picks.image == "a.jpg"
    np.testing.assert_array_equal(picks.pixels, [[10.5, 20.5], [11, 21]])
    np.testing.assert_array_equal(picks.utm[1], [500001, 5000001, 101])
    path.write_text("Image;Easting;Northing;Height;X;Y\nb.jpg;1;2;3;4;5\na.jpg;6;7;8;9;10\n")
    first, second = read_picks(path, None)
    assert (first.image, second.image) == ("b.jpg", "a.jpg")
    np.testing.assert_array_equal(first.pixels, [[4, 5]])
    np.testing.assert_array_equal(second.utm, [[6, 7, 8]])
    for text in ("1,5;2;3;4,25;5", "1,5\t2\t3\t4,25\t5", "1.5 2  3 4.25 5"):
        path.write_text(text, encoding="utf-16")
        (picks,) = read_picks(path, "a.jpg")
        np.testing.assert_array_equal(np.hstack([picks.pixels, picks.utm]), [[1.5, 2, 3, 4.25, 5]])


def test_picks_far_from_the_scan_are_told_with_the_distance() -> None:
    frame = random_map(1).frame
    cloud = build_cloud(frame, "unknown", np.random.default_rng(0).uniform(-50, 50, (100, 3)))

    def check(*utm: float) -> None:
        check_on_scan([Picks(image="a.jpg", pixels=np.ones((1, 2)), utm=np.array([utm]))], cloud, EPSG)

    check(EASTING, NORTHING, HEIGHT)
    with pytest.raises(RegistrationError, match=r"picks of a\.jpg: .* 9\.0 km to the east of it"):
        check(EASTING + 9_050.0, NORTHING, HEIGHT)
    with pytest.raises(GeodesyError, match=f"EPSG:{EPSG}: expected easting, .* look like degrees"):
        check(49.0, 8.4, HEIGHT)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found none"),
        ("x,y,easting,northing,height,image\n", "found none"),
        ("1,2,3,4\n", "line 1: expected x, y, easting, northing, height"),
        ("1,2,3,4,five\n", "line 1"),
        ("1,2,3,4,nan\n", "finite"),
        ("1,2,3,4,5\n", "names no photo"),
    ],
)
def test_broken_files_of_picks(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "picks.csv"
    path.write_text(text)
    with pytest.raises(RegistrationError, match=message):
        read_picks(path, None)
    with pytest.raises(RegistrationError, match="cannot be read"):
        read_picks(tmp_path / "missing.csv", None)


def test_files_of_poses(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    path.write_text(
        '{"image": "a.jpg", "easting": 1, "northing": 2, "height": 3, "yaw_deg": 4, "pitch_deg": -80}'
    )
    pose = read_pose(path, None)
    assert (pose.image, pose.yaw_deg, pose.pitch_deg, pose.roll_deg) == ("a.jpg", 4.0, -80.0, 0.0)
    path.write_text('{"easting": 0, "northing": 0, "height": 10, "look_at": [10, 0, 0], "sigma_tilt_deg": 2}')
    pose = read_pose(path, "b.jpg")
    assert pose.image == "b.jpg"
    assert pose.angles() == pytest.approx((90.0, -45.0))
    assert pose.sigma_tilt_deg == 2.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not json", "cannot be read as JSON"),
        ('{"easting": 1, "northing": 2, "height": 3}', "give yaw_deg and pitch_deg, or look_at"),
        ('{"easting": 1, "northing": 2, "height": 3, "yaw_deg": 1, "pitch_deg": 100}', "pitch_deg"),
        ('{"easting": 1, "northing": 2, "height": 3, "pitch_deg": 1, "look_at": [1, 2, 3]}', "not both"),
        ('{"easting": 1, "northing": 2, "height": 3, "look_at": [1, 2, 3]}', "own position"),
        ('{"easting": 1, "northing": 2, "height": 3, "jaw_deg": 1}', "jaw_deg"),
        ('{"easting": 1, "northing": 2, "height": 3, "yaw_deg": 1, "pitch_deg": 0}', "names no photo"),
    ],
)
def test_broken_files_of_poses(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "pose.json"
    path.write_text(text)
    with pytest.raises(RegistrationError, match=message):
        read_pose(path, None)
