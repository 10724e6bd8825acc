"""Live sessions over loopback: real server, real tracker, real Zenoh. Every wait is for an event."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import ServiceError
from reloc.client import LiveTrack, TrackPose
from reloc.service.options import ServeOptions
from tests.support.live import LENS, SOON_S, error_m, jpeg, localiser, wait_until
from tests.support.live_sessions import LIVE, end_of, exchange, live_status, serving, until_tracking
from tests.support.service import MemorySource, area_of, client_of, running_server


def session_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith(("live-", "keyframes"))]


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
    with serving(max_sessions=2) as (server, client), client.track():
        with client.track():
            with pytest.raises(ServiceError) as caught, client.track():
                pass
            assert caught.value.code == "BUSY"
            assert "2 live sessions" in caught.value.message
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
    with running_server(localiser(), ServeOptions(live=LIVE)) as server, client_of(server) as client:
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
    options = ServeOptions(live=LIVE, poll_interval_s=0.05)
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
