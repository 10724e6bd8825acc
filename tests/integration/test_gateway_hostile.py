"""Bodies that are too much, too slow or too deep, and clients that go: each costs one answer and no more."""

import base64
import json
import random
import socket
import time

import pytest

from reloc.gateway import serve
from tests.support.gateway import geopose_request, running_gateway
from tests.support.service import ScriptedLocaliser, photo, running_server

LIMIT = 300_000


@pytest.fixture(scope="module")
def gateway():
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0], max_body_bytes=LIMIT, body_timeout_s=1.0) as running,
    ):
        yield running


@pytest.fixture(autouse=True)
def _nothing_stays_in_hand(gateway):
    yield
    end = time.monotonic() + 10.0
    while gateway.state.intake.in_flight or gateway.state.intake.buffered_bytes:
        assert time.monotonic() < end, "a request is still in hand"
        time.sleep(0.01)
    assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


def connected(gateway) -> socket.socket:
    return socket.create_connection(("127.0.0.1", gateway.port), timeout=20.0)


def head(path: str, *fields: str, kind: str = "application/json") -> bytes:
    lines = [f"POST {path} HTTP/1.1", "Host: gateway", f"Content-Type: {kind}", *fields]
    return "\r\n".join(lines).encode() + b"\r\n\r\n"


def answer(link: socket.socket) -> tuple[int, dict]:
    """Status and JSON of the answer on a raw connection."""
    data = b""
    while b"\r\n\r\n" not in data or not data.endswith(b"}"):
        part = link.recv(65_536)
        if not part:
            break
        data += part
    top, _, body = data.partition(b"\r\n\r\n")
    return int(top.split()[1]), json.loads(body)


@pytest.mark.parametrize("path", ["/geopose", "/localise"])
def test_a_body_that_says_it_is_too_large_is_refused_before_it_comes(gateway, path):
    kind = "application/json" if path == "/geopose" else "multipart/form-data; boundary=b"
    with connected(gateway) as link:
        link.sendall(head(path, "Content-Length: 99999999999", "Expect: 100-continue", kind=kind))
        status, body = answer(link)
    assert (status, body["code"]) == (413, "TOO_LARGE")
    assert str(LIMIT) in body["message"]


def test_a_client_that_sends_all_of_it_still_hears_why(gateway):
    """It reads only when it has sent; a connection closed before would be reset, and the answer lost."""
    size = 20_000_000
    with connected(gateway) as link:
        link.sendall(head("/geopose", f"Content-Length: {size}"))
        for _ in range(0, size, 1_000_000):
            link.sendall(b"x" * 1_000_000)
        status, body = answer(link)
    assert (status, body["code"]) == (413, "TOO_LARGE")


@pytest.mark.parametrize("path", ["/geopose", "/localise"])
def test_a_stream_without_an_end_is_cut_at_the_limit(gateway, path):
    """Chunked, with no length said: what is held never exceeds the limit."""
    kind = "application/json" if path == "/geopose" else "multipart/form-data; boundary=b"
    start = (
        b""
        if path == "/geopose"
        else (b'--b\r\nContent-Disposition: form-data; name="image"; filename="a"\r\n\r\n')
    )
    held, intake = 0, gateway.state.intake
    with connected(gateway) as link:
        link.sendall(head(path, "Transfer-Encoding: chunked", kind=kind))
        if start:
            link.sendall(b"%x\r\n%s\r\n" % (len(start), start))
        link.settimeout(0.01)
        sent, chunk, got = 0, b"10000\r\n" + b"7" * 65_536 + b"\r\n", b""
        end = time.monotonic() + 20.0
        while not got and time.monotonic() < end:
            try:
                link.sendall(chunk)
                sent += 65_536
            except TimeoutError:
                break  # half a chunk: no more of this; the answer comes all the same
            except OSError:
                break
            held = max(held, intake.buffered_bytes)
            try:
                got = link.recv(65_536)
            except TimeoutError:
                continue
        link.settimeout(20.0)
        if not got:
            got = link.recv(65_536)
    assert got.startswith(b"HTTP/1.1 413 ")
    assert sent > LIMIT
    assert 0 < held <= LIMIT


def test_a_body_that_does_not_come_is_given_up(gateway):
    with connected(gateway) as link:
        link.sendall(head("/geopose", "Content-Length: 100") + b'{"id"')
        start = time.monotonic()
        status, body = answer(link)
    assert (status, body["code"]) == (408, "SLOW_BODY")
    assert 0.9 < time.monotonic() - start < 10.0


def test_a_body_that_drips_is_given_up_as_a_whole(gateway):
    """Each byte comes in time; all of them do not."""
    with connected(gateway) as link:
        link.sendall(head("/geopose", "Content-Length: 100000"))
        link.settimeout(0.05)
        got, end = b"", time.monotonic() + 20.0
        while not got and time.monotonic() < end:
            link.sendall(b" ")
            try:
                got = link.recv(4096)
            except TimeoutError:
                continue
    assert got.startswith(b"HTTP/1.1 408 ")


def test_a_client_that_goes_costs_nothing(gateway):
    with connected(gateway) as link:
        link.sendall(head("/geopose", "Content-Length: 100000") + b"{")
        end = time.monotonic() + 10.0
        while not gateway.state.intake.buffered_bytes:
            assert time.monotonic() < end
            time.sleep(0.01)
    end = time.monotonic() + 10.0
    while 'status="499"' not in gateway.get("/metrics").text:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_bodies_that_drip_take_no_place_of_others(gateway):
    """As many as photos may be in hand, and more."""
    links = [connected(gateway) for _ in range(20)]
    for link in links:
        link.sendall(head("/geopose", "Content-Length: 100000") + b" ")
    end = time.monotonic() + 10.0
    while gateway.state.intake.buffered_bytes < len(links):
        assert time.monotonic() < end
        time.sleep(0.01)
    assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200
    for link in links:
        link.close()


@pytest.mark.parametrize("before", [b"", head("/none", "Content-Length: 0")], ids=["first", "kept"])
def test_a_head_that_drips_is_given_up(monkeypatch, before):
    """Of a new connection, and of one that is kept after an answer."""
    monkeypatch.setattr(serve, "_LOOK_S", 0.05)
    monkeypatch.setattr(serve, "_KEEP_ALIVE_S", 1)
    end = time.monotonic() + 20.0
    with running_gateway("tcp/127.0.0.1:1") as unserved, connected(unserved) as link:
        link.sendall(before)
        if before:
            assert answer(link)[0] == 404
        link.settimeout(0.1)
        while time.monotonic() < end:
            try:
                link.sendall(b"P")
                if link.recv(100) == b"":
                    break
            except TimeoutError:
                continue
            except OSError:
                break
    assert time.monotonic() < end, "the connection stayed open"


def test_bodies_together_do_not_fill_the_memory():
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0], max_buffered_bytes=100_000) as gateway,
    ):
        with connected(gateway) as link:
            link.sendall(head("/geopose", "Content-Length: 95000") + b" " * 90_000)
            end = time.monotonic() + 10.0
            while gateway.state.intake.buffered_bytes < 90_000:
                assert time.monotonic() < end
                time.sleep(0.01)
            response = gateway.post(
                "/geopose", data=b" " * 20_000, headers={"Content-Type": "application/json"}
            )
            assert (response.status_code, response.json()["code"]) == (503, "BUSY")
            assert response.headers["retry-after"] == "1"
        end = time.monotonic() + 10.0
        while gateway.state.intake.buffered_bytes:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"null",
        b"[]",
        b"nonsense",
        b"\xff\xfe\x00",
        b'{"id": "\\ud800"}',
        b'{"id": NaN}',
        b"[" * 200_000,
        b'{"id":' * 40_000,
        b'{"sensorReadings":' * 15_000 + b"1" + b"}" * 15_000,
        b'{"timestamp": 1' + b"0" * 250_000 + b"}",
        b'{"id": "x", "id": "y"}',
    ],
    ids=lambda body: repr(body[:12]),
)
def test_json_that_is_none_or_too_deep(gateway, body):
    start = time.monotonic()
    response = gateway.post("/geopose", data=body, headers={"Content-Type": "application/json"})
    assert (response.status_code, response.json()["code"]) == (400, "BAD_REQUEST")
    assert len(response.content) < 2_000
    assert time.monotonic() - start < 5.0


def test_deep_json_in_a_field_that_is_ignored(gateway):
    request = geopose_request(photo())
    text = json.dumps(request)[:-1] + ', "other": ' + "[" * 100_000 + "]" * 100_000 + "}"
    response = gateway.post("/geopose", data=text, headers={"Content-Type": "application/json"})
    assert (response.status_code, response.json()["code"]) == (400, "BAD_REQUEST")


def test_a_picture_that_unpacks_to_gigapixels_is_refused(gateway):
    data = bytearray(photo())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = b"\xff\xff\xff\xff"
    response = gateway.post("/geopose", json=geopose_request(bytes(data)))
    assert (response.status_code, response.json()["code"]) == (413, "TOO_LARGE")
    response = gateway.post("/localise", files={"image": ("p.jpg", bytes(data))})
    assert (response.status_code, response.json()["code"]) == (413, "TOO_LARGE")


def test_forms_of_many_parts(gateway):
    part = b'--b\r\nContent-Disposition: form-data; name="%d"\r\n\r\n1\r\n'
    for body in (
        b"".join(part % i for i in range(3000)) + b"--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="' + b"n" * 200_000 + b'"\r\n\r\n1\r\n--b--\r\n',
        b"--b\r\n" + b"X: y\r\n" * 20_000 + b"\r\n1\r\n--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="request_id"\r\n\r\n\xff\xfe\r\n--b--\r\n',
    ):
        response = gateway.post(
            "/localise", data=body, headers={"Content-Type": "multipart/form-data; boundary=b"}
        )
        assert (response.status_code, response.json()["code"]) == (400, "BAD_REQUEST"), body[:60]
        assert len(response.content) < 2_000


def test_requests_with_something_else_somewhere_are_never_a_defect(gateway):
    """Each node of a good request in turn is another thing; the answer is 200 or says what is wrong."""
    rng = random.Random(5)
    good = json.dumps(
        geopose_request(photo(), params={"model": "PINHOLE", "modelParams": [150.0, 150.0, 80.0, 60.0]})
    )
    others = [None, True, -1, 1e308, 10**30, "", "x" * 2000, [], {}, [[1]], {"a": {}}, "\x00", -0.0]
    statuses = set()
    for path in _paths(json.loads(good)):
        for other in rng.sample(others, 3):
            request = json.loads(good)
            at = request
            for step in path[:-1]:
                at = at[step]
            at[path[-1]] = other
            response = gateway.post("/geopose", json=request)
            statuses.add(response.status_code)
            assert response.status_code in (200, 400, 413, 415), (path, other, response.text)
            if response.status_code != 200:
                assert response.json()["message"]
    assert {200, 400, 415} <= statuses


def _paths(node: object, path: tuple = ()) -> list[tuple]:
    found = [path] if path else []
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for step, below in items:
        found += _paths(below, (*path, step))
    return found


def test_base64_of_spaces_and_lines_is_refused_and_not_repaired(gateway):
    text = base64.encodebytes(photo()).decode()
    response = gateway.post("/geopose", json=geopose_request(text))
    assert (response.status_code, response.json()["code"]) == (400, "BAD_REQUEST")
