"""Live sessions: hostile frames and openings, defects, and processes that crash, hang or take too much."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import pytest
import zenoh

from featuredb.errors import ServiceError
from featuredb.features.decode import DecodeLimits
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.wire.query import CameraRequest, PriorRequest
from schemas import load_schema
from tests.support.live import LENS, SOON_S, jpeg, localiser, wait_until
from tests.support.live_sessions import LIVE, end_of, exchange, live_status, serving, until_tracking
from tests.support.service import MemorySource, ScriptedLocaliser, area_of, client_of, photo, running_server
from tools.attacks import png, zeros


class Raw:
    """A client that says what it likes under the keys of one session."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self._session, self._key = session, f"featuredb/town/track/anonymous/{name}"
        self.events: list[dict[str, object]] = []
        self.poses: list[dict[str, object]] = []

    def __enter__(self) -> "Raw":
        self._declared = [
            self._session.declare_subscriber(
                f"{self._key}/{leaf}", lambda s, into=into: into.append(json.loads(s.payload.to_bytes()))
            )
            for leaf, into in (("poses", self.poses), ("events", self.events))
        ]
        return self

    def __exit__(self, *_: object) -> None:
        for declared in self._declared:
            declared.undeclare()

    def open(self, attachment: bytes | None = None) -> dict[str, object]:
        (reply,) = self._session.get(self._key, attachment=attachment, timeout=SOON_S)
        found = reply.ok or reply.err
        assert found is not None
        answer: dict[str, object] = json.loads(found.payload.to_bytes())
        return answer

    def send(self, payload: bytes, attachment: bytes | None) -> dict[str, object]:
        """One frame; the pose or the event that it gets."""
        before = len(self.poses) + len(self.events)
        at = (len(self.poses), len(self.events))
        self._session.put(f"{self._key}/frames", payload, attachment=attachment)
        wait_until(lambda: len(self.poses) + len(self.events) > before, "an answer")
        return (self.poses[at[0] :] + self.events[at[1] :])[0]


def header(sequence: object, time_s: object) -> bytes:
    return json.dumps({"sequence": sequence, "time_s": time_s}).encode()


def test_hostile_frames_get_a_reason_each_and_the_session_goes_on() -> None:
    limits = DecodeLimits(max_bytes=200_000, max_pixels=1_000_000, max_side_px=4000)
    good = jpeg(0)
    bomb = bytearray(good)
    size = bomb.index(b"\xff\xc0") + 5
    bomb[size : size + 4] = (60_000).to_bytes(2, "big") * 2
    hostile = [
        (good, None, "BAD_REQUEST", "sequence"),
        (good, b"{", "BAD_REQUEST", ""),
        (good, b"[" * 60_000, "BAD_REQUEST", ""),
        (good, b'"' + b"a" * 200_000 + b'"', "BAD_REQUEST", "at most 65536 bytes"),
        (good, header("3", 1.0), "BAD_REQUEST", "sequence"),
        (good, header(-3, 1.0), "BAD_REQUEST", "sequence"),
        (good, header(10**30, 1.0), "BAD_REQUEST", "sequence"),
        (good, header(7, 1e300), "BAD_REQUEST", "time_s"),
        (good, b'{"sequence": 7, "time_s": NaN}', "BAD_REQUEST", "time_s"),
        (good, b'{"sequence": 7, "time_s": 1, "x": 1}', "BAD_REQUEST", "x"),
        (good, header(1, 9.0), "BAD_REQUEST", "expected more than 1"),
        (good, header(0, 9.0), "BAD_REQUEST", "expected more than 1"),
        (good, header(2, 0.0), "BAD_REQUEST", "time_s"),
        (b"", header(3, 1.0), "BAD_IMAGE", "empty"),
        (b"no image", header(4, 1.0), "BAD_IMAGE", "image"),
        (good[: len(good) // 2], header(5, 1.0), "BAD_IMAGE", "image"),
        (bytes(bomb), header(6, 1.0), "TOO_LARGE", "image"),
        (bytes(300_000), header(7, 1.0), "TOO_LARGE", "at most 200000 bytes"),
        (photo(size=(320, 240)), header(8, 1.0), "BAD_IMAGE", "expected 640x480"),
        (photo(size=(3000, 66)), header(9, 1.0), "BAD_IMAGE", "narrow"),
    ]
    with serving(limits=limits) as (server, client), Raw(client._session(), "s1") as raw:
        assert raw.open()["session"] == "s1"
        assert raw.send(good, header(0, 0.0))["state"] == "lost"
        assert raw.send(good, header(1, 0.1))["state"] == "lost"
        for payload, attachment, code, said in hostile:
            event = raw.send(payload, attachment)
            assert (event["type"], event["code"]) == ("refused", code), event
            assert said in str(event["message"]), event
            assert len(str(event["message"])) < 1000
        last = raw.send(good, header(20, 2.0))
        # 0, 1, 20 and the refused ones from 2 on were looked at.
        assert last["dropped"] == 21 - 3 - 8
        counts = live_status(server)
        assert sum(counts.frames.refused.values()) == len(hostile)
        assert counts.open == 1
        for name, messages in (("track_pose", raw.poses), ("track_event", raw.events)):
            checker = jsonschema.Draft202012Validator(load_schema(f"wire/{name}"))
            for message in messages:
                checker.validate(message)
    assert live_status(server).ended == {"SHUTTING_DOWN": 1}


def test_a_camera_of_another_shape_is_told_with_the_first_frame() -> None:
    with serving() as (_, client):
        square = CameraRequest(model="PINHOLE", width=500, height=500, params=(400.0, 400.0, 250.0, 250.0))
        with client.track(square) as live:
            live.send(jpeg(0), 0.0)
            wait_until(lambda: bool(live.refusals), "the refusal")
        assert live.refusals[0].code == "BAD_REQUEST"
        assert "640x480" in live.refusals[0].message


def test_hostile_openings_get_an_error_each_and_open_nothing() -> None:
    with serving() as (server, client):
        session = client._session()
        for name, attachment, said in (
            ("s 1", b"", "session"),
            ("-s", b"", "session"),
            ("a" * 65, b"", "session"),
            ("ok", b"{", ""),
            ("ok", b'{"fps": 30}', "fps"),
            ("ok", b'{"prior": {"lat": 100, "lon": 0, "sigma_m": 1}}', "prior.lat"),
            (
                "ok",
                b'{"camera": {"model": "NOSUCH", "width": 4, "height": 3, "params": [1, 1, 1]}}',
                "camera",
            ),
        ):
            answer = Raw(session, name).open(attachment)
            assert answer["code"] == "BAD_REQUEST", answer
            assert said in str(answer["message"])
        assert Raw(session, "twice").open()["session"] == "twice"
        assert "is open" in str(Raw(session, "twice").open()["message"])
        assert live_status(server).open == 1
        prior = PriorRequest(lat=49.0, lon=8.4, sigma_m=50.0)
        with client.track(LENS, prior) as live:
            exchange(live, range(1))


class BrokenLocaliser(ScriptedLocaliser):
    """Meets a defect in the worker process, with every frame."""

    def __reduce__(self) -> tuple[object, ...]:
        return SimpleNamespace, ()


def test_a_defect_costs_its_frame_and_says_so() -> None:
    source = MemorySource(area_of(BrokenLocaliser(1)))
    options = ServeOptions(live=LIVE, poll_interval_s=0.05)
    with running_server(source, options) as server, client_of(server) as client, client.track(LENS) as live:
        live.send(jpeg(0), 0.0)
        wait_until(lambda: bool(live.refusals), "the refusal")
        assert live.refusals[0].code == "INTERNAL"
        source.publish(area_of(localiser(2)))
        wait_until(lambda: server.status().snapshot == 2, "the reload")
        exchange(live, range(1, 3))


def live_worker(server: Server) -> int:
    (session,) = server._live._open.values()
    process = session._follower._process
    assert process is not None
    pid = process._process.pid
    assert pid is not None
    return pid


@pytest.mark.parametrize("how", [signal.SIGSEGV, signal.SIGSTOP])
def test_a_frame_that_crashes_or_hangs_costs_itself_alone(how: signal.Signals) -> None:
    """The server, the session and another one go on; a new process finds the track again."""
    options = ServeOptions(live=LIVE, deadline_s=4.0)
    with (
        running_server(localiser(), options) as server,
        client_of(server) as client,
        client.track(LENS) as live,
    ):
        before = until_tracking(live)[-1].sequence
        pid = live_worker(server)
        os.kill(pid, how)
        if how == signal.SIGSTOP:  # the frame waits for a process that does nothing
            live.send(jpeg(0), (before + 1) / 30.0)
            wait_until(lambda: bool(live.refusals), "the refusal")
            assert [r.code for r in live.refusals] == ["DEADLINE"]
            assert live.refusals[0].sequence == before + 1
        else:
            wait_until(lambda: not Path(f"/proc/{pid}").exists(), "its end")
        found = until_tracking(live, first=before + 2)
        assert found[0].state == "lost"
        assert found[-1].dropped == 0 if how == signal.SIGSTOP else 1
        assert live_worker(server) != pid
        assert live_status(server).open == 1


def test_a_client_that_goes_takes_the_process_of_its_session_with_it() -> None:
    options = ServeOptions(live=LIVE, deadline_s=2.5 * SOON_S)
    with running_server(localiser(), options) as server, client_of(server) as client:
        with client.track(LENS) as live:
            exchange(live, range(1))
            pid = live_worker(server)
            os.kill(pid, signal.SIGSTOP)  # as a frame that takes as long as it may
            live.send(jpeg(1), 0.1)
            wait_until(lambda: live_status(server).frames.received == 2, "the frame")
        wait_until(lambda: live_status(server).open == 0, "the session's end")
        assert not Path(f"/proc/{pid}").exists()
        wait_until(lambda: live_status(server).ended == {"CLIENT_GONE": 1}, "its end's count")
        assert not live_status(server).frames.refused


def test_a_frame_beyond_its_memory_is_refused() -> None:
    options = ServeOptions(live=replace(LIVE, limits=DecodeLimits()), query_memory_bytes=100 << 20)
    with (
        running_server(localiser(), options) as server,
        client_of(server) as client,
        client.track() as live,
    ):
        live.send(png(10_900, 10_900, zeros(10_901 * 10_900)), 0.0)
        wait_until(lambda: bool(live.refusals), "the refusal")
        assert live.refusals[0].code == "TOO_LARGE"


def test_frames_that_no_camera_streams_are_decoded_behind_queries() -> None:
    bomb = png(4000, 4000, zeros((4000 * 8 + 1) * 4000), bits=16, colour=6)
    with running_server(localiser(), ServeOptions(live=LIVE)) as server, client_of(server) as client:
        with client.track(LENS) as live:
            exchange(live, range(2))
            assert os.getpriority(os.PRIO_PROCESS, live_worker(server)) == os.nice(0)
        with client.track() as live:
            live.send(bomb, 0.0)
            wait_until(lambda: sum(live_status(server).frames.answered.values()) == 3, "its answer")
            threads = [int(task.name) for task in Path(f"/proc/{live_worker(server)}/task").iterdir()]
            assert min(os.getpriority(os.PRIO_PROCESS, thread) for thread in threads) > os.nice(0)


def test_who_has_several_sessions_gives_one_up_to_who_has_none() -> None:
    with (
        serving(max_sessions=2) as (server, greedy),
        client_of(server) as other,
        greedy.track(LENS) as first,
        greedy.track(LENS) as second,
        other.track(LENS) as third,
    ):
        exchange(third, range(2))
        assert end_of(second).code == "MADE_ROOM"
        exchange(first, range(2))
        with pytest.raises(ServiceError) as caught, greedy.track():
            pass
        assert caught.value.code == "BUSY"
