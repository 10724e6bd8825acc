"""A server under pressure: full queue, deadlines, hot reload, shutdown. Every wait is for an event."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from featuredb.errors import ServiceError, StoreError
from featuredb.features.decode import DecodeLimits
from reloc.client import NO_SERVER, Client
from reloc.service.logs import JsonLinesFormatter
from reloc.service.options import ServeOptions
from reloc.service.session import ServiceStartError
from reloc.service.workers import pool as pool_module
from reloc.service.workers import process
from reloc.wire.query import ErrorCode, LocaliseReply
from tests.support.events import watch_events
from tests.support.service import (
    Gate,
    MemorySource,
    ScriptedLocaliser,
    area_of,
    client_of,
    map_info,
    not_localised,
    photo,
    running_server,
)


def gated(snapshot: int, gate: Gate) -> ScriptedLocaliser:
    def answer(gray, request):
        gate.wait()
        return not_localised(snapshot)

    return ScriptedLocaliser(snapshot, answer)


def outcome(client: Client, **kwargs) -> str:
    try:
        return client.localise(photo(), **kwargs).status
    except ServiceError as error:
        return error.code


def asked_once(client: Client) -> str:
    """As `outcome`, of a client that does not ask again where the server is busy."""
    try:
        return client._ask(client._keys.localise(client.name), LocaliseReply, 10.0, payload=photo()).status
    except ServiceError as error:
        return error.code


def test_a_busy_server_is_asked_again_while_there_is_time():
    gate = Gate()
    with (
        running_server(gated(1, gate), ServeOptions(workers=1, max_queue=1)) as server,
        client_of(server) as client,
        ThreadPoolExecutor(3) as pool,
    ):
        first = pool.submit(outcome, client)
        assert gate.entered.acquire(timeout=10)
        second = pool.submit(outcome, client)
        while client.status().queue.length < 1:
            pass
        third = pool.submit(outcome, client)
        while client.status().queries.errors.get("BUSY", 0) < 2:
            assert not third.done()
        assert outcome(client, timeout_s=0.3) == "BUSY"
        gate.open()
        assert [f.result(timeout=10) for f in (first, second, third)] == ["not_localised"] * 3


def test_a_server_whose_workers_cannot_be_started_does_not_start(monkeypatch):
    def start(self):
        raise EOFError

    monkeypatch.setattr(process._CONTEXT.Process, "start", start)
    with (
        pytest.raises(ServiceStartError, match="no worker process comes up"),
        running_server(ScriptedLocaliser(1)),
    ):
        pass


def test_a_full_queue_says_busy_at_once_and_answers_the_others():
    gate = Gate()
    options = ServeOptions(workers=1, max_queue=2)
    with (
        running_server(gated(1, gate), options) as server,
        client_of(server) as client,
        ThreadPoolExecutor(8) as pool,
    ):
        first = pool.submit(asked_once, client)
        assert gate.entered.acquire(timeout=10)  # the worker has it; the queue is empty
        later = [pool.submit(asked_once, client) for _ in range(5)]
        busy = _first_done(later, 3)
        assert [f.result() for f in busy] == ["BUSY"] * 3
        assert client.status().queue.length == 2
        gate.open()
        answered = [f.result(timeout=10) for f in (first, *later) if f not in busy]
        assert answered == ["not_localised"] * 3
        counts = client.status().queries
    assert counts.received == 6
    assert counts.errors == {"BUSY": 3}


def _first_done(futures, count):
    done = []
    end = time.monotonic() + 10
    event = threading.Event()
    lock = threading.Lock()

    def note(future):
        with lock:
            done.append(future)
            if len(done) == count:
                event.set()

    for future in futures:
        future.add_done_callback(note)
    assert event.wait(max(0.0, end - time.monotonic())), "the server did not refuse in time"
    return done[:count]


def test_the_queue_is_bounded_in_bytes_too():
    gate = Gate()
    size = len(photo())
    options = ServeOptions(workers=1, max_queue=100, max_queued_bytes=int(1.5 * size))
    with (
        running_server(gated(1, gate), options) as server,
        client_of(server) as client,
        ThreadPoolExecutor(8) as pool,
    ):
        first = pool.submit(asked_once, client)
        assert gate.entered.acquire(timeout=10)
        later = [pool.submit(asked_once, client) for _ in range(3)]
        assert [f.result() for f in _first_done(later, 2)] == ["BUSY", "BUSY"]
        gate.open()
        assert first.result(timeout=10) == "not_localised"


def test_a_query_that_waits_past_the_deadline_gets_deadline_in_time_while_no_worker_is_free(monkeypatch):
    gate, may_start = Gate(), threading.Event()
    may_start.set()

    def started(*args):
        may_start.wait(10)
        return process.WorkerProcess(*args)

    monkeypatch.setattr(pool_module, "WorkerProcess", started)
    options = ServeOptions(workers=1, deadline_s=0.3)
    with (
        running_server(gated(1, gate), options) as server,
        client_of(server) as client,
        ThreadPoolExecutor(2) as pool,
    ):
        start = time.monotonic()
        in_hand = pool.submit(outcome, client)
        assert gate.entered.acquire(timeout=10)
        may_start.clear()  # the process that replaces the late one takes nothing before both are answered
        waiting = pool.submit(outcome, client)
        assert in_hand.result(timeout=10) == "DEADLINE"
        assert waiting.result(timeout=10) == "DEADLINE"
        assert 0.3 <= time.monotonic() - start < 5.0
        may_start.set()
        gate.open()
        # The late pose of the first is never sent; the second is not even computed.
        assert client.status().queries.errors == {"DEADLINE": 2}
    assert not gate.entered.acquire(blocking=False)


def test_a_client_may_ask_for_less_time_than_the_server_allows():
    gate = Gate()
    with (
        running_server(gated(1, gate), ServeOptions(deadline_s=60.0)) as server,
        client_of(server) as client,
    ):
        with pytest.raises(ServiceError, match=r"within (2[5-9]\d|300) ms") as caught:
            client.localise(photo(), timeout_s=0.5)
        assert caught.value.code == ErrorCode.DEADLINE
        gate.open()


def test_hot_reload_under_load_drops_no_query_and_announces_itself():
    """Queries run without pause while the snapshot changes; each is answered by one of the two."""
    gate = Gate()
    source = MemorySource(area_of(gated(1, gate), map_info("map-a"), map_info("map-gone")))
    options = ServeOptions(workers=3, poll_interval_s=0.05)
    stop = threading.Event()
    answers: list[int] = []

    def keep_asking(address: str) -> int:
        asked = 0
        with Client(address, "town") as own:
            while not stop.is_set():
                answers.append(own.localise(photo()).snapshot)
                asked += 1
        return asked

    with (
        running_server(source, options) as server,
        client_of(server) as client,
        watch_events(client) as events,
        ThreadPoolExecutor(8) as pool,
    ):
        in_flight = pool.submit(client.localise, photo())
        assert gate.entered.acquire(timeout=10)
        source.publish(area_of(ScriptedLocaliser(2), map_info("map-a", digest="d1"), map_info("map-new")))
        seen = []
        while not seen or seen[-1].type != "reloaded":
            event = events.next(timeout_s=10)
            assert event is not None, "the reload was not announced"
            seen.append(event)
        assert {(e.type, e.map_id) for e in seen} == {
            ("map_committed", "map-a"),  # placed anew
            ("map_committed", "map-new"),
            ("map_retired", "map-gone"),
            ("reloaded", None),
        }
        assert all(e.snapshot == 2 for e in seen)
        assert client.localise(photo()).snapshot == 2
        gate.open()
        assert in_flight.result(timeout=10).snapshot == 1, "the query in hand finishes on its own snapshot"

        askers = [pool.submit(keep_asking, server.endpoints[0]) for _ in range(3)]
        for snapshot in range(3, 8):
            source.publish(area_of(ScriptedLocaliser(snapshot), map_info("map-a", digest=f"d{snapshot}")))
            while (event := events.next(timeout_s=10)) is not None and event.type != "reloaded":
                pass
            assert event is not None
            assert event.snapshot == snapshot
        stop.set()
        asked = [f.result(timeout=20) for f in askers]  # raises if any query was dropped or refused
        status = client.status()
    assert sum(asked) == len(answers)
    assert min(asked) > 0
    assert set(answers) <= {2, 3, 4, 5, 6, 7}
    assert status.reload.count == 6
    assert status.queries.errors == {}
    assert status.queries.received == len(answers) + 2


def test_a_reload_that_fails_leaves_the_old_snapshot_in_service_and_says_so():
    source = MemorySource(area_of(ScriptedLocaliser(1)))
    with (
        running_server(source, ServeOptions(poll_interval_s=0.05)) as server,
        client_of(server) as client,
        watch_events(client) as events,
    ):
        source.failure = StoreError("table points: file missing")
        source.newest = 2
        event = events.next(timeout_s=10)
        assert event is not None
        assert (event.type, event.snapshot) == ("reload_failed", 1)
        assert client.localise(photo()).snapshot == 1
        assert "file missing" in (client.status().reload.error or "")
        source.failure = None
        source.publish(area_of(ScriptedLocaliser(2)))
        while (event := events.next(timeout_s=10)) is not None and event.type != "reloaded":
            pass
        assert event is not None, "the server did not try again"
        assert client.localise(photo()).snapshot == 2
        assert client.status().reload.error is None


def test_tiles_of_a_reloaded_area_are_advertised():
    source = MemorySource(area_of(ScriptedLocaliser(1)))
    with (
        running_server(source, ServeOptions(poll_interval_s=0.05)) as server,
        client_of(server) as client,
        watch_events(client) as events,
    ):
        moved = map_info("map-b").model_copy(update={"tiles": ("32632-E000900_N010604",)})
        source.publish(area_of(ScriptedLocaliser(2), moved))
        while (event := events.next(timeout_s=10)) is not None and event.type != "reloaded":
            pass
        session = client._session()
        tiles = {
            str(r.ok.key_expr).split("/")[3]
            for r in session.liveliness().get("featuredb/town/tiles/**", timeout=10)
            if r.ok
        }
    assert tiles == {"32632-E000900_N010604"}


def test_shutdown_answers_what_is_in_hand_and_tells_the_rest():
    gate = Gate()
    options = ServeOptions(workers=1, shutdown_grace_s=20.0)
    with (
        running_server(gated(1, gate), options) as server,
        client_of(server) as client,
        watch_events(client) as events,
        ThreadPoolExecutor(3) as pool,
    ):
        in_hand = pool.submit(outcome, client)
        assert gate.entered.acquire(timeout=10)
        waiting = pool.submit(outcome, client)
        while client.status().queue.length < 1:
            pass
        closing = pool.submit(server.close)
        event = events.next(timeout_s=10)
        assert event is not None
        assert event.type == "stopping"
        gate.open()
        assert in_hand.result(timeout=10) == "not_localised"
        assert waiting.result(timeout=10) == "not_localised"
        closing.result(timeout=10)
        assert outcome(client, timeout_s=1.0) == NO_SERVER


def test_shutdown_does_not_wait_forever_for_a_worker_that_hangs():
    gate = Gate()
    options = ServeOptions(workers=1, shutdown_grace_s=0.2, deadline_s=60)
    with (
        running_server(gated(1, gate), options) as server,
        client_of(server) as client,
        ThreadPoolExecutor(2) as pool,
    ):
        in_hand = pool.submit(outcome, client)
        assert gate.entered.acquire(timeout=10)
        waiting = pool.submit(outcome, client)
        while client.status().queue.length < 1:
            pass
        server.close()
        assert in_hand.result(timeout=10) == "SHUTTING_DOWN"
        assert waiting.result(timeout=10) == "SHUTTING_DOWN"
        gate.open()


def test_a_client_that_goes_away_costs_its_query_only():
    gate = Gate()
    with running_server(gated(1, gate), ServeOptions(workers=1)) as server, client_of(server) as client:
        with Client(server.endpoints[0], "town") as gone:
            gone._session().get("featuredb/town/localise/anonymous", payload=photo(), timeout=10)
            assert gate.entered.acquire(timeout=10)
        gate.open()
        assert client.localise(photo()).status == "not_localised"
        assert client.status().queries.not_localised == {"TOO_FEW_INLIERS": 2}


@pytest.mark.parametrize("megabytes", [1, 3])
def test_too_many_bytes_are_refused_before_anything_reads_them(megabytes):
    localiser = ScriptedLocaliser(1)
    options = ServeOptions(limits=DecodeLimits(max_bytes=1_000_000))
    with running_server(localiser, options) as server, client_of(server) as client:
        with pytest.raises(ServiceError, match="1000000") as caught:
            client.localise(bytes(megabytes * 2**20))
        assert caught.value.code == "TOO_LARGE"
        # Beyond what Zenoh itself gathers the link is closed; the server lives on for others.
        with Client(server.endpoints[0], "town") as rude, pytest.raises(ServiceError):
            rude.localise(bytes(6_000_000), timeout_s=2.0)
        assert client.localise(photo()).status == "localised"
    assert len(localiser.requests) == 1


def test_logs_are_json_lines_with_the_request_id(caplog):
    with (
        caplog.at_level("INFO", logger="reloc"),
        running_server(ScriptedLocaliser(1)) as server,
        client_of(server) as client,
    ):
        client.localise(photo(), request_id="traced-1")
        with pytest.raises(ServiceError):
            client.localise(b"junk", request_id="traced-2")
    lines = [json.loads(JsonLinesFormatter().format(record)) for record in caplog.records]
    by_id = {line["request_id"]: line for line in lines if "request_id" in line}
    assert by_id["traced-1"]["event"] == "answered"
    assert by_id["traced-1"]["status"] == "localised"
    assert by_id["traced-1"]["latency_ms"] > 0
    assert (by_id["traced-2"]["event"], by_id["traced-2"]["code"]) == ("refused", "BAD_IMAGE")
    assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)


def test_a_client_that_comes_before_its_server_waits_for_it():
    with running_server(ScriptedLocaliser(1), name="first") as early, ThreadPoolExecutor(1) as pool:
        late = Client(early.endpoints[0], "late")
        opening = pool.submit(late.open)
        with (
            client_of(early) as session_of,
            session_of._session().liveliness().declare_token("featuredb/late/servers/x"),
        ):
            opening.result(timeout=10)
            assert late.database == "late"
            late.close()
