"""`featuredb locate` and `featuredb draw` on a scan, from an answer that is there already."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.cli.main import main
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import quaternion_from_matrix
from featuredb.lidar.add import add_scan
from featuredb.store import Database
from featuredb.video.frames import open_video
from featuredb.video.writer import VideoWriter
from reloc.answered_view import AnsweredView
from reloc.tracking.ground import EarthPose
from reloc.tracking.trajectory.files import write_trajectory
from reloc.tracking.trajectory.values import Trajectory, TrajectoryPoint
from reloc.wire.query import LocaliseReply
from tests.support.command_line import only_command
from tests.support.las_files import SOUTH, WEST, grid_points, write_scan
from tests.support.maps import random_map

EPSG = 32632
CENTER = (WEST + 25.0, SOUTH + 24.0, 140.0)
LENS = Camera(model="OPENCV", width=640, height=480, params=(500.0, 500.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0))
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])  # grid axes to camera axes
COVARIANCE = np.diag([1e-8] * 3 + [0.04**2, 0.04**2, 0.05**2])


def answer() -> dict[str, object]:
    frame = LocalFrame.from_utm(*CENTER, EPSG)
    joint = np.zeros((14, 14))
    joint[:6, :6] = COVARIANCE
    joint[5, 6] = joint[6, 5] = 0.9 * 0.05 * 0.6  # a longer lens higher up
    joint[range(6, 14), range(6, 14)] = [0.6**2, 0.6**2, 0.1, 0.1, 1e-8, 1e-8, 1e-8, 1e-8]
    joint[7, 6] = joint[6, 7] = 0.99 * 0.6**2
    joint[5, 7] = joint[7, 5] = joint[5, 6]
    reply = {
        "status": "localised",
        "position": {"lat": frame.latitude_deg, "lon": frame.longitude_deg, "h": frame.height_m},
        "quaternion": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "body_axes": "x forward, y left, z up",
        "height_datum": "unknown",
        "utm": {
            "epsg": EPSG,
            **dict(zip(("easting", "northing", "height"), CENTER, strict=True)),
            "cam_from_utm_xyzw": quaternion_from_matrix(DOWN).tolist(),
        },
        "covariance": COVARIANCE.tolist(),
        "view_covariance": joint.tolist(),
        "accuracy": {"horizontal_68_m": 0.06, "vertical_68_m": 0.05, "orientation_68_deg": 0.01},
        "camera": {"model": LENS.model, "width": 640, "height": 480, "params": LENS.params, "source": "map"},
        "confidence": 0.9,
        "snapshot": 1,
        "request_id": "r",
        "detail": "",
        "timings_ms": {},
        **dict.fromkeys(("features", "matches", "inliers"), 50),
        "maps": [],
        "lineage": [],
        **dict.fromkeys(("reason", "residual_rms_px", "runner_up", "inlier_points")),
    }
    return {"image": "flight/photo.png", **reply}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("locate")
    add_scan(
        Database.create(str(folder / "db")), [write_scan(folder / "s.laz", grid_points(20_000, spacing=0.4))]
    )
    (folder / "answer.json").write_text(json.dumps(answer()) + "\n")
    cv2.imwrite(str(folder / "photo.png"), np.full((480, 640, 3), 40, np.uint8))
    return folder


@pytest.fixture
def command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(folder)
    with only_command(monkeypatch, "locate", "reloc.cli.locate:register"):
        yield


def surface_height(utm: np.ndarray) -> float:
    east, north = utm[0] - WEST, utm[1] - SOUTH
    return float(100.0 + np.sin(east / 9.0) + np.cos(north / 7.0))


def test_pixels_and_boxes_get_places_on_the_scan(
    folder: Path, command: None, capsys: pytest.CaptureFixture[str]
) -> None:
    box = {"image_id": "photo", "category_id": 1, "bbox": [300.0, 200.0, 40.0, 40.0]}
    (folder / "boxes.json").write_text(json.dumps([box]))
    words = ["locate", "photo.png", "--database", "db", "--answer", "answer.json", "--json"]
    code = main([*words, "--pixel", "100,90", "--boxes", "boxes.json", "--geojson", "out.geojson"])
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert code == 0
    assert [line["pixel"] for line in lines] == [[100.0, 90.0], [320.0, 240.0]]
    ray = np.append(LENS.unproject([100.0, 90.0])[0], 1.0)
    for line in lines:
        utm = np.array(line["utm"])
        assert abs(utm[2] - surface_height(utm)) < 0.03
    utm = np.array(lines[0]["utm"])
    expected = np.array(CENTER) + (CENTER[2] - utm[2]) * (DOWN.T @ ray)
    np.testing.assert_allclose(utm, expected, atol=0.03)  # grid and true north agree on the central meridian
    np.testing.assert_allclose(lines[1]["utm"][:2], CENTER[:2], atol=0.01)
    collection = json.loads((folder / "out.geojson").read_text())
    assert [f["properties"].get("bbox") for f in collection["features"]] == [None, box["bbox"]]
    # Nothing says that the answer's heights of an unknown datum are the scan's.
    assert all("both of an unknown datum" in line["detail"] for line in lines)


def test_heights_of_a_map_that_a_scan_placed_are_the_scan_s(
    folder: Path, command: None, capsys: pytest.CaptureFixture[str]
) -> None:
    database, maps = Database.open(str(folder / "db")), {}
    for seed, method in ((1, "lidar"), (2, "gps")):
        made = random_map(seed)
        maps[method] = replace(
            made, placement=replace(made.placement, method=method), generation=0, parents=()
        )
    database.commit_maps(list(maps.values()))
    for method, doubts in (("lidar", False), ("gps", True)):
        line = json.dumps({**answer(), "maps": [maps[method].map_id]})
        (folder / f"{method}.json").write_text(line)
        words = ["locate", "photo.png", "--database", "db", "--answer", f"{method}.json", "--json"]
        assert main([*words, "--pixel", "100,90"]) == 0
        assert ("both of an unknown datum" in capsys.readouterr().out) is doubts


def test_what_pose_and_lens_have_in_common_does_not_move_a_place() -> None:
    """Higher by 5 cm with a lens longer by 0.6 px: seen from 40 m, the same ground."""
    view = AnsweredView.of_reply(LocaliseReply.model_validate_json(json.dumps(answer())))
    _, by_view = view.pixel_derivatives(view.cam_from_local.inverse().act(np.array([16.0, 0.0, 40.0])))
    together = by_view @ view.covariance @ by_view.T
    each_alone = by_view @ np.diag(np.diag(view.covariance)) @ by_view.T
    by_height_px, by_lens_px = 500.0 * 16 / 40 / 40 * 0.05, 0.6 * 16 / 40
    assert together[0, 0] == pytest.approx(each_alone[0, 0] - 1.8 * by_height_px * by_lens_px, rel=0.05)


def test_mistakes_end_before_the_photo_is_read(
    folder: Path, command: None, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["locate", "photo.png", "--database", "db", "--answer", "answer.json"]
    assert main(["locate", "missing.jpg", "--database", "db", "--pixel", "1,2"]) == 2
    assert "missing.jpg: expected a photo" in capsys.readouterr().err
    for words, said in (
        ([], "--pixel U,V or --boxes"),
        (["--pixel", "1;2"], "expected U,V"),
        (["--pixel", "1,2", "--scan-sigma=-1"], "--scan-sigma"),
        (["--pixel", "1,2", "--geojson", "photo.png/place.geojson"], "--geojson"),
    ):
        assert main([*base, *words]) == 2
        assert said in capsys.readouterr().err
    assert main(["locate", "other.png", *base[2:], "--pixel", "1,2"]) == 2
    assert "expected one answer about other.png" in capsys.readouterr().err


def test_boxes_of_a_turned_picture_are_refused_or_spoken_of(
    folder: Path, command: None, capsys: pytest.CaptureFixture[str]
) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation.value] = 6
    Image.new("RGB", (640, 480)).save(folder / "turned.jpg", exif=exif)
    (folder / "turned.json").write_text(json.dumps({**answer(), "image": "turned.jpg"}))
    words = ["locate", "turned.jpg", "--database", "db", "--answer", "turned.json", "--boxes", "boxes.json"]
    box = {"image_id": 3, "bbox": [300.0, 200.0, 40.0, 40.0]}
    image = {"id": 3, "file_name": "turned.jpg"}
    for size, code, said in (
        ({}, 0, "EXIF turns the picture (orientation 6)"),
        ({"width": 640, "height": 480}, 0, ""),
        ({"width": 480, "height": 640}, 2, "found those of 480x640"),
    ):
        coco = {"images": [{**image, **size}], "annotations": [box]}
        (folder / "boxes.json").write_text(json.dumps(coco))
        assert main(words) == code
        told = capsys.readouterr().err
        assert said in told
        assert said or not told


def test_a_drawing_replaces_no_photo_and_is_of_the_photo_that_was_answered(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    place = {"type": "Point", "coordinates": [9.0, 48.0, 100.0]}
    (folder / "place.geojson").write_text(
        json.dumps({"type": "Feature", "properties": {}, "geometry": place})
    )
    (folder / "turned").mkdir()
    cv2.imwrite(str(folder / "turned/photo.png"), np.zeros((640, 480, 3), np.uint8))
    before = (folder / "photo.png").read_bytes()
    with only_command(monkeypatch, "draw", "reloc.cli.draw:register"):
        for photo, out, said in (
            ("photo.png", "./photo.png", "expected another file than photo.png"),
            ("photo.png", "drawn.xyz", "expected a picture such as"),
            ("photo.png", "photo.png/drawn.png", "in a folder that can be written"),
            ("missing.png", "drawn.jpg", "expected a photo"),
            ("turned/photo.png", "drawn.jpg", "of the shape of 640x480 pixels, found 480x640"),
        ):
            words = ["draw", photo, "place.geojson", "--database", "db", "--answer", "answer.json"]
            assert main([*words, "--out", out]) == 2
            assert said in capsys.readouterr().err
        for name in ("xyz", "jpg"):
            assert not (folder / f"drawn.{name}").exists()
    assert (folder / "photo.png").read_bytes() == before


def test_a_layer_is_drawn_where_the_answer_sees_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    frame = LocalFrame.from_utm(*CENTER, EPSG)
    corners = frame.geodetic_from_enu(np.array([[-8.0, -5.0, -40.0], [9.0, 6.0, -40.0]]))
    line = {"type": "LineString", "coordinates": [[lon, lat] for lat, lon, _ in corners.tolist()]}
    (folder / "layer.geojson").write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": line}))
    with only_command(monkeypatch, "draw", "reloc.cli.draw:register"):
        words = ["draw", "photo.png", "layer.geojson", "--database", "db", "--answer", "answer.json"]
        assert main([*words, "--out", "drawn.png"]) == 0
    picture = cv2.imread(str(folder / "drawn.png"))
    rows, columns = np.nonzero(picture.max(axis=2) > 150)
    heights = [
        surface_height(np.array([CENTER[0] + e, CENTER[1] + n])) for e, n in ((-8.0, -5.0), (9.0, 6.0))
    ]
    ends = np.array([[-8.0, -5.0, heights[0] - 140.0], [9.0, 6.0, heights[1] - 140.0]])
    pixels = LENS.project(Rigid3(rotation=DOWN, translation=np.zeros(3)).act(ends))
    for pixel in pixels:
        assert np.hypot(columns + 0.5 - pixel[0], rows + 0.5 - pixel[1]).min() < 2.0


def test_a_layer_stays_where_it_belongs_in_a_film(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera moves on by 2 m a frame; the layer is a spot with a height of its own."""
    monkeypatch.chdir(folder)
    frame = LocalFrame.from_utm(*CENTER, EPSG)
    spot = np.array([3.0, 2.0, -36.0])
    latitude, longitude, height = frame.geodetic_from_enu(spot).tolist()
    place = {"type": "Point", "coordinates": [longitude, latitude, height]}
    (folder / "spot.geojson").write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": place}))
    points = []
    with VideoWriter(folder / "film.mp4", width=640, height=480, fps=25.0) as film:
        for index in range(4):
            film.write(np.full((480, 640, 3), 20, np.uint8))
            moved = Rigid3(rotation=DOWN, translation=-DOWN @ [2.0 * index, 0.0, 0.0])
            pose = EarthPose(
                epsg=EPSG,
                utm=frame.utm_from_enu(moved.center, EPSG),
                height_datum="unknown",
                cam_from_utm_xyzw=quaternion_from_matrix(DOWN),
                geopose=geopose_from_camera(moved, frame),
                covariance=COVARIANCE,
                map_id="m",
            )
            lost = index == 2
            points.append(
                TrajectoryPoint(
                    index=index,
                    time_s=index / 25,
                    state="lost" if lost else "tracking",
                    pose=None if lost else pose,
                    detail="blur" if lost else "",
                )
            )
    write_trajectory(folder / "track.csv", Trajectory(source="film.mp4", points=tuple(points)))
    with only_command(monkeypatch, "draw", "reloc.cli.draw:register"):
        words = [
            "draw",
            "film.mp4",
            "spot.geojson",
            "--database",
            "db",
            "--track",
            "track.csv",
            "--out",
            "out.mp4",
        ]
        assert main(words) == 2  # its lens is missing
        lens = f"OPENCV,640,480,{','.join(map(str, LENS.params))}"
        assert main([*words, "--camera", lens]) == 0
    with open_video(folder / "out.mp4") as film:
        for shown in film:
            rows, columns = np.nonzero(shown.rgb().max(axis=2) > 120)
            if shown.index == 2:
                assert not len(rows)
                continue
            expected = LENS.project(DOWN @ (spot - [2.0 * shown.index, 0.0, 0.0]))[0]
            ring = np.array([columns.min() + columns.max() + 1, rows.min() + rows.max() + 1]) / 2
            assert np.hypot(*(ring - expected)) < 2.0
