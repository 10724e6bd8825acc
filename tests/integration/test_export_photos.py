"""GeoJSON, KML and GeoPose: every photo where and how it was taken, whose it is, and how sure that is."""

import json
import os
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from featuredb.export.formats.geojson import write_geojson
from featuredb.export.formats.geopose import write_geopose
from featuredb.export.formats.kml import write_kml
from featuredb.export.job import ExportJob
from featuredb.export.selection import Selection
from featuredb.export.shots import pose_covariance, shots_of
from featuredb.geo.geopose import BODY_FROM_CAM
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import so3_log
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from schemas import load_schema
from tests.support import planar_map as field
from tests.support.maps import random_map

KML = "{http://www.opengis.net/kml/2.2}"


@pytest.fixture(scope="module")
def field_map() -> FeatureMap:
    """Tilted and nadir photos of two people; some without a time, or without its zone."""
    feature_map = field.planar_map(map_id="field")
    zones = (UTC, None, timezone(timedelta(hours=2)))
    rng = np.random.default_rng(5)
    half = rng.normal(0, 0.02, (6, 6))
    images = tuple(
        replace(
            image,
            name=f"day 1/{image.name}" if k < 8 else 'q"<&>.png',
            owner="Ann & Co" if k % 2 else "",
            licence="CC-BY-4.0" if k % 2 else "",
            covariance=half @ half.T if k % 3 else None,
            capture_time=None if k == 4 else datetime(2026, 5, 1, 12, 59 - k, tzinfo=zones[k % 3]),
        )
        for k, image in enumerate(feature_map.images)
    )
    return replace(feature_map, images=images, licence="CC0-1.0")


def job_of(tmp_path: Path, *maps: FeatureMap, out: str = "out") -> ExportJob:
    database = Database.create(tmp_path / "maps.db")
    database.commit_maps(list(maps))
    return ExportJob(
        database=database, snapshot=database.snapshot(), selection=Selection(), out=tmp_path / out
    )


def test_the_covariance_is_that_of_centre_and_rotation_in_true_axes(field_map: FeatureMap) -> None:
    """Against numeric derivatives of what the two covariances are said to belong to."""
    far = replace(
        field_map,
        placement=replace(
            field_map.placement, covariance=np.diag([1e-6, 1e-5, 2e-5, 3e-5, 0.01, 0.02, 0.03])
        ),
    )
    image = far.images[1]
    pose, step = image.cam_from_local, 1e-6

    def moved(other: Rigid3) -> np.ndarray:
        turned = so3_log(other.rotation.T @ pose.rotation)
        return np.concatenate([turned, other.center - pose.center]) / step

    own = np.column_stack([moved(Rigid3.exp(step * e) @ pose) for e in np.eye(6)])
    placed = np.column_stack([moved(Sim3.exp(step * e).act_on_pose(pose)) for e in np.eye(7)])
    assert image.covariance is not None
    local = own @ image.covariance @ own.T + placed @ far.placement.covariance @ placed.T
    turn = np.kron(np.eye(2), far.frame.true_enu_from_enu(pose.center))
    expected = turn @ local @ turn.T
    np.testing.assert_allclose(
        pose_covariance(far, image), expected, rtol=2e-5, atol=2e-5 * np.abs(expected).max()
    )


def test_geojson_tells_every_photo(tmp_path: Path, field_map: FeatureMap) -> None:
    other = replace(field_map, map_id="other", height_datum="unknown")
    done = write_geojson(job_of(tmp_path, field_map, other, out="photos.geojson"))
    document = json.loads((tmp_path / "photos.geojson").read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection"
    assert done.images == len(document["features"]) == 18
    first = [f for f in document["features"] if f["properties"]["map_id"] == "field"]
    for image, found in zip(field_map.images, first, strict=True):
        lon, lat, height = found["geometry"]["coordinates"]
        enu = field_map.frame.enu_from_geodetic((lat, lon, height))
        np.testing.assert_allclose(enu, image.cam_from_local.center, atol=2e-4)
        told = found["properties"]
        assert (told["image"], told["owner"]) == (image.name, image.owner)
        assert told["licence"] == (image.licence or "CC0-1.0")
        assert told["sha256"] == image.sha256
        assert told["height_datum"] == "ellipsoidal"
        axis = image.cam_from_local.rotation[2]
        heading, pitch = np.radians([told["heading_deg"], told["pitch_deg"]])
        assert axis[2] == pytest.approx(np.sin(pitch), abs=1e-5)
        if abs(pitch) < np.radians(85):
            assert np.arctan2(axis[0], axis[1]) % (2 * np.pi) == pytest.approx(heading, abs=1e-4)
        sigma = np.sqrt(np.diag(pose_covariance(field_map, image)))[3:]
        np.testing.assert_allclose(told["sigma_enu_m"], sigma, atol=1e-4)
    unknown = [f["properties"] for f in document["features"] if f["properties"]["map_id"] == "other"]
    assert {p["height_datum"] for p in unknown} == {"unknown"}


def test_kml_looks_where_the_photo_looks(tmp_path: Path, field_map: FeatureMap) -> None:
    """Turned as the standard says, about z, x, z again, KML's camera has the map's axes."""
    rolled = Rigid3.exp([0.0, 0.0, 0.4, 0, 0, 0]) @ field_map.images[3].cam_from_local
    images = (
        *field_map.images[:3],
        replace(field_map.images[3], cam_from_local=rolled),
        *field_map.images[4:],
    )
    feature_map = replace(field_map, images=images)
    write_kml(job_of(tmp_path, feature_map, out="photos.kml"))
    document = ET.parse(tmp_path / "photos.kml").getroot()
    overlays = list(document.iter(f"{KML}PhotoOverlay"))
    assert [o.findtext(f"{KML}name") for o in overlays] == [i.name for i in images]
    for image, shot, overlay in zip(images, shots_of(feature_map), overlays, strict=True):
        camera = {child.tag.removeprefix(KML): child.text or "" for child in overlay[2]}
        heading, tilt, roll = (float(camera[name]) for name in ("heading", "tilt", "roll"))
        enu_from_view = Rotation.from_euler("ZXZ", [-heading, tilt, roll], degrees=True).as_matrix()
        view_from_cam = np.diag([1.0, -1.0, -1.0])
        true_from_cam = shot.geopose.true_enu_from_body @ BODY_FROM_CAM
        np.testing.assert_allclose(enu_from_view @ view_from_cam, true_from_cam, atol=2e-3)
        enu = feature_map.frame.enu_from_geodetic(
            (float(camera["latitude"]), float(camera["longitude"]), float(camera["altitude"]))
        )
        np.testing.assert_allclose(enu[:2], image.cam_from_local.center[:2], atol=1e-3)
        data = {d.get("name"): d.findtext(f"{KML}value") for d in overlay.iter(f"{KML}Data")}
        assert (data["owner"] or "", data["licence"]) == (image.owner, image.licence or "CC0-1.0")
        view = overlay.find(f"{KML}ViewVolume")
        assert view is not None
        assert float(view.findtext(f"{KML}rightFov") or "nan") == pytest.approx(
            np.degrees(np.arctan(320 / 600)), abs=1e-4
        )
    # The order of elements is that of the schema; Google Earth refuses others.
    order = [child.tag.removeprefix(KML) for child in overlays[0]]
    assert order == [
        *("name", "description", "Camera", "TimeStamp", "ExtendedData", "Icon", "ViewVolume", "Point"),
    ]


def test_geopose_validates_and_leads_back_to_the_pose(tmp_path: Path, field_map: FeatureMap) -> None:
    write_geopose(job_of(tmp_path, field_map))
    folder = tmp_path / "out" / "field"
    check = {
        name: jsonschema.Draft202012Validator(load_schema(f"geopose/{name}"))
        for name in ("basic_ypr", "irregular_series")
    }
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert [p["image"] for p in manifest["photos"]] == [i.name for i in field_map.images]
    assert manifest["height_datum"] == "ellipsoidal"
    timed = []
    for image, entry in zip(field_map.images, manifest["photos"], strict=True):
        basic = json.loads((folder / "basic_ypr" / entry["file"]).read_text())
        check["basic_ypr"].validate(basic)
        place, angles = basic["position"], basic["angles"]
        enu = field_map.frame.enu_from_geodetic((place["lat"], place["lon"], place["h"]))
        np.testing.assert_allclose(enu, image.cam_from_local.center, atol=1e-6)
        true_from_body = Rotation.from_euler(
            "ZYX", [angles["yaw"], angles["pitch"], angles["roll"]], degrees=True
        ).as_matrix()
        true_from_local = field_map.frame.true_enu_from_enu(image.cam_from_local.center)
        expected = true_from_local @ image.cam_from_local.rotation.T @ BODY_FROM_CAM.T
        np.testing.assert_allclose(true_from_body, expected, atol=2e-3)
        has_time = image.capture_time is not None and image.capture_time.tzinfo is not None
        if has_time:
            timed.append(image)
    series = json.loads((folder / "series.json").read_text())
    check["irregular_series"].validate(series)
    times = [entry["validTime"] for entry in series["innerFrameAndTimeSeries"]]
    assert times == sorted(
        round(1000 * i.capture_time.timestamp()) for i in timed if i.capture_time is not None
    )
    assert len(times) == len(timed) == 6
    first = min(timed, key=lambda i: i.capture_time)  # type: ignore[arg-type, return-value]
    last = max(timed, key=lambda i: i.capture_time)  # type: ignore[arg-type, return-value]
    text = series["innerFrameAndTimeSeries"][-1]["frame"]["parameters"]
    translation = json.loads(text.split("&")[0].removeprefix("translation="))
    turn = field_map.frame.true_enu_from_enu(first.cam_from_local.center)
    moved = turn @ (last.cam_from_local.center - first.cam_from_local.center)
    np.testing.assert_allclose(translation, moved, atol=1e-3)


@pytest.mark.parametrize("write", [write_geojson, write_kml, write_geopose])
def test_the_same_maps_give_the_same_bytes(tmp_path: Path, field_map: FeatureMap, write: object) -> None:
    assert callable(write)
    job = job_of(tmp_path, field_map, random_map(3))
    write(job)
    write(replace(job, out=tmp_path / "again"))
    if job.out.is_file():
        assert job.out.read_bytes() == (tmp_path / "again").read_bytes()
        return
    files = sorted(f.relative_to(job.out) for f in job.out.rglob("*") if f.is_file())
    assert files
    for name in files:
        assert (job.out / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


_KILLED = """
import os, signal, sys
from pathlib import Path
from featuredb.export.formats.geojson import write_geojson
from featuredb.export.formats.geopose import write_geopose
from featuredb.export.job import ExportJob
from featuredb.export.formats.kml import write_kml
from featuredb.export.selection import Selection
from featuredb.store import Database
database = Database.open(sys.argv[1])
{"geojson": write_geojson, "kml": write_kml, "geopose": write_geopose}[sys.argv[3]](
    ExportJob(database=database, snapshot=database.snapshot(), selection=Selection(), out=Path(sys.argv[2]),
              told=lambda done, total: os.kill(os.getpid(), signal.SIGKILL)))
"""


@pytest.mark.parametrize("name", ["geojson", "kml", "geopose"])
def test_a_kill_in_the_middle_leaves_nothing(tmp_path: Path, name: str) -> None:
    job = job_of(tmp_path, random_map(1), random_map(2))
    died = subprocess.run(
        [sys.executable, "-c", _KILLED, str(tmp_path / "maps.db"), str(job.out), name],
        capture_output=True, text=True, timeout=120, check=False, env=os.environ,
    )  # fmt: skip
    assert died.returncode == -signal.SIGKILL, died.stderr
    assert not job.out.exists()
