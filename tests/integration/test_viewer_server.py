"""The viewer's routes: what they give, whom they refuse, and that nothing sent to them breaks them."""

import hashlib
import http.client
import io
import json
import shutil
import signal
import socket
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pyproj
import pytest
import requests
from fastapi import FastAPI
from PIL import ExifTags, Image
from scipy.spatial import cKDTree

from featuredb.store import Database
from reloc.listening import ListenError, listen
from reloc.localiser import Localiser
from reloc.service.handler import answer_query
from reloc.viewer.photos import PICTURE_PX, Pictures
from reloc.viewer.scene import build_scene
from reloc.viewer.server import HOST, serve
from reloc.wire.query import LocaliseWireRequest
from tests.support.maps import random_map
from tests.support.viewer import MISSING, ViewerWorld, get, make_world, running_viewer

pytestmark = pytest.mark.slow

PHOTO = {"Content-Type": "application/octet-stream"}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> ViewerWorld:
    return make_world(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="module")
def url(world: ViewerWorld) -> Iterator[str]:
    with running_viewer(world.database, photos=world.photos) as address:
        yield address


def post(url: str, data: bytes, **headers: str) -> requests.Response:
    return requests.post(f"{url}/api/query", data=data, headers={**PHOTO, **headers}, timeout=60)


def test_the_page_allows_nothing_from_elsewhere(url: str) -> None:
    page = get(url + "/")
    assert page.headers["content-type"].startswith("text/html")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert "http:" not in policy
    assert "unsafe" not in policy
    assert "//" not in page.text.replace("https://", "").replace("</", "")  # no address in the page


def test_points_are_the_maps_own(url: str, world: ViewerWorld) -> None:
    scene = get(f"{url}/api/scene").json()
    place = scene["places"][0]
    data = get(f"{url}/api/points/0").content
    field = next(m for m in place["maps"] if m["id"] == "field")
    buffer = field["buffer"]
    n, start = buffer["count"], buffer["offset"]
    assert n == len(world.field.points)
    offsets = np.frombuffer(data, "<f4", 3 * n, start).reshape(n, 3)
    rgb = np.frombuffer(data, np.uint8, 3 * n, start + 12 * n).reshape(n, 3)
    assert (rgb == [200, 60, 40]).all()
    # The same points by PROJ's own topocentric conversion.
    frame = place["frame"]
    pipeline = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=utm +zone=32 +ellps=WGS84 +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={frame['longitude_deg']} "
        f"+lat_0={frame['latitude_deg']} +h_0={frame['height_m']}"
    )
    wanted = np.column_stack(pipeline.transform(*world.field.points.utm.T))
    found = offsets.astype(np.float64) + buffer["origin"]
    for rows, others in ((found, wanted), (wanted, found)):
        assert cKDTree(others).query(rows)[0].max() < 2e-4


def test_a_picture_is_the_photo_as_it_is_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation.value] = 6  # "turn by 90 degrees to look at it"
    pixels = np.zeros((900, 1600, 3), np.uint8)
    pixels[:, :800] = (250, 10, 10)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "JPEG", exif=exif.tobytes())
    digest = hashlib.sha256(out.getvalue()).hexdigest()
    made = random_map(images=1)
    made = replace(made, images=(replace(made.images[0], name="a/turned.jpg", sha256=digest),))
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "by another name.jpg").write_bytes(out.getvalue())
    database = Database.create(tmp_path / "maps.db")
    database.commit_map(made)
    with running_viewer(database, photos=tmp_path / "photos") as url:
        response = get(f"{url}/api/picture", params={"map": made.map_id, "image": 0})
    picture = Image.open(io.BytesIO(response.content))
    assert picture.size == (PICTURE_PX, round(PICTURE_PX * 900 / 1600))
    assert picture.getexif().get(ExifTags.Base.Orientation.value) is None
    left, right = np.asarray(picture)[300, 100], np.asarray(picture)[300, 1100]
    assert left[0] > 200
    assert right[0] < 50


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ({"map": "field", "image": "999"}, 404),
        ({"map": "../../maps.db", "image": "0"}, 404),
        ({"map": "field", "image": "../0"}, 422),
        ({"map": "field"}, 422),
        ({"map": "field", "image": "1e9"}, 422),
        ({"map": "field", "image": "-1"}, 404),
    ],
)
def test_no_picture_but_those_of_the_maps(url: str, asked: dict[str, str], status: int) -> None:
    response = get(f"{url}/api/picture", params=asked)
    assert response.status_code == status
    assert set(response.json()) == {"detail"}


def test_a_missing_photo_is_a_reason(url: str, world: ViewerWorld) -> None:
    row = [image.name for image in world.field.images].index(MISSING)
    response = get(f"{url}/api/picture", params={"map": "field", "image": row})
    assert response.status_code == 404
    assert "there is no such file" in response.json()["detail"]


@pytest.mark.parametrize(
    "path",
    [
        "/assets/../page.py",
        "/assets/%2e%2e/page.py",
        "/assets/js/..%2f..%2fpage.py",
        "/assets//etc/passwd",
        "/assets/vendor",
        "/api/points/7",
        "/api/points/-1",
        "/docs",
        "/openapi.json",
    ],
)
def test_other_files_are_not_found(url: str, path: str) -> None:
    where = urlsplit(url)
    connection = http.client.HTTPConnection(where.hostname or "", where.port, timeout=30)  # as it is written
    connection.request("GET", path)
    response = connection.getresponse()
    assert response.status == 404
    assert json.loads(response.read())["detail"]
    connection.close()


@pytest.mark.parametrize("host", ["example.org", "127.0.0.1.example.org", "localhost.example.org:8080", ""])
def test_a_name_that_leads_here_is_refused(url: str, host: str) -> None:
    for path in ("/", "/api/scene", "/api/points/0"):
        assert get(url + path, headers={"Host": host}).status_code == 400
    assert get(f"{url}/api/scene", headers={"Host": f"localhost:{urlsplit(url).port}"}).status_code == 200


def test_it_listens_on_this_machine_only(url: str) -> None:
    with listen(HOST, 0) as bound:
        assert bound.getsockname()[0] == "127.0.0.1"
        port = bound.getsockname()[1]
        with pytest.raises(ListenError, match=f"127.0.0.1:{port}.*--port"):
            listen(HOST, port)
    with pytest.raises(ListenError):
        listen(HOST, 70_000)


def test_a_query_is_answered_as_by_the_server(url: str, world: ViewerWorld) -> None:
    data = world.query.read_bytes()
    answer = post(url, data).json()
    reply = answer["reply"]
    wanted = answer_query(LocaliseWireRequest(), data, Localiser.open(world.database))
    assert wanted.utm is not None
    assert reply["utm"]["easting"] == pytest.approx(wanted.utm.easting, abs=1e-6)
    assert reply["inliers"] == wanted.inliers
    # Drawn in the place's frame: the pose where the reply says, the ellipse from its covariance.
    field = world.field
    scene = build_scene(world.database, world.database.snapshot())
    center = scene.frames[answer["place"]].enu_from_utm(
        [reply["utm"][name] for name in ("easting", "northing", "height")], field.epsg
    )
    np.testing.assert_allclose(answer["pose"]["center"], center, atol=1e-3)
    largest = np.linalg.eigvalsh(np.array(reply["covariance"])[3:5, 3:5])[-1]
    assert answer["pose"]["ellipse"]["major_m"] == pytest.approx(np.sqrt(5.991 * largest), rel=1e-3)
    assert len(answer["points"]) == reply["inliers"]
    assert answer["overlay"].startswith("data:image/jpeg;base64,")


def test_a_photo_of_elsewhere_is_an_answer_without_a_pose(url: str, world: ViewerWorld) -> None:
    response = post(url, world.elsewhere.read_bytes())
    assert response.status_code == 200
    answer = response.json()
    assert set(answer) == {"reply"}
    assert answer["reply"]["status"] == "not_localised"
    assert answer["reply"]["reason"] in ("TOO_FEW_MATCHES", "TOO_FEW_INLIERS")


def hostile(world: ViewerWorld) -> dict[str, bytes]:
    photo = world.query.read_bytes()
    return {
        "nothing": b"",
        "text": b"<script>alert(1)</script>",
        "half": photo[: len(photo) // 2],
        "header": photo[:40],
        "noise": np.random.default_rng(0).bytes(5000),
        "zeros": bytes(5000),
        "icon": _png(20, 20),
        "thin": _png(3000, 64),
        "bomb": _png(60_000, 60_000, claimed=True),
    }


def _png(width: int, height: int, *, claimed: bool = False) -> bytes:
    out = io.BytesIO()
    Image.new("L", (8, 8) if claimed else (width, height)).save(out, "PNG")
    data = bytearray(out.getvalue())
    if claimed:
        data[16:24] = width.to_bytes(4, "big") + height.to_bytes(4, "big")
        data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    return bytes(data)


@pytest.mark.parametrize(
    "kind", ["nothing", "text", "half", "header", "noise", "zeros", "icon", "thin", "bomb"]
)
def test_a_hostile_photo_is_refused_in_json(url: str, world: ViewerWorld, kind: str) -> None:
    response = post(url, hostile(world)[kind])
    if kind == "thin":  # a photo without features is one, and is not localised
        assert response.json()["reply"]["status"] == "not_localised"
        return
    assert 400 <= response.status_code < 500
    assert set(response.json()) == {"message"}


def test_a_photo_is_taken_only_as_the_page_sends_it(url: str, world: ViewerWorld) -> None:
    data = world.query.read_bytes()
    for media_type in (
        "text/plain",
        "multipart/form-data; boundary=x",
        "application/x-www-form-urlencoded",
        "",
    ):
        assert post(url, data, **{"Content-Type": media_type}).status_code == 415
    # What another site's page would ask first is not allowed to it.
    asked = {"Origin": "http://example.org", "Access-Control-Request-Method": "POST"}
    response = requests.options(f"{url}/api/query", headers=asked, timeout=30)
    assert response.status_code == 405
    assert "access-control-allow-origin" not in response.headers


def test_a_body_that_is_too_large_is_refused(url: str) -> None:
    where = urlsplit(url)
    with socket.create_connection((where.hostname or "", where.port or 0), timeout=60) as connection:
        head = (
            f"POST /api/query HTTP/1.1\r\nHost: {where.netloc}\r\nContent-Type: application/octet-stream\r\n"
            "Transfer-Encoding: chunked\r\n\r\n"
        )
        connection.sendall(head.encode())
        chunk = b"%x\r\n%s\r\n" % (1 << 20, bytes(1 << 20))
        answer = b""
        try:
            for _ in range(66):  # two more than are taken
                connection.sendall(chunk)
            answer = connection.recv(4096)
        except (BrokenPipeError, ConnectionResetError):
            pass  # hung up on while it was still sending
        assert answer == b"" or answer.startswith(b"HTTP/1.1 413")
    assert get(f"{url}/api/scene").status_code == 200


def test_a_spot_is_told_in_utm_and_degrees(url: str, world: ViewerWorld) -> None:
    frame = build_scene(world.database, world.database.snapshot()).frames[0]
    told = get(f"{url}/api/where", params={"place": 0, "east": 12.5, "north": -7.25, "up": 1.0}).json()
    easting, northing, _ = frame.utm_from_enu((12.5, -7.25, 1.0), 32632)
    assert told["utm"] == {
        "epsg": 32632,
        "easting": pytest.approx(easting, abs=1e-3),
        "northing": pytest.approx(northing, abs=1e-3),
    }
    to_utm = pyproj.Transformer.from_crs(4326, 32632)
    np.testing.assert_allclose(
        to_utm.transform(told["latitude_deg"], told["longitude_deg"]), (easting, northing), atol=2e-3
    )
    for east, status in (("nan", 400), ("inf", 400), ("1e300", 400), ("x", 422)):
        response = get(f"{url}/api/where", params={"place": 0, "east": east, "north": 0, "up": 0})
        assert response.status_code == status
    assert get(f"{url}/api/where", params={"place": 3, "east": 0, "north": 0, "up": 0}).status_code == 404


def test_a_database_that_is_gone_is_an_error_in_json(tmp_path: Path, world: ViewerWorld) -> None:
    shutil.copytree(world.database.url, tmp_path / "maps.db")
    with running_viewer(Database.open(tmp_path / "maps.db")) as url:
        shutil.rmtree(tmp_path / "maps.db")
        response = post(url, world.query.read_bytes())
        assert response.status_code == 500
        assert response.json()["message"]
        assert get(f"{url}/api/scene").status_code == 200  # the page goes on


def test_the_command_serves_until_it_is_stopped(world: ViewerWorld) -> None:
    command = [sys.executable, "-m", "featuredb.cli", "view", world.database.url, "--no-browser"]
    command += ["--photos", str(world.photos), "--trajectory", str(world.track), "--maps", "field"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split(";")[0].rstrip("/")
            assert url.startswith("http://127.0.0.1:")
            scene = get(f"{url}/api/scene").json()
            assert [m["id"] for m in scene["places"][0]["maps"]] == ["field"]
            assert len(scene["places"][0]["trajectories"][0]["frames"]) == 11
            assert get(f"{url}/api/picture", params={"map": "field", "image": 0}).status_code == 200
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
            assert process.stderr is not None
            assert process.stderr.read() == ""
        finally:
            process.kill()


def test_a_stop_signal_right_after_the_address_was_told_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server takes signals from its own start on; one that comes before may not be lost."""
    opened: list[str] = []

    def stop_at_once(url: str) -> bool:
        opened.append(url)
        signal.raise_signal(signal.SIGTERM)
        return True

    monkeypatch.setattr("webbrowser.open", stop_at_once)
    serve(FastAPI(), 0, browser=True)
    assert len(opened) == 1


def test_without_a_folder_of_photos_the_page_says_so() -> None:
    data, reason = Pictures(None).jpeg(random_map(images=1).images[0], 100)
    assert data is None
    assert "--photos" in reason
