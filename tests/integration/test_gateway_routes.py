"""The other routes, the way back to a server that restarts, and the command."""

import re
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest
import requests

from featuredb.cli.main import build_parser, main
from featuredb.errors import InvalidValueError
from reloc.client import CameraRequest, PriorRequest
from reloc.gateway.options import GatewayOptions
from reloc.gateway.serve import listen, serve
from reloc.listening import ListenError
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.wire.query import LocaliseReply
from reloc.wire.server import MapsReply
from tests.support.gateway import geopose_request, running_gateway
from tests.support.service import (
    MemorySource,
    ScriptedLocaliser,
    area_of,
    client_of,
    map_info,
    not_localised,
    photo,
    running_server,
)

CAMERA = CameraRequest(model="PINHOLE", width=320, height=240, params=(300.0, 300.0, 160.0, 120.0))
PRIOR = PriorRequest(lat=49.01, lon=8.4, sigma_m=25.0, h=130.0, sigma_vertical_m=9.0)


def same(reply: LocaliseReply, other: LocaliseReply) -> bool:
    """Equal apart from the times that they took."""
    return reply.model_copy(update={"timings_ms": {}}) == other.model_copy(update={"timings_ms": {}})


def test_the_form_s_answer_is_the_wire_s_reply_as_it_is():
    localiser = ScriptedLocaliser(7)
    with (
        running_server(localiser) as server,
        client_of(server) as client,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        wanted = client.localise(photo(), PRIOR, CAMERA, request_id="q-1", inliers=True, maps=("map-a",))
        response = gateway.post(
            "/localise",
            files={"image": ("p.jpg", photo(), "image/jpeg")},
            data={
                "camera": CAMERA.model_dump_json(),
                "prior": PRIOR.model_dump_json(),
                "options": '{"inliers": true, "maps": ["map-a"], "deadline_ms": 5000}',
                "request_id": "q-1",
            },
        )
        assert response.status_code == 200
        reply = LocaliseReply.model_validate_json(response.content)
        assert set(response.json()) == set(wanted.model_dump())
        assert same(reply, wanted)
        assert reply.timings_ms["total"] > 0
        assert repr(localiser.requests[0]) == repr(localiser.requests[1])
        plain = gateway.post("/localise", files={"image": ("p.jpg", photo())}).json()
        assert plain["inlier_points"] is None
        assert localiser.requests[2].camera is None
        assert localiser.requests[2].prior is None


def test_not_localised_is_an_answer_of_the_form():
    with (
        running_server(ScriptedLocaliser(1, lambda *_: not_localised(1))) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        response = gateway.post("/localise", files={"image": ("p.jpg", photo())})
    assert response.status_code == 200
    assert response.json()["reason"] == "TOO_FEW_INLIERS"


def test_health_maps_and_running():
    with (
        running_server(ScriptedLocaliser(5)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        health = gateway.get("/health")
        assert (health.status_code, health.json()) == (
            200,
            {"status": "ok", "database": "town", "snapshot": 5, "maps": 1},
        )
        maps = gateway.get("/maps")
        assert maps.status_code == 200
        assert MapsReply.model_validate_json(maps.content) == MapsReply(
            database="town", snapshot=5, maps=(map_info(),)
        )
        assert gateway.get("/geopose").json() == {"status": "running"}


def samples(text: str) -> dict[str, float]:
    """Prometheus' text: every line is a comment or a sample; no sample comes twice."""
    found: dict[str, float] = {}
    for line in text.splitlines():
        if line.startswith("#"):
            assert re.fullmatch(r"# (HELP|TYPE) [a-z_]+ .+", line)
            continue
        match = re.fullmatch(r'([a-z_]+(?:\{[a-z]+="[^"]*"(?:,[a-z]+="[^"]*")*\})?) (\S+)', line)
        assert match, line
        assert match[1] not in found
        found[match[1]] = float(match[2])
    return found


def test_metrics_count_requests_by_route_and_status_and_show_the_server():
    with (
        running_server(ScriptedLocaliser(5)) as server,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        for _ in range(3):
            gateway.post("/geopose", json=geopose_request(photo()))
        gateway.post("/geopose", json={})
        gateway.post("/localise", files={"image": ("p.jpg", b"none")})
        for i in range(5):
            gateway.get(f"/nothing/{i}")
        response = gateway.get("/metrics")
    assert response.headers["content-type"].startswith("text/plain; version=0.0.4")
    found = samples(response.text)
    total = "featuredb_gateway_requests_total"
    assert found[f'{total}{{route="/geopose",status="200"}}'] == 3
    assert found[f'{total}{{route="/geopose",status="400"}}'] == 1
    assert found[f'{total}{{route="/localise",status="415"}}'] == 1
    assert found[f'{total}{{route="other",status="404"}}'] == 5
    assert len([name for name in found if name.startswith(total)]) == 4
    name = "featuredb_gateway_request_seconds"
    assert found[f'{name}_count{{route="/geopose"}}'] == 4
    assert found[f'{name}_bucket{{le="+Inf",route="/geopose"}}'] == 4
    rising = [found[key] for key in found if key.startswith(f"{name}_bucket{{") and "/geopose" in key]
    assert rising == sorted(rising)
    assert 0 < found[f'{name}_sum{{route="/geopose"}}'] < 60
    assert found["featuredb_server_up"] == 1
    assert found['featuredb_server_queries_total{code="",outcome="localised"}'] == 3
    assert found['featuredb_server_queries_total{code="BAD_IMAGE",outcome="error"}'] == 1
    assert found["featuredb_server_snapshot"] == 5


def test_web_pages_may_ask_where_their_origin_is_allowed():
    page = {"Origin": "https://ar.example", "Access-Control-Request-Method": "POST"}
    with (
        running_server(ScriptedLocaliser(1)) as server,
        running_gateway(server.endpoints[0], cors_origins=("https://ar.example",)) as allowed,
        running_gateway(server.endpoints[0]) as closed,
    ):
        before = requests.options(allowed.url + "/geopose", headers=page, timeout=30)
        assert before.headers["access-control-allow-origin"] == "https://ar.example"
        answer = allowed.post("/geopose", json=geopose_request(photo()), headers={"Origin": page["Origin"]})
        assert answer.headers["access-control-allow-origin"] == "https://ar.example"
        answer = closed.post("/geopose", json=geopose_request(photo()), headers={"Origin": page["Origin"]})
        assert "access-control-allow-origin" not in answer.headers


def server_at(endpoint: str, snapshot: int, name: str = "town") -> Server:
    """A server at an endpoint that may have been another's a moment ago."""
    source = MemorySource(area_of(ScriptedLocaliser(snapshot)))
    return Server.start(source, ServeOptions(listen=(endpoint,)), name)


def test_a_server_that_restarts_is_found_again():
    with running_server(ScriptedLocaliser(1)) as first:
        endpoint = first.endpoints[0]
        with running_gateway(endpoint, connect_timeout_s=1.0) as gateway:
            assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200
            first.close()
            for _ in range(2):
                response = gateway.post("/geopose", json=geopose_request(photo()))
                assert (response.status_code, response.json()["code"]) == (503, "NO_SERVER")
            assert gateway.get("/health").status_code == 503
            with server_at(endpoint, 2):
                end = time.monotonic() + 20.0
                while gateway.get("/health").status_code != 200:
                    assert time.monotonic() < end, "the gateway does not find the server again"
                    time.sleep(0.05)
                assert gateway.get("/health").json()["snapshot"] == 2
                assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


def test_a_server_that_comes_back_under_another_name_is_found_too():
    """Who names no database asks the one that is there, and not the one that was."""
    with running_server(ScriptedLocaliser(1), name="old") as first:
        endpoint = first.endpoints[0]
        with running_gateway(endpoint, connect_timeout_s=1.0) as gateway:
            assert gateway.get("/health").json()["database"] == "old"
            first.close()
            assert gateway.get("/health").status_code == 503
            with server_at(endpoint, 2, "new"):
                end = time.monotonic() + 20.0
                while gateway.get("/health").status_code != 200:
                    assert time.monotonic() < end, "the gateway does not find the server again"
                    time.sleep(0.05)
                assert gateway.get("/health").json()["database"] == "new"
                assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200


def test_answers_do_not_wait_for_acknowledgements():
    with listen(GatewayOptions(port=0)) as bound:
        assert bound.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_photos_sent_while_the_server_restarts_are_answered_or_refused():
    statuses: list[int] = []
    stop = threading.Event()
    with running_server(ScriptedLocaliser(1)) as first:
        endpoint = first.endpoints[0]
        with running_gateway(endpoint, connect_timeout_s=0.5, timeout_s=5.0) as gateway:

            def ask() -> None:
                while not stop.is_set():
                    statuses.append(gateway.post("/geopose", json=geopose_request(photo())).status_code)

            threads = [threading.Thread(target=ask) for _ in range(4)]
            for thread in threads:
                thread.start()
            end = time.monotonic() + 20.0
            while 200 not in statuses:
                assert time.monotonic() < end
                time.sleep(0.01)
            first.close()
            with server_at(endpoint, 2):
                while gateway.get("/health").status_code != 200:
                    assert time.monotonic() < end + 20.0
                    time.sleep(0.05)
                stop.set()
                for thread in threads:
                    thread.join(30.0)
                    assert not thread.is_alive()
                assert gateway.post("/geopose", json=geopose_request(photo())).status_code == 200
    assert set(statuses) <= {200, 503, 504}


@pytest.mark.parametrize("package", ["fastapi", "uvicorn", "python_multipart"])
def test_without_the_extra_the_command_says_what_to_install(package, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["gateway"]) == 2
    said = capsys.readouterr().err
    assert package in said
    assert "featuredb[http]" in said


def test_options_that_make_no_sense_are_refused():
    for wrong in (
        {"prefix": "vps"},
        {"prefix": "/vps/"},
        {"port": 70_000},
        {"timeout_s": 0.0},
        {"max_in_flight": 0},
    ):
        with pytest.raises(InvalidValueError, match=next(iter(wrong))):
            GatewayOptions(**wrong)


def test_a_port_that_is_taken_is_said():
    with listen(GatewayOptions(port=0)) as bound:
        taken = replace(GatewayOptions(), port=bound.getsockname()[1])
        with pytest.raises(ListenError, match="--port"):
            listen(taken)


_PROGRAM = """
import sys
from importlib.metadata import EntryPoint
from featuredb.cli.main import build_parser, run_command
entry = EntryPoint(name="gateway", value="reloc.cli.gateway:register", group="featuredb.commands")
args = build_parser([entry]).parse_args(sys.argv[1:])
sys.exit(run_command(args.run, args))
"""


def test_the_command_serves_until_it_is_told_to_stop():
    with running_server(ScriptedLocaliser(1)) as server:
        command = ["gateway", "--connect", server.endpoints[0], "--port", "0", "--prefix", "/vps"]
        with subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                said = process.stdout.readline()
                url = re.search(r"listening on (http://127\.0\.0\.1:\d+/vps)", said)[1]
                answer = requests.post(f"{url}/geopose", json=geopose_request(photo()), timeout=30)
                assert answer.status_code == 200
            finally:
                process.send_signal(signal.SIGTERM)
                out, err = process.communicate(timeout=30)
    assert process.returncode == 0, err
    assert '"route": "/vps/geopose", "status": 200' in err
    assert "Traceback" not in out + err


def test_a_stop_signal_right_after_the_address_was_told_counts():
    """The server takes signals from its own start on; one that comes before may not be lost."""
    options = GatewayOptions(connect="tcp/127.0.0.1:1", port=0)
    serve(options, on_ready=lambda url: signal.raise_signal(signal.SIGTERM))


def test_the_command_is_among_those_of_the_program():
    entry = EntryPoint(name="gateway", value="reloc.cli.gateway:register", group="featuredb.commands")
    parser = build_parser([entry])
    args = parser.parse_args(["gateway", "--database", "town", "--cors-origin", "*", "--timeout", "3"])
    assert (args.database, args.cors_origin, args.timeout, args.port) == ("town", ["*"], 3.0, 8080)
