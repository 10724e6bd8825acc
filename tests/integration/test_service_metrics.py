"""The server's own page for Prometheus, and that a gateway shows the same figures."""

import socket
from typing import Any

import pytest
import requests
from prometheus_client.parser import text_string_to_metric_families as families

from reloc.service import serve as serving
from reloc.service.options import ServeOptions
from reloc.service.serve import metrics_page
from reloc.service.session import ServiceStartError, bind_free_port
from tests.support.gateway import running_gateway
from tests.support.live import LENS, localiser, wait_until
from tests.support.service import ScriptedLocaliser, client_of, photo, running_server


def _samples(text: str) -> dict[tuple[str, str], float]:
    return {
        (sample.name, sample.labels.get("code", "")): sample.value
        for family in families(text)
        for sample in family.samples
    }


def test_the_page_says_what_the_status_does() -> None:
    with (
        running_server(ScriptedLocaliser(5)) as server,
        metrics_page(0, server.status) as port,
        client_of(server) as client,
        running_gateway(server.endpoints[0]) as gateway,
    ):
        client.localise(photo())
        wait_until(lambda: server.status().queue.ready == 2, "both workers are ready")
        own = _samples(requests.get(f"http://127.0.0.1:{port}/metrics", timeout=30).text)
        through = _samples(gateway.get("/metrics").text)
    assert own["featuredb_server_queries_total", ""] == 1
    assert own["featuredb_server_workers_ready", ""] == 2
    assert own["featuredb_server_snapshot", ""] == 5
    assert own["process_resident_memory_bytes", ""] > 1e7
    of_server = {key for key in own if key[0].startswith("featuredb_server_")}
    assert of_server == {key for key in through if key[0].startswith("featuredb_server_")}


def test_live_sessions_and_their_frames_are_counted() -> None:
    with (
        running_server(localiser()) as server,
        metrics_page(0, server.status) as port,
        client_of(server) as client,
        client.track(LENS) as live,
    ):
        live.send(b"no image", 0.0)
        while not live.refusals:
            live.next(0.01)
        found = _samples(requests.get(f"http://127.0.0.1:{port}/metrics", timeout=30).text)
    assert found["featuredb_server_live_sessions", ""] == 1
    assert found["featuredb_server_live_frames_total", "BAD_IMAGE"] == 1


def test_a_port_that_is_taken_is_told_before_maps_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(*_: object) -> Any:
        raise AssertionError("the maps were loaded")

    monkeypatch.setattr(serving, "start_server", load)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        database: Any = None
        with pytest.raises(ServiceStartError, match=rf"127\.0\.0\.1:{port}: .*--metrics-port"):
            serving.serve(database, ServeOptions(metrics_port=port))


def test_the_page_is_there_while_maps_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    port = int(bind_free_port("tcp/127.0.0.1:0").rpartition(":")[2])

    def load(*_: object) -> Any:
        found = _samples(requests.get(f"http://127.0.0.1:{port}/metrics", timeout=30).text)
        assert found["featuredb_server_up", ""] == 0
        raise ServiceStartError("as far as it goes")

    monkeypatch.setattr(serving, "start_server", load)
    database: Any = None
    with pytest.raises(ServiceStartError, match="as far"):
        serving.serve(database, ServeOptions(metrics_port=port))
