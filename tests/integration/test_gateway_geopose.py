"""GeoPoseProtocol over HTTP, against a real server on loopback Zenoh and a real uvicorn."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from featuredb.geo.datum import HeightConversion
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from reloc.client import CameraRequest, PriorRequest
from reloc.gateway import geopose
from tests.support.gateway import NOW_MS, geolocation, geopose_request, running_gateway
from tests.support.service import (
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    ScriptedLocaliser,
    client_of,
    localised,
    not_localised,
    photo,
    running_server,
)

LENS = {"model": "PINHOLE", "modelParams": [300.0, 300.0, 160.0, 120.0]}


@pytest.fixture(scope="module")
def served():
    localiser = ScriptedLocaliser(3)
    with (
        running_server(localiser) as server,
        client_of(server) as client,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        yield localiser, client, gateway


def asked(served, request):
    """Send a request; the gateway's answer and what reached the localiser."""
    localiser, _, gateway = served
    response = gateway.post("/geopose", json=request)
    assert response.status_code == 200, response.text
    return response.json(), localiser.requests[-1]


def test_the_answer_is_that_of_the_zenoh_client_in_the_protocol_s_words(served):
    localiser, client, gateway = served
    data = photo()
    reply = client.localise(data)
    response = gateway.post("/geopose", json=geopose_request(data))
    assert response.status_code == 200
    assert response.headers["content-type"] == "application/json"
    assert response.headers["featuredb-height-datum"] == "ellipsoidal"
    assert reply.position is not None
    assert reply.quaternion is not None
    assert response.json() == {
        "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
        "timestamp": NOW_MS,
        # A covariance of 1e-6 rad2 and 0.01 m2 in every direction (tests/support/service.py).
        "accuracy": {
            "position": pytest.approx(0.1),
            "orientation": pytest.approx(np.degrees(1e-3)),
        },
        "type": "geopose",
        "geopose": {
            "position": reply.position.model_dump(),
            "quaternion": reply.quaternion.model_dump(),
        },
    }
    np.testing.assert_array_equal(localiser.grays[-1], localiser.grays[-2])


def test_the_quaternion_turns_forward_left_up_into_east_north_up(served):
    """By another way than ours: the map frame's camera axes through WGS84's Cartesian ones."""
    answer, _ = asked(served, geopose_request(photo()))
    q = answer["geopose"]["quaternion"]
    enu_from_body = Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]])
    rotation = Rigid3.exp([2.3, 0.2, -0.1, 0, 0, 0]).rotation  # cam_from_local of the scripted pose
    right, down, forward = rotation  # rows are the camera's axes in the frame's east, north, up
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    at = answer["geopose"]["position"]
    turn = _enu_axes(at["lat"], at["lon"]) @ _enu_axes(frame.latitude_deg, frame.longitude_deg).T
    for body, camera in (((1, 0, 0), forward), ((0, 1, 0), -right), ((0, 0, 1), -down)):
        np.testing.assert_allclose(enu_from_body.apply(body), turn @ camera, atol=1e-9)


def _enu_axes(lat: float, lon: float) -> np.ndarray:
    """Rows: east, north, up in Earth-centred axes."""
    a, o = np.radians([lat, lon])
    return np.array(
        [
            [-np.sin(o), np.cos(o), 0],
            [-np.sin(a) * np.cos(o), -np.sin(a) * np.sin(o), np.cos(a)],
            [np.cos(a) * np.cos(o), np.cos(a) * np.sin(o), np.sin(a)],
        ]
    )


def test_a_level_camera_that_looks_east_has_the_identity_and_north_a_quarter_turn():
    """What the protocol's web client (spARcl) and reference server (OpenVPS) take the identity for."""
    frame = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
    east = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # rows: right, down, forward
    north = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for rotation, expected in ((east, (0, 0, 0, 1)), (north, (0, 0, np.sqrt(0.5), np.sqrt(0.5)))):
        pose = geopose_from_camera(Rigid3(rotation=rotation, translation=np.zeros(3)), frame)

        def answer(gray, request, pose=pose):
            result = localised(1, _camera())
            return replace(result, pose=replace(result.pose, geopose=pose))

        with (
            running_server(ScriptedLocaliser(1, answer)) as server,
            running_gateway(server.endpoints[0]) as gateway,
        ):
            q = gateway.post("/geopose", json=geopose_request(photo())).json()["geopose"]["quaternion"]
        assert (q["x"], q["y"], q["z"], q["w"]) == pytest.approx(expected, abs=1e-9)


def _camera() -> Camera:
    return Camera.from_focal(160, 120, 192.0)


def test_camera_and_position_reach_the_localiser_as_the_wire_s_would(served):
    localiser, client, _ = served
    request = geopose_request(photo(), size=[320, 240], params=LENS)
    request["sensorReadings"]["geolocationReadings"] = [
        geolocation(48.0, 8.0, 30.0, NOW_MS - 60_000),
        geolocation(49.01, 8.4, 100.0),
    ]
    _, got = asked(served, request)
    client.localise(
        photo(),
        # 95 % of the errors of two axes lie within 2.4477 sigmas (chi-square of two degrees: 5.9915).
        PriorRequest(lat=49.01, lon=8.4, sigma_m=100 / np.sqrt(5.99146454710798)),
        CameraRequest(model="PINHOLE", width=320, height=240, params=(300.0, 300.0, 160.0, 120.0)),
    )
    wanted = localiser.requests[-1]
    assert got.camera == wanted.camera
    assert got.camera.params == pytest.approx((150.0, 150.0, 80.0, 60.0))
    assert got.prior.latitude_deg == wanted.prior.latitude_deg
    assert got.prior.sigma_horizontal_m == pytest.approx(wanted.prior.sigma_horizontal_m, rel=1e-9)
    assert got.prior.height_m is None


@pytest.mark.parametrize(
    ("place", "sigma_m"),
    [
        (geolocation(49.0, 8.4, 3.0), 10.0),  # nobody is believed to be within three metres
        (geolocation(49.0, 8.4, 0.0), 50.0),  # the clients' zero is "not filled in"
        (geolocation(0.0, 0.0, 0.0), None),  # nor is that a place
        ({"latitude": 49.0, "longitude": 8.4}, 50.0),
        ({"latitude": 49.0, "longitude": 8.4, "accuracy": None, "altitude": None}, 50.0),
    ],
)
def test_accuracies_that_clients_send(served, place, sigma_m):
    request = geopose_request(photo())
    request["sensorReadings"]["geolocationReadings"] = [place]
    _, got = asked(served, request)
    assert (got.prior and got.prior.sigma_horizontal_m) == (sigma_m and pytest.approx(sigma_m))


def prior_pose(age_s: float, lat: float = 49.0) -> dict:
    return {
        "id": "x",
        "timestamp": NOW_MS - age_s * 1e3,
        "type": "geopose",
        "accuracy": {"position": 2.0, "orientation": 1.0},
        "geopose": {
            "position": {"lat": lat, "lon": 8.4, "h": 1.0},
            "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1},
        },
    }


def test_prior_poses_serve_while_they_are_fresh_and_no_position_is_there(served):
    request = geopose_request(photo())
    request["priorPoses"] = [prior_pose(20.0, 48.5), prior_pose(4.0, 49.5), prior_pose(90.0, 47.0)]
    _, got = asked(served, request)
    assert got.prior.latitude_deg == 49.5
    assert got.prior.sigma_horizontal_m == pytest.approx(2.0 + 4.0 * 15.0)
    request["sensorReadings"]["geolocationReadings"] = [geolocation(49.2, 8.4, 100.0)]
    assert asked(served, request)[1].prior.latitude_deg == 49.2
    request = geopose_request(photo())
    request["priorPoses"] = [prior_pose(301.0)]
    assert asked(served, request)[1].prior is None


@pytest.mark.parametrize(
    "params", [None, {}, {"model": "UNKNOWN"}, {"model": "UNKNOWN_CAMERA", "modelParams": [1.0, 2.0, 3.0]}]
)
def test_an_unknown_lens_is_none(served, params):
    extra = {} if params is None else {"params": params}
    assert asked(served, geopose_request(photo(), **extra))[1].camera is None


def test_the_request_as_the_reference_client_makes_it_is_answered(served):
    """Python's demo client: fractional time, RGBA32 for a JPEG, every sensor's list, empty fields."""
    request = geopose_request(
        photo(),
        imageFormat="RGBA32",
        params={"model": "OPENCV", "modelParams": [200.0, 200.0, 80.0, 60.0, 0, 0, 0, 0], "minMaxDepth": []},
    )
    request["timestamp"] = NOW_MS + 0.25
    request["priorPoses"] = []
    request["sensors"][0] |= {
        "name": "",
        "rigIdentifier": "",
        "rigRotation": {"x": 0, "y": 0, "z": 0, "w": 1},
    }
    request["sensorReadings"] |= {
        "geolocationReadings": [geolocation(47.61155, -122.337056, 0.0)],
        "accelerometerReadings": [{"x": 1, "y": 2, "z": 3}],
        "wifiReadings": [{"anything": True}],
        "bluetoothReadings": [],
    }
    answer, got = asked(served, request)
    assert answer["timestamp"] == NOW_MS + 0.25
    assert got.camera.model == "OPENCV"


@pytest.mark.parametrize(("name", "channels"), [("GRAY8", 1), ("RGBA32", 4)])
def test_raw_pixels_are_taken_as_the_format_says(served, name, channels):
    localiser, _, _ = served
    pixels = np.random.default_rng(4).integers(0, 256, (120, 160, 1), dtype=np.uint8)
    data = np.repeat(pixels, channels, axis=2).tobytes()
    asked(served, geopose_request(data, imageFormat=name))
    np.testing.assert_array_equal(localiser.grays[-1], pixels[..., 0])


def test_a_depth_image_is_passed_over(served):
    request = geopose_request(photo(seed=5))
    readings = request["sensorReadings"]["cameraReadings"]
    readings.insert(0, {**readings[0], "imageFormat": "DEPTH", "imageBytes": "AAAA"})
    asked(served, request)
    depth_only = geopose_request(photo(), imageFormat="DEPTH")
    response = served[2].post("/geopose", json=depth_only)
    assert (response.status_code, response.json()["code"]) == (400, "BAD_REQUEST")


def test_not_localised_is_422_with_reason_and_ids():
    with (
        running_server(ScriptedLocaliser(1, lambda *_: not_localised(1))) as server,
        running_gateway(server.endpoints[0], prefix="/vps/v2") as gateway,
    ):
        assert gateway.url.endswith("/vps/v2")
        response = gateway.post("/geopose", json=geopose_request(photo()))
    assert response.status_code == 422
    assert response.json() == {
        "code": "NOT_LOCALISED",
        "message": "TOO_FEW_INLIERS: 7 of 12 needed",
        "request_id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
        "reason": "TOO_FEW_INLIERS",
        "id": "d9fbf438-b7c6-419a-a75b-1cf79275e58d",
    }


@pytest.mark.parametrize(
    ("accept", "status", "media_type"),
    [
        ("application/vnd.oscp+json; version=2.0;", 200, "application/vnd.oscp+json; version=2.0"),
        ("text/html, application/vnd.oscp+json;version=2", 200, "application/vnd.oscp+json; version=2.0"),
        ("application/vnd.oscp+json", 200, "application/vnd.oscp+json; version=2.0"),
        ("application/vnd.oscp+json; version=1.0;", 406, "application/json"),
        ("application/vnd.oscp+json; version=1.0, application/vnd.oscp+json; version=2.0", 200, None),
        ("*/*", 200, "application/json"),
    ],
)
def test_the_version_is_that_of_the_accept_header(served, accept, status, media_type):
    response = served[2].post("/geopose", json=geopose_request(photo()), headers={"Accept": accept})
    assert response.status_code == status
    if media_type is not None:
        assert response.headers["content-type"] == media_type
    if status == 406:
        assert response.json()["code"] == "NOT_ACCEPTABLE"


def test_heights_of_another_datum_are_named_where_they_cannot_be_converted(monkeypatch):
    def answer(gray, request):
        result = localised(1, _camera())
        return replace(result, pose=replace(result.pose, height_datum="egm96"))

    with (
        running_server(ScriptedLocaliser(1, answer)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        seen = {}
        for known in (None, 217.25):
            monkeypatch.setattr(
                geopose,
                "ellipsoidal_height",
                lambda lat, lon, h, datum, known=known: (
                    seen.update({datum: h})
                    or HeightConversion(height_m=known, reason=None if known else "no grid")
                ),
            )
            response = gateway.post("/geopose", json=geopose_request(photo()))
            height = response.json()["geopose"]["position"]["h"]
            if known is None:
                assert response.headers["featuredb-height-datum"] == "egm96"
                assert height == pytest.approx(seen["egm96"])
            else:
                assert response.headers["featuredb-height-datum"] == "ellipsoidal"
                assert height == known


def test_the_id_is_echoed_whatever_it_is(served):
    for text in ("", "a b/ü\n", "x" * 1024):
        request = geopose_request(photo())
        request["id"] = text
        assert asked(served, request)[0]["id"] == text


def test_base64_is_what_python_s_own_makes(served):
    localiser, _, _ = served
    data = photo("PNG", seed=8)
    asked(served, geopose_request(base64.b64encode(data).decode()))
    _, client, _ = served
    client.localise(data)
    np.testing.assert_array_equal(localiser.grays[-1], localiser.grays[-2])
