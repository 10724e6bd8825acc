"""A server and clients of live sessions, for tests."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from featuredb.errors import ServiceError
from reloc.client import Client, LiveTrack, TrackPose
from reloc.service.options import LiveOptions, ServeOptions
from reloc.service.server import Server
from reloc.tracking.options import TrackOptions
from reloc.wire.track import LiveStatus
from tests.support.live import SOON_S, jpeg, localiser
from tests.support.service import client_of, running_server

LIVE = LiveOptions(track=TrackOptions(live=True, keyframe_every=8), idle_timeout_s=60.0)


@contextmanager
def serving(**changes: object) -> Iterator[tuple[Server, Client]]:
    live = replace(LIVE, **changes)  # type: ignore[arg-type]
    with running_server(localiser(), ServeOptions(live=live)) as server, client_of(server) as client:
        yield server, client


def live_status(server: Server) -> LiveStatus:
    status = server.status().live
    assert status is not None
    return status


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
