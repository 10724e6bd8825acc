"""Several servers of one database behind a router: who is asked, and what becomes of lost ones."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from scipy.spatial.transform import Rotation

from featuredb.errors import ServiceError
from featuredb.geometry.camera import Camera
from featuredb.store import Database
from reloc.client import Client, PriorRequest
from reloc.client import fleet as fleet_module
from reloc.localise.acceptance import AcceptanceOptions
from reloc.localise.options import LocaliseOptions
from reloc.localise.result import LocaliseResult
from reloc.service.contributions.inbox import Inbox, InboxOptions
from reloc.service.options import ServeOptions
from reloc.service.server import Server
from reloc.service.session import bind_free_port
from reloc.wire.server import BoundingBox
from tests.support.maps import random_map
from tests.support.service import (
    MemoryInbox,
    MemorySource,
    ScriptedLocaliser,
    area_of,
    localised,
    map_info,
    not_localised,
    photo,
    running_server,
)
from tools.serve_process import CommandProcess

WEST, EAST = (8.0, 49.0, 8.5, 49.5), (8.5, 49.0, 9.0, 49.5)
IN_WEST = PriorRequest(lat=49.2, lon=8.2, sigma_m=20.0)
IN_EAST = PriorRequest(lat=49.2, lon=8.8, sigma_m=20.0)


@pytest.fixture
def router() -> Iterator[str]:
    """The endpoint of a Zenoh router."""
    endpoint = bind_free_port("tcp/127.0.0.1:0")
    config = zenoh.Config.from_json5(f'{{mode: "router", listen: {{endpoints: ["{endpoint}"]}}}}')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        yield endpoint


@contextmanager
def member(
    router: str,
    localiser: ScriptedLocaliser,
    bbox: tuple[float, float, float, float] | None = None,
    inbox: Inbox | None = None,
) -> Iterator[Server]:
    west, south, east, north = bbox or (8.0, 49.0, 9.0, 49.5)
    bounds = BoundingBox(west=west + 0.1, south=south + 0.1, east=east - 0.1, north=north - 0.1)
    source = MemorySource(area_of(localiser, map_info().model_copy(update={"bounds": bounds})))
    options = ServeOptions(connect=(router,), bbox=bbox, workers=1)
    with running_server(source, options, inbox=inbox) as server:
        yield server


def with_inliers(
    count: int, east_m: float = 0.0, up_m: float = 0.0, turn_deg: float = 0.0
) -> Callable[..., LocaliseResult]:
    """Answers with so many inliers, so far from the usual place, turned about the vertical."""

    def answer(gray, request):
        height, width = gray.shape
        found = localised(1, Camera.from_focal(width, height, 200.0))
        pose = found.pose
        at = replace(
            pose.geopose,
            longitude_deg=pose.geopose.longitude_deg + east_m / 73_000.0,
            height_m=pose.geopose.height_m + up_m,
            quaternion_xyzw=_turned(pose.geopose.quaternion_xyzw, turn_deg),
        )
        return replace(found, inliers=count, pose=replace(pose, geopose=at))

    return answer


def _turned(xyzw: tuple[float, ...], degrees: float) -> tuple[float, ...]:
    turn = Rotation.from_euler("z", degrees, degrees=True) * Rotation.from_quat(xyzw)
    return tuple(turn.as_quat(canonical=True).tolist())


def test_replicas_share_the_queries(router: str) -> None:
    localisers = [ScriptedLocaliser(1) for _ in range(3)]
    with ExitStack() as stack:
        for localiser in localisers:
            stack.enter_context(member(router, localiser))
        client = stack.enter_context(Client(router))
        assert len(client.statuses()) == 3
        for _ in range(12):
            assert client.localise(photo()).status == "localised"
    assert [len(one.requests) for one in localisers] == [4, 4, 4]


def test_a_prior_says_which_part_is_asked(router: str) -> None:
    west, east = ScriptedLocaliser(1, with_inliers(50)), ScriptedLocaliser(1, with_inliers(90))
    with member(router, west, WEST), member(router, east, EAST), Client(router) as client:
        parts = {status.part for status in client.statuses()}
        assert parts == {"8.0,49.0,8.5,49.5", "8.5,49.0,9.0,49.5"}
        for _ in range(3):
            assert client.localise(photo(), IN_WEST).inliers == 50
        assert client.localise(photo(), IN_EAST).inliers == 90
        assert (len(west.requests), len(east.requests)) == (3, 1)
        nowhere = PriorRequest(lat=-20.0, lon=100.0, sigma_m=20.0)
        client.localise(photo(), nowhere)
        assert len(west.requests) + len(east.requests) == 5, "one of them says that it has nothing there"


def test_without_a_prior_the_best_supported_answer_counts(router: str) -> None:
    west, east = ScriptedLocaliser(1, with_inliers(20)), ScriptedLocaliser(1, with_inliers(90, 500.0))
    with member(router, west, WEST), member(router, east, EAST), Client(router) as client:
        assert client.localise(photo()).inliers == 90
        west._answer = lambda *_: not_localised(1)
        assert client.localise(photo()).inliers == 90
        west._answer = with_inliers(60)
        reply = client.localise(photo())
        assert (reply.status, reply.reason, reply.position) == ("not_localised", "AMBIGUOUS", None)
        west._answer = with_inliers(60, 500.0)
        assert client.localise(photo()).inliers == 90, "both have the same place"
        for other in (with_inliers(60, 500.0, up_m=20.0), with_inliers(60, 500.0, turn_deg=170.0)):
            west._answer = other
            assert client.localise(photo()).reason == "AMBIGUOUS"
        # What the other refused, one server would have taken for a rival, too.
        west._answer = lambda *_: replace(not_localised(1), inliers=60)
        assert client.localise(photo()).reason == "AMBIGUOUS"
        west._answer = east._answer = lambda *_: not_localised(1)
        assert client.localise(photo()).reason == "TOO_FEW_INLIERS"
    assert (len(west.requests), len(east.requests)) == (8, 8)


def test_a_part_that_is_gone_is_missed(router: str) -> None:
    """Nobody else's answer stands for it, with a prior there or without one."""
    west, east = ScriptedLocaliser(1, with_inliers(20)), ScriptedLocaliser(1, with_inliers(90, 500.0))
    with member(router, east, EAST), Client(router) as client:
        with member(router, west, WEST):
            assert client.localise(photo()).inliers == 90
        for prior in (None, IN_WEST):
            with pytest.raises(ServiceError, match="no server of"):
                client.localise(photo(), prior)
        client._fleet._state.until = 0.0  # the list is made anew
        for prior in (None, IN_WEST):
            with pytest.raises(ServiceError, match=r"no server of the part 8\.0,49\.0"):
                client.localise(photo(), prior)
        assert client.localise(photo(), IN_EAST).inliers == 90


def test_maps_are_those_of_all_parts_and_named_ones_are_asked_for_everywhere(router: str) -> None:
    west, east = ScriptedLocaliser(1, with_inliers(20)), ScriptedLocaliser(1, with_inliers(90))
    with member(router, west, WEST), member(router, east, EAST), Client(router) as client:
        assert len(client.maps().maps) == 1  # both have map-a
        client.localise(photo(), IN_WEST, maps=("map-a",))
    assert (len(west.requests), len(east.requests)) == (1, 1)


def test_replicas_of_several_parts_take_turns_each(router: str) -> None:
    localisers = [ScriptedLocaliser(1, with_inliers(20 if k < 2 else 90)) for k in range(4)]
    with ExitStack() as stack:
        for k, localiser in enumerate(localisers):
            stack.enter_context(member(router, localiser, WEST if k < 2 else EAST))
        client = stack.enter_context(Client(router))
        for _ in range(6):
            client.localise(photo())
    assert [len(one.requests) for one in localisers] == [3, 3, 3, 3]


def test_a_status_that_hangs_leaves_time_for_the_answer(router: str) -> None:
    held: list[zenoh.Query] = []
    with member(router, ScriptedLocaliser(1)), Client(router) as client:
        hanging = client._session().declare_queryable("featuredb/town/status", held.append, complete=True)
        assert client.localise(photo(), timeout_s=5.0).status == "localised"
        hanging.undeclare()
        held.clear()


def test_a_server_that_has_all_makes_parts_needless(router: str) -> None:
    west, whole = ScriptedLocaliser(1, with_inliers(20)), ScriptedLocaliser(1, with_inliers(30))
    with member(router, west, WEST), member(router, whole), Client(router) as client:
        assert client.localise(photo()).inliers == 30
        assert not west.requests


def test_a_photo_is_given_once(router: str) -> None:
    west, east = ScriptedLocaliser(1, with_inliers(20)), ScriptedLocaliser(1, with_inliers(90))
    given: list[bool] = []
    inboxes = [Inbox(one.write, one.counts, InboxOptions()) for one in (MemoryInbox(), MemoryInbox())]
    with (
        member(router, west, WEST, inboxes[0]),
        member(router, east, EAST, inboxes[1]),
        Client(router) as client,
    ):
        ask = client._ask_part
        client._ask_part = lambda part, data, request, end: (  # type: ignore[method-assign]
            given.append(request.contribute),
            ask(part, data, request, end),
        )[1]
        reply = client.localise(photo(), contribute=True, credit="A", licence="CC0-1.0")
    assert sorted(given) == [False, True]
    assert reply.inliers == 90
    assert reply.contribution is not None
    assert reply.contribution.accepted
    with (
        member(router, west, WEST),
        member(router, east, EAST),
        Client(router) as client,
        pytest.raises(ServiceError, match="takes no"),
    ):
        client.localise(photo(), contribute=True, credit="A", licence="CC0-1.0")


def test_a_part_is_handed_over_under_load(router: str) -> None:
    """A new server of the same part comes, the old one goes: every query is answered."""
    old, new = ScriptedLocaliser(1), ScriptedLocaliser(2)
    statuses: list[str] = []
    stop = threading.Event()

    def ask_on(client: Client) -> None:
        while not stop.is_set():
            statuses.append(client.localise(photo(), IN_WEST).status)

    with ExitStack() as stack:
        first = stack.enter_context(ExitStack())
        first.enter_context(member(router, old, WEST))
        client = stack.enter_context(Client(router))
        with ThreadPoolExecutor(3) as pool:
            asking = [pool.submit(ask_on, client) for _ in range(3)]
            try:
                wait_until(lambda: len(statuses) > 5)
                stack.enter_context(member(router, new, WEST))
                first.close()
                wait_until(lambda: len(new.requests) > 5)
            finally:
                stop.set()
            for one in asking:
                one.result()
    assert set(statuses) == {"localised"}
    assert len(old.requests) > 5


def test_a_killed_server_loses_no_query(router: str, tmp_path: Path) -> None:
    database = Database.create(tmp_path / "town.db")
    database.commit_map(random_map(0, fingerprint=LocaliseOptions().extractor.fingerprint))
    servers = [
        CommandProcess("serve", database.url, "--connect", router, "--listen", "tcp/127.0.0.1:0")
        for _ in range(2)
    ]
    asked: list[str] = []
    try:
        with Client(router) as client, ThreadPoolExecutor(4) as pool:
            assert len(client.statuses()) == 2
            replies = [pool.submit(lambda: asked.append(client.localise(photo()).status)) for _ in range(40)]
            wait_until(lambda: len(asked) > 8)
            servers[0].process.kill()
            for reply in replies:
                reply.result()
            assert [status.server_id for status in client.statuses()] != []
    finally:
        for server in servers:
            server.stop()
    assert asked == ["not_localised"] * 40


def test_servers_that_cannot_be_addressed_are_asked_by_the_common_key(router: str) -> None:
    localiser = ScriptedLocaliser(1)
    with member(router, localiser), Client(router) as client:
        own = client.statuses
        older = [status.model_copy(update={"addressable": False}) for status in own()]
        client._fleet = fleet_module.Fleet(lambda _: older)
        assert client.localise(photo()).status == "localised"
        client._fleet = fleet_module.Fleet(lambda _: [])
        assert client.localise(photo()).status == "localised"
        gone = [status.model_copy(update={"server_id": "gone"}) for status in own()]
        client._fleet = fleet_module.Fleet(lambda _: gone)
        assert client.localise(photo()).status == "localised", "by the common key"
    assert len(localiser.requests) == 3


def test_a_rival_is_what_localisation_takes_for_one() -> None:
    assert AcceptanceOptions().rival_share == fleet_module._RIVAL_SHARE


def test_what_one_server_calls_ambiguous_another_does_not_settle(router: str) -> None:
    ambiguous = not_localised(1)
    west = ScriptedLocaliser(1, lambda *_: replace(ambiguous, reason="AMBIGUOUS", inliers=80))
    east = ScriptedLocaliser(1, with_inliers(90))
    with member(router, west, WEST), member(router, east, EAST), Client(router) as client:
        assert client.localise(photo()).reason == "AMBIGUOUS"


def test_without_any_server_the_client_says_so(router: str) -> None:
    with member(router, ScriptedLocaliser(1)) as server, Client(router) as client:
        assert client.localise(photo()).status == "localised"
        server.close()
        with pytest.raises(ServiceError, match="no server of database"):
            client.localise(photo(), timeout_s=3.0)


def wait_until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    waited = threading.Event()
    for _ in range(int(seconds / 0.02)):
        if true():
            return
        waited.wait(0.02)
    raise AssertionError("it never came")
