"""Every way to fail: status, code, headers, and nothing of our insides."""

import os
import threading
import time
from collections.abc import Callable

import pytest
import requests

from featuredb.errors import IncompatibleExtractorError, MapNotFoundError
from reloc.gateway.failures import STATUS_OF
from reloc.service.options import ServeOptions
from reloc.wire.query import ErrorCode
from tests.support.gateway import geopose_request, running_gateway
from tests.support.service import Gate, MemorySource, ScriptedLocaliser, area_of, photo, running_server

UNUSED_PORT = "tcp/127.0.0.1:9"  # the discard service; nobody listens


@pytest.fixture(scope="module")
def gateway():
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0], max_image_bytes=100_000) as running,
    ):
        yield running


def check(response: requests.Response, status: int, code: str, says: str = "") -> None:
    body = response.json()
    assert (response.status_code, body["code"]) == (status, code), response.text
    assert says in body["message"]
    assert response.headers["content-type"] == "application/json"
    assert "Traceback" not in response.text
    assert ".py" not in response.text


def test_every_code_of_the_wire_has_a_status():
    assert {code.value for code in ErrorCode} <= STATUS_OF.keys()


def without(path: str) -> dict:
    request = geopose_request(photo())
    *parents, last = path.split(".")
    at = request
    for name in parents:
        at = at[int(name)] if isinstance(at, list) else at[name]
    del at[last]
    return request


def changed(path: str, value: object) -> dict:
    request = geopose_request(photo())
    *parents, last = path.split(".")
    at = request
    for name in parents:
        at = at[int(name)] if isinstance(at, list) else at[name]
    at[last] = value
    return request


CAMERA = "sensorReadings.cameraReadings.0"


@pytest.mark.parametrize(
    ("request_body", "status", "code", "says"),
    [
        (without("id"), 400, "BAD_REQUEST", "id: Field required"),
        (without("timestamp"), 400, "BAD_REQUEST", "timestamp"),
        (without("type"), 400, "BAD_REQUEST", "type: Field required"),
        (without("sensorReadings"), 400, "BAD_REQUEST", "sensorReadings"),
        (without(f"{CAMERA}.imageBytes"), 400, "BAD_REQUEST", "imageBytes: Field required"),
        (changed("type", "geopose-objects"), 400, "BAD_REQUEST", "type"),
        (changed("timestamp", "2020-12-26"), 400, "BAD_REQUEST", "timestamp"),
        (changed("timestamp", -1), 400, "BAD_REQUEST", "timestamp"),
        (changed("timestamp", 10**400), 400, "BAD_REQUEST", "timestamp"),
        (changed("id", "x" * 1025), 400, "BAD_REQUEST", "id"),
        (changed("sensorReadings.cameraReadings", []), 400, "BAD_REQUEST", "found none"),
        (changed("sensorReadings.cameraReadings", [{"imageBytes": "AAAA"}] * 17), 400, "BAD_REQUEST", "16"),
        (changed("sensorReadings", []), 400, "BAD_REQUEST", "sensorReadings"),
        (changed(f"{CAMERA}.imageBytes", "data:image/jpeg;base64,AAAA"), 400, "BAD_REQUEST", "base64"),
        (changed(f"{CAMERA}.imageBytes", "AAA"), 400, "BAD_REQUEST", "base64"),
        (changed(f"{CAMERA}.imageBytes", "äöü="), 400, "BAD_REQUEST", "base64"),
        (changed(f"{CAMERA}.imageBytes", [1, 2]), 400, "BAD_REQUEST", "imageBytes"),
        (changed(f"{CAMERA}.imageBytes", ""), 415, "BAD_IMAGE", "none"),
        (changed(f"{CAMERA}.imageBytes", "bm8gaW1hZ2U="), 415, "BAD_IMAGE", "image"),
        (changed(f"{CAMERA}.imageBytes", "A" * 200_000), 413, "TOO_LARGE", "100000"),
        (changed(f"{CAMERA}.imageOrientation", {"mirrored": True, "rotation": 0}), 400, "BAD_REQUEST", "mir"),
        (changed(f"{CAMERA}.params", {"model": "PINHOLE", "modelParams": [1.0]}), 400, "BAD_REQUEST", "par"),
        (changed(f"{CAMERA}.params", {"model": "FOV", "modelParams": [9.0] * 5}), 400, "BAD_REQUEST", "FOV"),
        (changed(f"{CAMERA}.params", {"model": "a b", "modelParams": [9.0] * 4}), 400, "BAD_REQUEST", "mod"),
        (changed(f"{CAMERA}.size", [1.5, 2]), 400, "BAD_REQUEST", "size"),
        (
            changed("sensorReadings.geolocationReadings", [{"latitude": 91, "longitude": 0}]),
            400,
            "BAD_REQUEST",
            "latitude",
        ),
    ],
)  # fmt: skip
def test_a_request_that_is_none(gateway, request_body, status, code, says):
    check(gateway.post("/geopose", json=request_body), status, code, says)


def test_a_lens_needs_the_size_that_it_belongs_to(gateway):
    request = geopose_request(photo(), params={"model": "PINHOLE", "modelParams": [9.0] * 4}, size=[0, 0])
    check(gateway.post("/geopose", json=request), 400, "BAD_REQUEST", "size")


def test_raw_pixels_of_another_size_are_refused(gateway):
    request = geopose_request(b"\x05" * 999, imageFormat="GRAY8")
    check(gateway.post("/geopose", json=request), 415, "BAD_IMAGE", "999 bytes")


@pytest.mark.parametrize(
    ("headers", "status", "code"),
    [
        ({"Content-Type": "text/plain"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ({"Content-Type": ""}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ({"Content-Type": "multipart/form-data; boundary=x"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ({"Content-Type": "application/json", "Content-Encoding": "gzip"}, 415, "UNSUPPORTED_MEDIA_TYPE"),
        ({"Content-Type": "application/json; charset=utf-8"}, 400, "BAD_REQUEST"),
        ({"Content-Type": "application/vnd.oscp+json; version=2.0"}, 400, "BAD_REQUEST"),
    ],
)
def test_bodies_of_other_kinds(gateway, headers, status, code):
    check(gateway.post("/geopose", data=b"{}", headers=headers), status, code)


def test_paths_and_methods_that_there_are_not(gateway):
    check(gateway.get("/elsewhere"), 404, "NOT_FOUND")
    response = gateway.get("/localise")
    check(response, 405, "METHOD_NOT_ALLOWED")
    assert response.headers["allow"] == "POST"
    for path in ("/docs", "/redoc"):
        assert gateway.get(path).status_code == 404


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"camera": "{"}, "camera"),
        ({"camera": '{"model": "PINHOLE", "width": 1, "height": 1, "params": [1]}'}, "camera: params"),
        (
            {"camera": '{"model": "PINHOLE", "width": 9, "height": 9, "params": [0.8, 0.8, 4, 4]}'},
            "millimetres",
        ),
        ({"prior": '{"lat": 100, "lon": 0, "sigma_m": 5}'}, "prior: lat"),
        ({"prior": '{"lat": 10, "lon": 0, "sigma": 5}'}, "prior: sigma"),
        ({"options": '{"inlier": true}'}, "options: inlier"),
        ({"options": '{"maps": ["no such map"]}'}, ""),
        ({"options": "x" * 70_000}, "form"),
        ({"request_id": "not one"}, "request_id"),
        ({"contribute": "true"}, "contribute"),
    ],
)
def test_a_form_that_is_none(fields, says):
    def answer(gray, request):
        raise MapNotFoundError("no map 'no such map'")

    with (
        running_server(ScriptedLocaliser(1, answer)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        response = gateway.post("/localise", data=fields, files={"image": ("p.jpg", photo())})
    check(response, 400, "BAD_REQUEST", says)


def test_forms_without_a_picture(gateway):
    check(gateway.post("/localise", files={"prior": (None, "{}")}), 400, "BAD_REQUEST", "image")
    check(gateway.post("/localise", files={"image": (None, "abc")}), 400, "BAD_REQUEST", "filename")
    two = [("image", ("a.jpg", photo())), ("image", ("b.jpg", photo()))]
    check(gateway.post("/localise", files=two), 400, "BAD_REQUEST", "once")
    check(gateway.post("/localise", files={"image": ("a.jpg", b"")}), 415, "BAD_IMAGE")
    check(gateway.post("/localise", files={"image": ("a.jpg", b"x" * 100_001)}), 413, "TOO_LARGE", "100000")
    for kind in ("multipart/form-data", "multipart/form-data; boundary=abc"):
        response = gateway.post("/localise", data=b"--nothing", headers={"Content-Type": kind})
        check(response, 400, "BAD_REQUEST")
    check(gateway.post("/localise", json={}), 415, "UNSUPPORTED_MEDIA_TYPE")


def test_no_server_is_503_with_retry_after_and_no_healthy_gateway():
    with running_gateway(UNUSED_PORT, connect_timeout_s=0.3) as gateway:
        response = gateway.post("/geopose", json=geopose_request(photo()))
        check(response, 503, "NO_SERVER", "featuredb serve")
        assert int(response.headers["retry-after"]) > 0
        check(gateway.post("/localise", files={"image": ("p.jpg", photo())}), 503, "NO_SERVER")
        check(gateway.get("/health"), 503, "NO_SERVER", "featuredb serve")
        check(gateway.get("/maps"), 503, "NO_SERVER")
        assert "featuredb_server_up 0" in gateway.get("/metrics").text


def test_a_failed_connection_is_not_tried_by_everybody_in_turn():
    with running_gateway(UNUSED_PORT, connect_timeout_s=0.5) as gateway:
        answers: list[int] = []
        threads = [
            threading.Thread(target=lambda: answers.append(gateway.get("/maps").status_code))
            for _ in range(12)
        ]
        start = time.monotonic()
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert answers == [503] * 12
        assert time.monotonic() - start < 12 * 0.5  # one after another each would wait for its own


def in_background(ask) -> tuple[threading.Thread, list[requests.Response]]:
    answers: list[requests.Response] = []
    thread = threading.Thread(target=lambda: answers.append(ask()))
    thread.start()
    return thread, answers


def test_more_photos_than_the_gateway_takes_are_busy_at_once():
    gate = Gate()
    localiser = ScriptedLocaliser(1)
    plain = localiser.localise

    def held(gray, request, size):
        gate.wait()
        return plain(gray, request, size)

    localiser.localise = held
    with (
        running_server(localiser) as server,
        running_gateway(server.endpoints[0], max_in_flight=1) as gateway,
    ):
        thread, answers = in_background(lambda: gateway.post("/geopose", json=geopose_request(photo())))
        assert gate.entered.acquire(timeout=20.0)
        for _ in range(2):
            response = gateway.post("/geopose", json=geopose_request(photo()))
            check(response, 503, "BUSY")
            assert response.headers["retry-after"] == "1"
        assert gateway.get("/health").status_code == 200  # figures have threads of their own
        assert "featuredb_gateway_in_flight 1" in gateway.get("/metrics").text
        gate.open()
        thread.join(20.0)
        assert answers[0].status_code == 200
        assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


def test_a_busy_server_is_503_with_retry_after():
    gate = Gate()

    def held(gray, request):
        gate.wait()
        raise RuntimeError

    options = ServeOptions(workers=1, max_queue=1)
    with (
        running_server(ScriptedLocaliser(1, held), options) as server,
        running_gateway(server.endpoints[0]) as gateway,
        running_gateway(server.endpoints[0], timeout_s=1.0) as hasty,
    ):
        waiting = [in_background(lambda: gateway.post("/geopose", json=geopose_request(photo())))]
        assert gate.entered.acquire(timeout=20.0)  # one in work
        waiting.append(in_background(lambda: gateway.post("/geopose", json=geopose_request(photo()))))
        end = time.monotonic() + 20.0
        while server.status().queue.length < 1:  # one waits
            assert time.monotonic() < end
            time.sleep(0.01)
        response = hasty.post("/geopose", json=geopose_request(photo()))
        gate.open()
        for thread, _ in waiting:
            thread.join(20.0)
    check(response, 503, "BUSY")
    assert response.headers["retry-after"] == "1"
    for _, (answer,) in waiting:
        check(answer, 502, "INTERNAL")


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (RuntimeError("secret of the server"), "INTERNAL"),
        (IncompatibleExtractorError("other descriptors"), "INCOMPATIBLE_EXTRACTOR"),
    ],
)
def test_a_server_that_fails_is_a_bad_gateway(error, code):
    def fail(gray, request):
        raise error

    with (
        running_server(ScriptedLocaliser(1, fail)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        response = gateway.post("/geopose", json=geopose_request(photo()))
    check(response, 502, code)
    assert "secret" not in response.text


def test_no_answer_in_time_is_504():
    gate = Gate()

    def held(gray, request):
        gate.wait()
        raise RuntimeError

    with (
        running_server(ScriptedLocaliser(1, held)) as server,
        running_gateway(server.endpoints[0], timeout_s=0.6) as gateway,
        running_gateway(server.endpoints[0], timeout_s=9.0) as patient,
    ):
        check(gateway.post("/geopose", json=geopose_request(photo())), 504, "DEADLINE")
        form = {"image": ("p.jpg", photo())}
        start = time.monotonic()
        response = patient.post("/localise", files=form, data={"options": '{"deadline_ms": 50}'})
        assert response.status_code == 504
        assert time.monotonic() - start < 7.0  # neither the gateway's 9 s nor the server's 8 s
        gate.open()


def test_a_defect_of_the_gateway_tells_nothing(gateway, monkeypatch):
    def fail(body):
        raise RuntimeError("secret in /some/path.py")

    monkeypatch.setattr(gateway.state, "geopose", fail)
    response = gateway.post("/geopose", json=geopose_request(photo()))
    check(response, 500, "INTERNAL")
    assert "secret" not in response.text
    monkeypatch.undo()
    assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


class Poison(ScriptedLocaliser):
    """Ends each worker process that opens it."""

    def __reduce__(self) -> tuple[object, ...]:
        return os._exit, (3,)


def test_a_server_without_a_worker_is_not_healthy_until_it_has_one():
    source = MemorySource(area_of(ScriptedLocaliser(1)))
    options = ServeOptions(workers=1, poll_interval_s=0.05)
    with (
        running_server(source, options) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        assert gateway.get("/health").status_code == 200
        source.publish(area_of(Poison(2)))
        until(lambda: server.status().snapshot == 2)
        response = gateway.post("/geopose", json=geopose_request(photo()))
        assert (response.status_code, response.json()["code"]) == (502, "INTERNAL")
        until(lambda: gateway.get("/health").status_code == 503)
        assert gateway.get("/health").json()["code"] == "NOT_READY"
        source.publish(area_of(ScriptedLocaliser(3)))
        until(lambda: gateway.get("/health").status_code == 200)
        assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


def until(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)
