"""What the viewer computes: places, points, poses, ellipses, and a page that is one file."""

import hashlib
import json
from importlib import resources
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from reloc.viewer.map_layer import coverage, describe_photos, drawn_pose, ellipse_95
from reloc.viewer.page import page, page_in_one
from reloc.viewer.points import DrawnPoints, map_points, sampled, shares
from reloc.viewer.scene import Spot, _budget, group, scan_box
from tests.support.maps import EASTING, EPSG, HEIGHT, NORTHING, random_map
from tests.support.planar_map import CAMERA, planar_map, view


def test_the_ellipse_holds_95_percent_and_points_along_its_axis() -> None:
    turn = np.radians(30.0)  # the long axis, clockwise from north
    axes = np.array([[np.sin(turn), np.cos(turn)], [np.cos(turn), -np.sin(turn)]]).T
    covariance = axes @ np.diag([0.5**2, 0.1**2]) @ axes.T
    ellipse = ellipse_95(covariance)
    assert ellipse["azimuth_deg"] == pytest.approx(30.0)
    assert ellipse["major_m"] == pytest.approx(0.5 * np.sqrt(5.991464547), rel=1e-6)
    assert ellipse["minor_m"] == pytest.approx(0.1 * np.sqrt(5.991464547), rel=1e-6)
    draws = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 200_000) @ axes
    inside = ((draws / [ellipse["major_m"], ellipse["minor_m"]]) ** 2).sum(axis=1) <= 1.0
    assert inside.mean() == pytest.approx(0.95, abs=0.003)


def test_a_pose_without_spread_has_an_ellipse_without_extent() -> None:
    assert ellipse_95(np.zeros((2, 2)))["major_m"] == 0.0


@given(st.lists(st.integers(0, 10_000), max_size=12), st.integers(0, 20_000))
@example([10_000], 7857)
def test_shares_stay_within_the_limit_and_the_counts(counts: list[int], limit: int) -> None:
    given_out = shares(counts, limit)
    assert int(given_out.sum()) <= limit
    assert (given_out <= np.array(counts, dtype=np.int64)).all()
    if sum(counts) <= limit:
        assert given_out.tolist() == counts
    else:
        assert int(given_out.sum()) > limit - len(counts)


@given(st.integers(0, 5000), st.integers(0, 5000), st.integers(0, 5000))
def test_maps_and_scans_share_the_budget(of_maps: int, of_scans: int, limit: int) -> None:
    for_maps, for_scans = _budget(of_maps, of_scans, limit)
    assert 0 <= for_maps <= of_maps
    assert 0 <= for_scans <= of_scans
    assert for_maps + for_scans == min(limit, of_maps + of_scans)
    assert for_maps >= min(of_maps, limit // 2)
    assert for_scans >= min(of_scans, limit // 2)


def test_the_sample_is_the_same_each_time_and_favours_no_part() -> None:
    rows = sampled(100_000, 10_000)
    assert rows.tolist() == sampled(100_000, 10_000).tolist()
    assert len(set(rows.tolist())) == 10_000
    # Any first part is a sample, too: its rows are spread over all of them.
    share, _ = np.histogram(rows[:1000], bins=10, range=(0, 100_000))
    assert share.min() > 60
    assert share.max() < 150


def test_points_are_where_proj_says(tmp_path: Path) -> None:
    made = random_map(5, points=3000)
    frame = LocalFrame.from_utm(EASTING + 200.0, NORTHING - 100.0, HEIGHT, EPSG)
    drawn = map_points(made.points, EPSG, frame, 1000)
    assert (len(drawn), drawn.of) == (1000, 3000)
    to_enu = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=utm +zone=32 +ellps=WGS84 +step +proj=cart +ellps=WGS84 +step "
        f"+proj=topocentric +ellps=WGS84 +lon_0={frame.longitude_deg} +lat_0={frame.latitude_deg} "
        f"+h_0={frame.height_m}"
    )
    rows = sampled(3000, 1000)
    wanted = np.column_stack(to_enu.transform(*made.points.utm[rows].T))
    np.testing.assert_allclose(drawn.offsets + drawn.origin, wanted, atol=2e-4)
    np.testing.assert_array_equal(drawn.rgb, made.points.rgb[rows])
    data = drawn.packed()
    assert len(data) == 15_000
    np.testing.assert_array_equal(np.frombuffer(data, "<f4", 3000), drawn.offsets.ravel())
    np.testing.assert_array_equal(np.frombuffer(data, np.uint8, 3000, 12_000), drawn.rgb.ravel())
    assert len(drawn.first(999).packed()) == 14_988  # filled up to four bytes


def test_strays_do_not_stretch_the_box() -> None:
    rng = np.random.default_rng(0)
    offsets = rng.uniform(-50, 50, (5000, 3)).astype(np.float32)
    offsets[:20] = [900.0, -4000.0, -300.0]
    drawn = DrawnPoints(
        origin=np.array([10.0, 20.0, 30.0]), offsets=offsets, rgb=np.zeros((5000, 3), np.uint8), of=5000
    )
    low, high = drawn.box()
    np.testing.assert_allclose(low, [-50, -40, -30], atol=12)
    np.testing.assert_allclose(high, [70, 80, 90], atol=12)
    covered = coverage(drawn)
    corners = np.array(covered["cells"]) * covered["cell_m"]
    assert np.ptp(corners, axis=0).max() < 130.0
    hull = np.array(covered["hull"])
    area = 0.5 * abs(np.dot(hull[:, 0], np.roll(hull[:, 1], 1)) - np.dot(hull[:, 1], np.roll(hull[:, 0], 1)))
    assert area == pytest.approx(100.0**2, rel=0.1)


def test_coverage_is_cells_that_hold_points() -> None:
    plan = np.array([[0.2, 0.3], [0.7, 0.1], [40.5, 3.0], [40.6, 3.1], [100.0, 50.0], [99.0, -50.0]])
    offsets = np.column_stack([plan, np.zeros(len(plan))]).astype(np.float32)
    drawn = DrawnPoints(origin=np.zeros(3), offsets=offsets, rgb=np.zeros((6, 3), np.uint8), of=6)
    covered = coverage(drawn)
    assert covered["cell_m"] == 2.0  # a sixtieth of 100 m, rounded up
    assert covered["cells"] == [[0, 0], [20, 1]]


def test_a_map_without_points_covers_nothing() -> None:
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    drawn = map_points(random_map(points=0, images=0).points, EPSG, frame, 10)
    assert coverage(drawn)["cells"] == []
    assert drawn.packed() == b""


def test_places_are_what_lies_within_reach_of_each_other() -> None:
    def spot(km: float, epsg: int = EPSG) -> Spot:
        return np.array([EASTING + 1000.0 * km, NORTHING, HEIGHT]), epsg

    far: Spot = np.array([300_000.0, 6_200_000.0, 5.0]), 32734
    places = group([far, spot(0), spot(15), spot(30), spot(90)])
    assert [rows for _, rows in places] == [[1, 2, 3], [0], [4]]
    frame = places[0][0]
    np.testing.assert_allclose(frame.utm_from_enu((0, 0, 0), EPSG)[0], EASTING + 15_000.0, atol=5.0)
    assert places[1][0].latitude_deg < 0
    assert group([]) == []


def test_maps_of_neighbouring_zones_are_one_place() -> None:
    west = LocalFrame(latitude_deg=49.0, longitude_deg=11.99, height_m=400.0)
    east = LocalFrame(latitude_deg=49.0, longitude_deg=12.01, height_m=400.0)
    spots = []
    for frame, epsg in ((west, 32632), (east, 32633)):
        e, n, h = frame.utm_from_enu(np.zeros(3), epsg)
        spots.append((np.array([e, n, h]), epsg))
    ((frame, rows),) = group(spots)
    assert rows == [0, 1]
    assert frame.longitude_deg == pytest.approx(12.0, abs=1e-4)


def test_of_a_scan_what_lies_around_the_maps_is_shown() -> None:
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    boxes = [np.array([[0, 0, 0], [10, 20, 5]]), np.array([[-30, 0, 0], [0, 10, 5]])]
    found = scan_box(frame, boxes, EPSG)
    assert found is not None
    # 50 m around, and what the turn of the grid adds at the corners.
    np.testing.assert_allclose(found, (EASTING - 80, NORTHING - 50, EASTING + 60, NORTHING + 70), atol=2.0)
    assert scan_box(frame, [], EPSG) is None


def test_a_camera_is_drawn_as_it_sees() -> None:
    pose = view(4, -6, 40, 25, 70)
    drawn = drawn_pose(pose.center, pose.rotation.T, CAMERA)
    np.testing.assert_allclose(drawn["center"], [4, -6, 40], atol=1e-4)
    tilt, heading = np.radians([25, 70])
    forward = [np.sin(tilt) * np.sin(heading), np.sin(tilt) * np.cos(heading), -np.cos(tilt)]
    np.testing.assert_allclose(drawn["forward"], forward, atol=1e-6)
    corners = pose.center + 3.0 * np.array(drawn["corners"])
    pixels = CAMERA.project(pose.act(corners))
    np.testing.assert_allclose(pixels, [[0, 0], [640, 0], [640, 480], [0, 480]], atol=0.02)


def test_a_lens_that_has_no_corners_is_drawn_as_a_plain_one() -> None:
    fisheye = Camera(model="OPENCV_FISHEYE", width=1000, height=1000, params=(40, 40, 500, 500, 0, 0, 0, 0))
    drawn = drawn_pose(np.zeros(3), np.eye(3), fisheye)
    assert np.abs(drawn["corners"]).max() <= 1.0


def test_photos_are_told_as_the_store_has_them() -> None:
    field = planar_map(1)
    frame = LocalFrame.from_utm(EASTING + 30.0, NORTHING, HEIGHT + 2.0, EPSG)
    photos = describe_photos(field, frame)
    to_utm = pyproj.Transformer.from_crs(4979, 32632, always_xy=True)
    for photo, image in zip(photos, field.images, strict=True):
        utm = photo["utm"]
        easting, northing, _ = to_utm.transform(photo["longitude_deg"], photo["latitude_deg"], utm["height"])
        assert (utm["easting"], utm["northing"]) == pytest.approx((easting, northing), abs=1e-3)
        wanted = field.frame.utm_from_enu(image.cam_from_local.center, EPSG)
        np.testing.assert_allclose([utm["easting"], utm["northing"], utm["height"]], wanted, atol=1e-4)
        np.testing.assert_allclose(frame.enu_from_utm(wanted, EPSG), photo["center"], atol=1e-3)
        # The placement's sigma of 1 cm along each axis, and no more: the photos have none of their own.
        np.testing.assert_allclose(photo["sigma_enu_m"], 0.01, atol=1e-3)
        assert photo["ellipse"]["major_m"] == pytest.approx(0.01 * 2.4477, rel=0.05)


def test_the_committed_libraries_are_the_package_s() -> None:
    vendor = resources.files("reloc.viewer") / "assets" / "vendor"
    manifest = json.loads((vendor / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["licence"] == "MIT"
    files = {f.name: f.read_bytes() for f in vendor.iterdir() if f.name != "manifest.json"}
    assert {name: hashlib.sha256(data).hexdigest() for name, data in files.items()} == manifest["sha256"]


def test_a_page_in_one_file_cannot_be_left_by_a_name() -> None:
    evil = json.dumps({"name": "</script><script>alert(1)</script><!--"})
    text = page_in_one({"scene": evil})
    assert "alert(1)</script>" not in text
    inside = text.split('id="scene">')[1].split("</script>")[0]
    assert json.loads(inside) == json.loads(evil)
    assert "/assets/" not in text.replace('"/assets/', "")
    assert 'src="' not in text


def test_both_pages_know_all_modules() -> None:
    js = resources.files("reloc.viewer") / "assets" / "js"
    for text in (page(), page_in_one({})):
        inside = text.split('<script type="importmap">')[1].split("</script>")[0]
        imports = json.loads(inside)["imports"]
        for file in js.iterdir():
            for line in file.read_text(encoding="utf-8").splitlines():
                if line.startswith("import "):
                    name = line.split('"')[1]
                    assert name in imports or ("viewer/" in imports and (js / name[7:]).is_file()), (
                        file,
                        line,
                    )
