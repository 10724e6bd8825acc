"""What a server's live sessions cost it and leave behind; network and followers are stand-ins."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from reloc.service.live.session import LiveSession
from reloc.service.live.sessions import LiveSessions
from reloc.service.options import LiveOptions
from reloc.wire.keys import Keys
from reloc.wire.query import ErrorCode, RequestError
from tests.support.live import wait_until


class Follower:
    """Has a process until it is let go of; notes that it was told to stop."""

    def __init__(self) -> None:
        self.stopped = False
        self.let_go = threading.Event()

    def __enter__(self) -> "Follower":
        return self

    def __exit__(self, *_: object) -> None:
        self.let_go.wait()

    def stop(self) -> None:
        self.stopped = True


class Subscribers:
    """Stands for a Zenoh session; counts what is declared in it."""

    def __init__(self) -> None:
        self.declared = 0

    def declare_subscriber(self, *_: object) -> SimpleNamespace:
        self.declared += 1
        return SimpleNamespace(undeclare=self._undeclare)

    def put(self, *_: object, **__: object) -> None: ...

    def _undeclare(self) -> None:
        self.declared -= 1


class World:
    """Live sessions of clients whose names are proven."""

    def __init__(self, max_sessions: int) -> None:
        self.network = Subscribers()
        self.followers: list[Follower] = []
        self._keys = Keys(database="town")
        options = SimpleNamespace(extractor=SimpleNamespace(fingerprint="none"))
        area = SimpleNamespace(localiser=SimpleNamespace(areas=(), options=options), snapshot=1)
        network: Any = self.network
        follower: Any = self._follower
        self.sessions = LiveSessions(
            network,
            self._keys,
            lambda: area,  # type: ignore[arg-type,return-value]
            follower,
            LiveOptions(max_sessions=max_sessions, idle_timeout_s=60.0),
            "server",
            authenticates=True,
        )

    def _follower(self, _: object) -> Follower:
        self.followers.append(Follower())
        return self.followers[-1]

    def open(self, client: str, name: str) -> None:
        query: Any = SimpleNamespace(attachment=None)
        self.sessions._opened(client, name, query)

    def refused(self, client: str, name: str) -> ErrorCode:
        with pytest.raises(RequestError) as caught:
            self.open(client, name)
        return ErrorCode(caught.value.code)

    def gone(self, client: str, name: str) -> None:
        key = f"{self._keys.track(client, name)}/client"
        sample: Any = SimpleNamespace(kind=zenoh.SampleKind.DELETE, key_expr=key)
        self.sessions._on_token(sample)

    @property
    def open_now(self) -> int:
        return self.sessions.status().open


@pytest.fixture(name="world")
def two_at_a_time() -> Iterator[World]:
    world = World(2)
    yield world
    for follower in world.followers:
        follower.let_go.set()
    world.sessions.close(10.0)


def test_who_opens_and_goes_again_and_again_gets_few_processes(world: World) -> None:
    for number in range(4):
        world.open("greedy", f"s{number}")
        world.gone("greedy", f"s{number}")
    assert all(follower.stopped for follower in world.followers)
    assert world.refused("greedy", "s4") == ErrorCode.BUSY
    assert len(world.followers) == world.open_now == 4
    world.followers[0].let_go.set()
    wait_until(lambda: world.open_now == 3, "the end of one")
    world.open("other", "s0")


def test_sessions_that_are_ending_count_for_who_asks_for_room(world: World) -> None:
    world.open("greedy", "s0")
    world.gone("greedy", "s0")
    world.open("other", "s0")
    world.open("other", "s1")
    assert world.refused("greedy", "s1") == ErrorCode.BUSY
    world.open("third", "s0")
    assert [follower.stopped for follower in world.followers] == [True, False, True, False]


def test_a_session_without_a_thread_leaves_its_place(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def start(_: LiveSession) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(LiveSession, "start", start)
        for _ in range(3):
            with pytest.raises(RuntimeError, match="new thread"):
                world.open("client", "s0")
    assert world.open_now == world.network.declared == 0
    world.open("client", "s0")


def test_frames_that_cannot_be_undeclared_leave_their_place(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def undeclare() -> None:
        raise zenoh.ZError("the session is closed")

    monkeypatch.setattr(world.network, "_undeclare", undeclare)
    world.open("client", "s0")
    world.gone("client", "s0")
    world.followers[0].let_go.set()
    wait_until(lambda: world.open_now == 0, "its place")
