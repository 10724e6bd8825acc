"""Two Zenoh peers on loopback: what goes out, what comes back, and how errors arrive."""

import json
import socket
import threading
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import zenoh

from featuredb.errors import IncompatibleExtractorError, ServiceError, StoreError
from featuredb.geo.utm import utm_from_geodetic
from reloc.client import NO_SERVER, TIMEOUT, CameraRequest, Client, PriorRequest
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.session import ServiceStartError
from reloc.wire.query import LocaliseReply
from tests.support.service import (
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    Gate,
    MemorySource,
    ScriptedLocaliser,
    area_of,
    client_of,
    not_localised,
    photo,
    running_server,
)


def test_a_photo_comes_back_with_the_pose_that_the_localiser_found():
    localiser = ScriptedLocaliser(7)
    data = photo()
    with running_server(localiser) as server, client_of(server) as client:
        reply = client.localise(data, request_id="q-1")
    assert reply.status == "localised"
    assert reply.request_id == "q-1"
    assert reply.snapshot == 7
    assert reply.utm is not None
    assert reply.position is not None
    # The two positions of one answer agree through PROJ, and lie where the localiser said.
    easting, northing, height = utm_from_geodetic(
        (reply.position.lat, reply.position.lon, reply.position.h), EPSG
    )
    assert (reply.utm.easting, reply.utm.northing) == pytest.approx((easting, northing), abs=1e-6)
    assert reply.utm.height == pytest.approx(height, abs=1e-6)
    assert np.hypot(easting - EASTING - 30, northing - NORTHING + 20) < 0.5
    assert height - HEIGHT == pytest.approx(50, abs=0.01)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(localiser.grays[0], expected)


def test_timings_add_up_to_the_total_and_stay_below_the_client_s_wall_time():
    with running_server(ScriptedLocaliser(1)) as server, client_of(server) as client:
        reply = client.localise(photo())
    stages = {name: ms for name, ms in reply.timings_ms.items() if name != "total"}
    assert sum(stages.values()) == pytest.approx(reply.timings_ms["total"], abs=1e-3)
    assert {"queue", "request", "decode", "exif", "extract", "match", "localise_rest"} <= stages.keys()


def test_the_request_reaches_the_localiser_as_it_was_meant():
    localiser = ScriptedLocaliser(1)
    camera = CameraRequest(model="PINHOLE", width=320, height=240, params=(300.0, 300.0, 160.0, 120.0))
    prior = PriorRequest(lat=49.01, lon=8.4, sigma_m=25.0, h=130.0, sigma_vertical_m=9.0)
    with running_server(localiser) as server, client_of(server) as client:
        plain = client.localise(photo())
        reply = client.localise(photo(), prior, camera, inliers=True, maps=("map-a",))
    first, request = localiser.requests
    assert first.camera is None
    assert first.prior is None
    assert plain.inlier_points is None
    assert request.prior is not None
    assert (request.prior.latitude_deg, request.prior.longitude_deg, request.prior.height_m) == (
        49.01,
        8.4,
        130.0,
    )
    assert (request.prior.sigma_horizontal_m, request.prior.sigma_vertical_m) == (25.0, 9.0)
    # The camera was given for twice the size of the photo sent, so its focal length halves.
    assert request.camera is not None
    assert (request.camera.width, request.camera.height) == (160, 120)
    assert request.camera.params == pytest.approx((150.0, 150.0, 80.0, 60.0))
    assert request.map_ids == ("map-a",)
    assert reply.inlier_points is not None
    assert reply.inlier_points.pixels[0] == (10.5, 20.25)
    assert reply.inlier_points.utm[1] == pytest.approx((EASTING + 5.5, NORTHING - 3.25, HEIGHT))


def test_how_well_a_camera_is_known_is_of_the_photo_as_it_was_sent():
    localiser = ScriptedLocaliser(1)
    lens = (300.0, 303.0, 160.0, 120.0, 0.1, 0.01, 0.001, 0.002)
    sigmas = (2.0, 2.0, 1.0, 0.5, 0.02, 0.03, 1e-4, 2e-4)
    whole = CameraRequest(model="OPENCV", width=320, height=240, params=lens, sigmas=sigmas)
    simple = CameraRequest(
        model="SIMPLE_RADIAL", width=320, height=240, params=(300.0, 160.0, 120.0, 0.1), sigmas=(4, 2, 2, 0.1)
    )
    with running_server(localiser) as server, client_of(server) as client:
        client.localise(photo(), camera=whole)
        client.localise(photo(), camera=simple)
    first, second = (request.camera_prior for request in localiser.requests)
    assert first is not None
    assert second is not None
    # Half the size: lengths halve, coefficients do not; the second focal length is a ratio.
    assert first.mean == pytest.approx([150.0, 80.0, 60.0, 0.1, 0.01, 0.01, 0.001, 0.002])
    assert first.sigma == pytest.approx([1.0, 0.5, 0.25, 0.02, 0.001, 0.03, 1e-4, 2e-4])
    assert second.sigma == pytest.approx([2.0, 1.0, 1.0, 0.1])


def test_not_localised_is_an_answer_with_a_reason_and_no_pose():
    with (
        running_server(ScriptedLocaliser(1, lambda *_: not_localised(1))) as server,
        client_of(server) as client,
    ):
        reply = client.localise(photo())
        assert (reply.status, reply.reason, reply.inliers) == ("not_localised", "TOO_FEW_INLIERS", 7)
        assert reply.position is None
        assert reply.utm is None
        assert client.status().queries.not_localised == {"TOO_FEW_INLIERS": 1}


def test_status_and_maps_tell_what_is_served():
    with running_server(ScriptedLocaliser(5)) as server, client_of(server) as client:
        assert client.status().latency_ms.p50 is None
        client.localise(photo())
        with pytest.raises(ServiceError):
            client.localise(b"no image")
        status = client.status()
        maps = client.maps()
    assert (status.database, status.snapshot, status.maps) == ("town", 5, 1)
    assert status.queries.received == 2
    assert status.queries.localised == 1
    assert status.queries.errors == {"BAD_IMAGE": 1}
    assert status.latency_ms.count == 1
    assert 0 < status.latency_ms.p50 == status.latency_ms.max
    assert status.queue.length == 0
    assert maps.snapshot == 5
    assert [m.map_id for m in maps.maps] == ["map-a"]


def test_status_is_answered_while_every_worker_is_busy():
    gate = Gate()

    def slow(gray, request):
        gate.wait()
        return not_localised(1)

    with (
        running_server(ScriptedLocaliser(1, slow), ServeOptions(workers=1)) as server,
        client_of(server) as client,
    ):
        asking = threading.Thread(target=client.localise, args=(photo(),))
        asking.start()
        assert gate.entered.acquire(timeout=10)
        assert client.status().queue.busy == 1
        gate.open()
        asking.join(10)
        assert not asking.is_alive()


def test_maps_of_another_extractor_are_refused_not_answered_wrongly():
    def refuse(gray, request):
        raise IncompatibleExtractorError("map-a was made with sift-2, this server extracts sift-1")

    with (
        running_server(ScriptedLocaliser(1, refuse)) as server,
        client_of(server) as client,
        pytest.raises(ServiceError, match="sift-2") as caught,
    ):
        client.localise(photo(), request_id="wrong-extractor")
    assert caught.value.code == "INCOMPATIBLE_EXTRACTOR"
    assert caught.value.request_id == "wrong-extractor"


def test_a_defect_of_the_localiser_costs_one_query_and_its_details_stay_in_the_log(caplog):
    answers = iter([ZeroDivisionError("secret path /x"), None])

    def sometimes(gray, request):
        error = next(answers)
        if error:
            raise error
        return not_localised(1)

    with running_server(ScriptedLocaliser(1, sometimes)) as server, client_of(server) as client:
        with pytest.raises(ServiceError) as caught:
            client.localise(photo(), request_id="boom")
        assert client.localise(photo()).status == "not_localised"
    assert caught.value.code == "INTERNAL"
    assert "secret" not in caught.value.message
    assert any("ZeroDivisionError" in (record.exc_text or "") for record in caplog.records)


@pytest.mark.parametrize(
    ("attachment", "code", "words"),
    [
        (b"{", "BAD_REQUEST", "Invalid JSON"),
        (b"[1]", "BAD_REQUEST", "object"),
        (b'{"piror": {}}', "BAD_REQUEST", "piror"),
        (b'{"prior": {"lat": 91, "lon": 0, "sigma_m": 5}}', "BAD_REQUEST", "prior.lat"),
        (b'{"prior": {"lat": "47", "lon": 0, "sigma_m": 5}}', "BAD_REQUEST", "prior.lat"),
        (b'{"prior": {"lat": 1, "lon": 0, "sigma_m": NaN}}', "BAD_REQUEST", "finite"),
        (
            b'{"camera": {"model": "PINHOLE", "width": 1600, "height": 1200, "params": [1, 2, 3]}}',
            "BAD_REQUEST",
            "4",
        ),
        (
            b'{"camera": {"model": "PINHOLE", "width": 1600, "height": 900, "params": [900, 900, 3, 3]}}',
            "BAD_REQUEST",
            "aspect",
        ),
        (
            b'{"camera": {"model": "LENS", "width": 4, "height": 3, "params": [1, 2, 3]}}',
            "BAD_REQUEST",
            "LENS",
        ),
        (
            b'{"camera": {"model": "PINHOLE", "width": 1600, "height": 1200, "params": [900, 900, 3, 3],'
            b' "sigmas": [1, 1, 1, 1]}}',
            "BAD_REQUEST",
            "camera.sigmas: expected the parameters of a SIMPLE_RADIAL or an OPENCV lens, found PINHOLE",
        ),
        (
            b'{"camera": {"model": "SIMPLE_RADIAL", "width": 1600, "height": 1200, "params": [900, 3, 3, 0],'
            b' "sigmas": [1, 1, 1, 1, 1]}}',
            "BAD_REQUEST",
            "camera.sigmas: known_within: expected 4 sigmas",
        ),
        (
            b'{"camera": {"model": "SIMPLE_RADIAL", "width": 1600, "height": 1200, "params": [900, 3, 3, 0],'
            b' "sigmas": [1, 1, -1, 1]}}',
            "BAD_REQUEST",
            "camera.sigmas",
        ),
        (b'{"contribute": true, "credit": "A", "licence": "CC0-1.0"}', "UNSUPPORTED", "--contributions on"),
        (b'{"contribute": true}', "BAD_REQUEST", "expected credit and licence"),
        (b'{"contribute": true, "credit": "A"}', "BAD_REQUEST", "expected licence"),
        (b'{"contribute": true, "credit": "A", "licence": " "}', "BAD_REQUEST", "licence"),
        (b'{"contribute": true, "credit": "A\\u001b[2J", "licence": "CC0-1.0"}', "BAD_REQUEST", "credit"),
        (b'{"request_id": "with space"}', "BAD_REQUEST", "request_id"),
        (b" " * 70_000, "BAD_REQUEST", "65536"),
    ],
)
def test_a_bad_attachment_is_refused_with_what_was_expected(shared_server, attachment, code, words):
    server, session = shared_server
    replies = list(
        session.get(
            f"featuredb/{server.database}/localise/anonymous",
            payload=photo(),
            attachment=attachment,
            timeout=10,
        )
    )
    assert len(replies) == 1
    error = json.loads(replies[0].err.payload.to_bytes())
    assert error["code"] == code
    assert words in error["message"]
    assert error["request_id"]


@pytest.fixture(scope="module")
def shared_server():
    with running_server(ScriptedLocaliser(1)) as server, client_of(server) as client:
        yield server, client._session()


def test_a_query_without_payload_or_attachment_is_answered_with_an_error(shared_server):
    server, session = shared_server
    (reply,) = session.get(f"featuredb/{server.database}/localise/anonymous", timeout=10)
    assert json.loads(reply.err.payload.to_bytes())["code"] == "BAD_IMAGE"


def test_a_wildcard_selector_is_answered_under_the_server_s_own_key(shared_server):
    server, session = shared_server
    (reply,) = session.get("featuredb/*/localise/*", payload=photo(), timeout=10)
    assert str(reply.ok.key_expr) == f"featuredb/{server.database}/localise/anonymous"
    assert LocaliseReply.model_validate_json(reply.ok.payload.to_bytes()).status == "localised"


def test_the_client_finds_the_only_database_by_itself_and_says_which_it_lacks(shared_server):
    server, _ = shared_server
    with Client(server.endpoints[0]) as client:
        assert client.database == "town"
        with (
            client._session().liveliness().declare_token("featuredb/hamlet/servers/x"),
            pytest.raises(ServiceError, match="serves hamlet, town; name the database"),
        ):
            Client(server.endpoints[0]).open()
    with pytest.raises(ServiceError, match="village") as caught:
        Client(server.endpoints[0], "village", connect_timeout_s=0.3).open()
    assert caught.value.code == NO_SERVER


def test_nobody_at_the_endpoint_is_said_clearly():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(ServiceError, match=f"nobody answers at tcp/127.0.0.1:{port}") as caught:
        Client(f"tcp/127.0.0.1:{port}", connect_timeout_s=0.3).open()
    assert caught.value.code == NO_SERVER


def test_the_client_s_own_timeout_is_an_error_of_its_own(shared_server):
    server, session = shared_server
    # A queryable that keeps its query without answering, as a server would that hangs.
    kept = []
    with (
        session.declare_queryable("featuredb/mute/localise/*", kept.append, complete=True),
        session.liveliness().declare_token("featuredb/mute/servers/x"),
        Client(server.endpoints[0], "mute") as client,
        pytest.raises(ServiceError) as caught,
    ):
        client.localise(photo(), timeout_s=0.4)
    assert caught.value.code == TIMEOUT
    assert len(kept) == 1
    kept[0].drop()


def test_a_taken_port_stops_the_start_with_a_clear_error():
    with running_server(ScriptedLocaliser(1)) as server:
        port = server.endpoints[0].rsplit(":", 1)[1]
        source = MemorySource(area_of(ScriptedLocaliser(1)))
        with pytest.raises(ServiceStartError, match=r"is another server running there\?") as caught:
            Server.start(source, ServeOptions(listen=(f"tcp/127.0.0.1:{port}",)), "town")
    assert port in str(caught.value)
    assert source.loads == 0  # it is told before the time is taken to load maps


def test_a_server_whose_maps_cannot_be_loaded_listens_no_longer():
    source = MemorySource(area_of(ScriptedLocaliser(1)))
    source.load = Mock(side_effect=StoreError("no such table"))
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with pytest.raises(StoreError, match="no such table"):
        Server.start(source, ServeOptions(listen=(f"tcp/127.0.0.1:{port}",)), "town")
    socket.create_server(("127.0.0.1", port)).close()


def test_liveliness_tokens_advertise_the_server_and_its_tiles(shared_server):
    server, session = shared_server
    tokens = {
        str(reply.ok.key_expr)
        for reply in session.liveliness().get("featuredb/town/**", timeout=10)
        if reply.ok
    }
    assert tokens == {
        f"featuredb/town/servers/{server.server_id}",
        f"featuredb/town/tiles/{EPSG}-E000892_N010604/{server.server_id}",
    }


def test_of_two_servers_of_one_database_one_answers():
    localisers = ScriptedLocaliser(1), ScriptedLocaliser(2)
    with running_server(localisers[0]) as one, running_server(localisers[1]) as two:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([*one.endpoints, *two.endpoints]))
        config.insert_json5("listen/endpoints", "[]")
        with zenoh.open(config) as session:
            servers = [r for r in session.liveliness().get("featuredb/town/servers/*", timeout=10) if r.ok]
            replies = list(session.get("featuredb/town/localise/anonymous", payload=photo(), timeout=10))
    assert len(servers) == 2
    assert len(replies) == 1
    assert sum(len(localiser.requests) for localiser in localisers) == 1
