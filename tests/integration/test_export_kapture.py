"""A map as kapture has it: read by its own package where that is installed, and by its specification."""

import csv
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from featuredb.errors import ExportError
from featuredb.export.formats.kapture import kapture_names, write_kapture, write_map
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.maps.feature_map import FeatureMap, GeoPrior
from featuredb.store import Database
from tests.support.scanned_map import scanned_map

GPS = GeoPrior(
    latitude_deg=48.5, longitude_deg=11.25, height_m=512.5, sigma_horizontal_m=4.0, sigma_vertical_m=10.0
)
NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


@pytest.fixture(scope="module")
def ground() -> FeatureMap:
    """Every fifth keypoint has lost its descriptor; the first photo has a position and a time."""
    made = scanned_map(points=200).feature_map
    first, *others = made.images
    seen = made.observations
    kept = np.arange(len(seen)) % 5 != 1
    return replace(
        made,
        images=(replace(first, gps=GPS, capture_time=NOON, owner="Ann", licence="CC-BY-4.0"), *others),
        observations=replace(
            seen, has_descriptor=kept, descriptors=np.where(kept[:, None], seen.descriptors, np.uint8(0))
        ),
    )


def rows(path: Path) -> list[list[str]]:
    """As kapture's specification says: commas, spaces around them ignored, comments left out."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0] == "# kapture format: 1.1"
    assert lines[1].startswith("# ")
    return [[value.strip() for value in line.split(",")] for line in lines if not line.startswith("#")]


def test_its_files_draw_the_points_where_they_were_seen(tmp_path: Path, ground: FeatureMap) -> None:
    """Cameras by COLMAP's code, quaternions by SciPy: each residual is the map's to 1e-4 px."""
    write_map(tmp_path / "m", ground)
    sensors, reconstruction = tmp_path / "m" / "sensors", tmp_path / "m" / "reconstruction"
    cameras = {
        r[0]: pycolmap.Camera(
            camera_id=1, model=r[3], width=int(r[4]), height=int(r[5]), params=[float(v) for v in r[6:]]
        )
        for r in rows(sensors / "sensors.txt")
        if r[2] == "camera"
    }
    poses = {(r[0], r[1]): [float(v) for v in r[2:]] for r in rows(sensors / "trajectories.txt")}
    records = {r[2]: (r[0], r[1]) for r in rows(sensors / "records_camera.txt")}
    points = np.array([[float(v) for v in r] for r in rows(reconstruction / "points3d.txt")])
    np.testing.assert_allclose(points[:, :3], ground.points_local(), atol=0)
    np.testing.assert_array_equal(points[:, 3:], ground.points.rgb)
    assert rows(reconstruction / "keypoints" / "sift" / "keypoints.txt") == [["SIFT", "float32", "4"]]
    images = {image.name: image for image in ground.images}
    local, count = ground.points_local(), 0
    for point, kind, *pairs in rows(reconstruction / "observations.txt"):
        for name, feature in zip(pairs[::2], pairs[1::2], strict=True):
            path = reconstruction / "keypoints" / kind / f"{name}.kpt"
            x, y, *_ = np.fromfile(path, np.float32).reshape(-1, 4)[int(feature)].tolist()
            qw, qx, qy, qz, *t = poses[records[name]]
            there = Rotation.from_quat([qx, qy, qz, qw]).apply(points[int(point), :3]) + t
            theirs = cameras[records[name][1]].img_from_cam(there[None])[0] - (x, y)
            image = images[name]
            seen = ground.observations
            mine = (seen.point_index == int(point)) & (seen.image_id == image.image_id)
            camera = ground.cameras[image.camera_id]
            ours = camera.project(image.cam_from_local.act(local[int(point)]))[0] - seen.xy[mine]
            assert np.abs(ours - theirs).sum(axis=1).min() < 1e-4
            count += 1
    assert count == len(ground.observations)


def test_keypoints_and_descriptors_are_rows_of_the_same(tmp_path: Path, ground: FeatureMap) -> None:
    write_map(tmp_path / "m", ground)
    place, seen = tmp_path / "m" / "reconstruction", ground.observations
    kind = rows(place / "descriptors" / "sift" / "descriptors.txt")
    assert kind == [["SIFT", "uint8", "128", "sift", "L2"]]
    for image in ground.images:
        points = np.fromfile(place / "keypoints" / "sift" / f"{image.name}.kpt", np.float32).reshape(-1, 4)
        found = np.fromfile(place / "descriptors" / "sift" / f"{image.name}.desc", np.uint8).reshape(-1, 128)
        mine = np.flatnonzero(seen.image_id == image.image_id)
        mine = mine[np.argsort(~seen.has_descriptor[mine], kind="stable")]
        np.testing.assert_array_equal(points[:, :2], seen.xy[mine])
        np.testing.assert_allclose(points[:, 2] * 2.0, seen.scale[mine], rtol=1e-6)
        np.testing.assert_allclose(np.degrees(points[:, 3]), seen.angle[mine], atol=1e-4)
        np.testing.assert_array_equal(found, seen.descriptors[mine])


def test_positions_times_and_attribution(tmp_path: Path, ground: FeatureMap) -> None:
    write_map(tmp_path / "m", ground)
    first = ground.images[0]
    assert rows(tmp_path / "m" / "sensors" / "records_gnss.txt") == [
        [str(first.image_id), f"GPS_camera{first.camera_id}", "11.25", "48.5", "512.5", "1777636800", "0.0"]
    ]
    gnss = [r for r in rows(tmp_path / "m" / "sensors" / "sensors.txt") if r[2] == "gnss"]
    assert gnss == [[f"GPS_camera{first.camera_id}", "", "gnss", "EPSG:4326"]]
    with (tmp_path / "m" / "attribution.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert (table[0]["owner"], table[0]["licence"]) == ("Ann", "CC-BY-4.0")
    assert (tmp_path / "m" / "georeference.json").is_file()


def test_the_same_map_gives_the_same_bytes_whole_or_not_at_all(tmp_path: Path, ground: FeatureMap) -> None:
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(ground)
    written, told = [], []
    for name in ("a", "b"):
        job = ExportJob(
            database=database,
            snapshot=database.snapshot(),
            selection=Selection(),
            out=tmp_path / name,
            told=lambda done, total: told.append((done, total)),
        )
        done = write_kapture(job)
        assert (done.maps, done.points, done.observations) == (1, 200, len(ground.observations))
        files = sorted(p for p in job.out.rglob("*") if p.is_file())
        written.append({p.relative_to(job.out): p.read_bytes() for p in files})
        assert sum(len(data) for data in written[-1].values()) == done.bytes
    assert written[0] == written[1]
    assert told == [(1, 1), (1, 1)]
    with pytest.raises(ExportError, match="expected a name that is free"):
        write_kapture(job)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a,b.jpg", "a%2Cb.jpg"),
        ("flight 1/ä.jpg", "flight 1/ä.jpg"),
        ("../../etc/x.jpg", "%2E%2E/%2E%2E/etc/x.jpg"),
        ("/etc/x.jpg", "%/etc/x.jpg"),
        (" #1\n.jpg ", "%20%231%0A.jpg%20"),
        ("x\\y.jpg", "x%5Cy.jpg"),
    ],
)
def test_names_that_kapture_cannot_have(tmp_path: Path, ground: FeatureMap, name: str, expected: str) -> None:
    odd = replace(ground, images=(replace(ground.images[0], name=name), *ground.images[1:]))
    assert kapture_names(odd)[0] == expected
    write_map(tmp_path / "m", odd)
    assert (tmp_path / "m" / "reconstruction" / "keypoints" / "sift" / f"{expected}.kpt").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["m"]


def test_names_stay_different(ground: FeatureMap) -> None:
    first, second, *others = ground.images
    odd = replace(ground, images=(replace(first, name="a,b"), replace(second, name="a%2Cb"), *others))
    assert kapture_names(odd)[:2] == ["a%2Cb", "a%252Cb"]


@pytest.mark.slow  # compiles for a minute or two when it is first imported
def test_kaptures_own_package_reads_it(tmp_path: Path, ground: FeatureMap) -> None:
    """It is no requirement, since it brings a test runner and numba along. Tried with version 1.1.12."""
    kapture = pytest.importorskip("kapture", reason="kapture's own package is not installed")
    kapture_csv: Any = pytest.importorskip("kapture.io.csv")
    features: Any = pytest.importorskip("kapture.io.features")
    write_map(tmp_path / "m", ground)
    assert kapture_csv.kapture_format_version(str(tmp_path / "m")) == "1.1"
    read = kapture_csv.kapture_from_dir(str(tmp_path / "m"))
    assert {name for _, _, name in kapture.flatten(read.records_camera)} == {i.name for i in ground.images}
    for image in ground.images:
        device = f"camera{image.camera_id}"
        pose = read.trajectories[image.image_id, device]
        np.testing.assert_allclose(pose.inverse().t.ravel(), image.cam_from_local.center, atol=1e-9)
        camera = ground.cameras[image.camera_id]
        assert read.sensors[device].camera_type.name == camera.model
        np.testing.assert_array_equal(read.sensors[device].camera_params[2:], camera.params)
        path = features.get_keypoints_fullpath("sift", str(tmp_path / "m"), image.name)
        kind = read.keypoints["sift"]
        points = features.image_keypoints_from_file(path, kind.dtype, kind.dsize)
        assert len(points) == (ground.observations.image_id == image.image_id).sum()
    np.testing.assert_array_equal(read.points3d.as_array()[:, :3], ground.points_local())
    assert read.observations.observations_number() == len(ground.observations)
    assert read.descriptors["sift"].dsize == 128
    first = ground.images[0]
    record = read.records_gnss[first.image_id, f"GPS_camera{first.camera_id}"]
    assert (record.x, record.y, record.z) == (11.25, 48.5, 512.5)
