"""Live sessions over loopback: real server, real tracker, real Zenoh. Every wait is for an event."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
import zenoh

from featuredb.errors import ServiceError
from featuredb.features.decode import DecodeLimits
from reloc.client import Client, LiveTrack, TrackPose
from reloc.service.live.options import LiveOptions
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.tracking.options import TrackOptions
from reloc.wire.query import CameraRequest, PriorRequest
from reloc.wire.track import LiveStatus
from schemas import load_schema
from tests.support.live import LENS, SOON_S, error_m, jpeg, localiser, wait_until
from tests.support.service import MemorySource, ScriptedLocaliser, area_of, client_of, photo, running_server
from tools.bombs import png, zeros

_LIVE = LiveOptions(track=TrackOptions(live=True, keyframe_every=8), idle_timeout_s=60.0)


@contextmanager
def serving(**changes: object) -> Iterator[tuple[Server, Client]]:
    live = replace(_LIVE, **changes)  # type: ignore[arg-type]
    with running_server(localiser(), ServeOptions(live=live)) as server, client_of(server) as client:
        yield server, client


def live_status(server: Server) -> LiveStatus:
    status = server.status().live
    assert status is not None
    return status


def session_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith(("live-", "keyframes"))]


def end_of(live: LiveTrack, image: bytes | None = None) -> ServiceError:
    """Why the session ends; until then the image is sent again and again."""
    end = time.monotonic() + SOON_S
    for number in range(10**6):
        try:
            if image is not None:
                live.send(image, number / 30.0)
            live.next(0.01)
        except ServiceError as error:
            return error
        assert time.monotonic() < end, "the session does not end"
    raise AssertionError


def exchange(live: LiveTrack, numbers: range, texture: int = 1) -> list[TrackPose]:
    """Send frames one by one, each when the one before has its pose: none is dropped."""
    found = []
    for number in numbers:
        live.send(jpeg(number, texture), number / 30.0)
        pose = live.next(SOON_S)
        assert pose is not None, number
        found.append(pose)
    return found


def until_tracking(live: LiveTrack, first: int = 0) -> list[TrackPose]:
    """Send frames until some are tracked; a still camera, so that their rate does not matter."""
    found: list[TrackPose] = []
    for number in range(first, first + 3000):
        live.send(jpeg(0), number / 30.0, number)
        pose = live.next(SOON_S)
        assert pose is not None
        found.append(pose)
        if len(found) > 1 and found[-2].state == "relocalised":
            return found
        if pose.state == "lost":
            time.sleep(0.01)
    raise AssertionError("never found")


def test_poses_come_in_the_order_of_the_frames_and_are_right() -> None:
    with serving() as (server, client), client.track(LENS) as live:
        begun = until_tracking(live)
        first = begun[-1].sequence + 1
        assert begun[0].state == "lost"
        assert begun[0].detail
        # The flight begins where the still camera was, and takes as long as it does.
        flown = []
        for k in range(40):
            live.send(jpeg(k), (first + k) / 30.0)
            pose = live.next(SOON_S)
            assert pose is not None
            flown.append(pose)
        assert [p.sequence for p in (*begun, *flown)] == list(range(first + 40))
        assert {p.state for p in flown} == {"tracking"}
        assert {p.dropped for p in (*begun, *flown)} == {0}
        for k, pose in enumerate(flown):
            assert pose.utm is not None
            assert pose.camera is not None
            assert error_m((pose.utm.easting, pose.utm.northing, pose.utm.height), k) < 0.3
            assert pose.time_s == (first + k) / 30.0
            assert pose.inliers >= 20
            assert pose.snapshot == 1
            assert list(pose.camera.params) == pytest.approx(LENS.params)
            stages = dict(pose.timings_ms)
            assert set(stages) == {"queue", "worker", "decode", "track", "reply", "total"}
            assert stages.pop("total") == pytest.approx(sum(stages.values()), abs=0.01)
            assert live.latency_ms(pose.sequence) is not None
        counts = live_status(server)
        assert (counts.open, counts.opened, counts.frames.dropped) == (1, 1, 0)
        assert counts.frames.received == first + 40
        assert counts.latency_ms.count == min(first + 40, 1000)
        assert not live.refusals


def test_a_flood_of_frames_is_dropped_and_not_queued() -> None:
    """Frames that come faster than they are looked at: the newest ones are answered, the others counted."""
    sent = 2000
    with serving() as (server, client), client.track(LENS) as live:
        for number in range(sent):
            live.send(jpeg(number), number / 30.0)
        poses = []
        while (pose := live.next(0.5)) is not None:
            poses.append(pose)
        # The network may have dropped the last of them; one that comes alone is answered, and nothing else.
        live.send(jpeg(sent), sent / 30.0)
        while not poses or poses[-1].sequence < sent:
            pose = live.next(SOON_S)
            assert pose is not None, "the newest frame must have an answer"
            poses.append(pose)
        numbers = [p.sequence for p in poses]
        assert numbers == sorted(set(numbers))
        assert len(poses) < sent
        counts = live_status(server).frames
        # The network may have no room for a pose either: what the server looked at is counted there.
        looked_at = [p.sequence + 1 - p.dropped for p in poses]
        assert looked_at == sorted(set(looked_at))
        assert looked_at[-1] == sum(counts.answered.values()) >= len(poses)
        # Whatever was neither answered nor dropped by the server was dropped by the network.
        assert counts.received == looked_at[-1] + counts.dropped
        assert counts.received <= sent + 1


def test_a_closed_session_leaves_nothing_behind() -> None:
    with serving(max_sessions=1) as (server, client):
        for _ in range(3):
            with client.track(LENS) as live:
                exchange(live, range(2))
            wait_until(lambda: live_status(server).open == 0, "the session's end")
        wait_until(lambda: live_status(server).ended == {"CLIENT_GONE": 3}, "the count of ends")
        with pytest.raises(ServiceError) as caught:
            live.send(jpeg(0), 1.0)
        assert caught.value.code == "CLOSED"
        assert list(live) == []
        wait_until(lambda: not session_threads(), "the end of their threads")


_CLIENT = """
import sys, time
from reloc.client import Client
from tests.support.live import LENS, jpeg
frames = [jpeg(k) for k in range(5)]
with Client(sys.argv[1]) as client, client.track(LENS) as live:
    for number in range(10**6):
        live.send(frames[number % 5], number / 30.0)
        if live.next(10.0) is not None and number == 10:
            print("streaming", flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="kills a process as Unix does")
def test_a_client_that_is_killed_leaves_no_session_behind() -> None:
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    with (
        serving() as (server, _),
        subprocess.Popen(
            [sys.executable, "-c", _CLIENT, server.endpoints[0]],
            stdout=subprocess.PIPE,
            cwd=root,
            env=environment,
        ) as process,
    ):
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"streaming\n"
            assert live_status(server).open == 1
        finally:
            process.kill()
        # A minute of idling is allowed here: it is the token that ends the session.
        wait_until(lambda: live_status(server).open == 0, "the killed client's session")
        wait_until(lambda: live_status(server).ended == {"CLIENT_GONE": 1}, "its end's count")


def test_a_session_without_usable_frames_ends() -> None:
    with serving(idle_timeout_s=0.3) as (server, client):
        with client.track(LENS) as live:
            why = end_of(live)
        assert why.code == "IDLE"
        assert "0.3 s" in why.message
        assert live_status(server).open == 0
        # Frames that cannot be used do not keep it, either.
        with client.track(LENS) as live:
            assert end_of(live, b"no image").code == "IDLE"
        assert live.refusals


def test_one_session_more_than_there_may_be_is_told_so() -> None:
    with serving(max_sessions=2) as (server, client), client.track() as first, client.track():
        with pytest.raises(ServiceError) as caught, client.track():
            pass
        assert caught.value.code == "BUSY"
        assert "2 live sessions" in caught.value.message
        first.close()
        wait_until(lambda: live_status(server).open == 1, "room for another")
        with client.track() as third:
            exchange(third, range(1))
        assert live_status(server).refused == {"BUSY": 1}
    with serving(max_sessions=0) as (_, client):
        with pytest.raises(ServiceError) as caught, client.track():
            pass
        assert caught.value.code == "UNSUPPORTED"
        assert "--live-sessions" in caught.value.message


def test_a_server_that_stops_ends_its_sessions() -> None:
    with running_server(localiser(), ServeOptions(live=_LIVE)) as server, client_of(server) as client:
        with client.track(LENS) as live:
            exchange(live, range(3))
            server.close()
            assert end_of(live).code == "SHUTTING_DOWN"
            with pytest.raises(ServiceError):
                live.send(jpeg(3), 1.0)
        assert live_status(server).ended == {"SHUTTING_DOWN": 1}


def test_a_server_that_is_gone_without_a_word_is_noticed() -> None:
    with serving() as (server, client), client.track(LENS) as live:
        exchange(live, range(2))
        server._session.close()
        assert end_of(live).code == "NO_SERVER"


def test_maps_that_are_reloaded_are_tracked_by() -> None:
    source = MemorySource(area_of(localiser(1)))
    options = ServeOptions(live=_LIVE, poll_interval_s=0.05)
    with running_server(source, options) as server, client_of(server) as client, client.track(LENS) as live:
        until_tracking(live)
        nothing = localiser(2)
        nothing.areas = ()
        source.publish(area_of(nothing))
        pose = _by_snapshot(live, 2, first=5000)
        assert pose.state == "lost"
        assert "the maps have changed" in pose.detail
        source.publish(area_of(localiser(3)))
        _by_snapshot(live, 3, first=5500)
        assert until_tracking(live, first=6000)[-1].snapshot == 3


def _by_snapshot(live: LiveTrack, snapshot: int, first: int) -> TrackPose:
    """The first pose by the maps of a snapshot, once they are loaded."""
    end = time.monotonic() + SOON_S
    for number in range(first, 10**6):
        assert time.monotonic() < end, f"no pose by snapshot {snapshot}"
        live.send(jpeg(0), number / 30.0, number)
        pose = live.next(SOON_S)
        assert pose is not None
        if pose.snapshot == snapshot:
            return pose
    raise AssertionError


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
        (b"", header(3, 1.0), "BAD_IMAGE", "found none"),
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
    options = ServeOptions(live=_LIVE, poll_interval_s=0.05)
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
    options = ServeOptions(live=_LIVE, deadline_s=4.0)
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
    options = ServeOptions(live=_LIVE, deadline_s=2.5 * SOON_S)
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
    options = ServeOptions(live=replace(_LIVE, limits=DecodeLimits()), query_memory_bytes=100 << 20)
    with (
        running_server(localiser(), options) as server,
        client_of(server) as client,
        client.track() as live,
    ):
        live.send(png(10_900, 10_900, zeros(10_901 * 10_900)), 0.0)
        wait_until(lambda: bool(live.refusals), "the refusal")
        assert live.refusals[0].code == "TOO_LARGE"


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


def test_frames_larger_than_are_tracked_are_made_smaller() -> None:
    with serving(max_side_px=320) as (_, client), client.track(LENS) as live:
        found = until_tracking(live)
        pose = found[-1]
        assert pose.utm is not None
        assert pose.camera is not None
        # The answer's camera is that of the frames as they were sent.
        assert (pose.camera.width, pose.camera.height) == (640, 480)
        assert np.allclose(pose.camera.params, LENS.params)
        assert error_m((pose.utm.easting, pose.utm.northing, pose.utm.height), 0) < 0.5
