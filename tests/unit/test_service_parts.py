"""Parts of the service that need no network."""

import time
from typing import get_args

import pytest

from featuredb.errors import InvalidValueError
from featuredb.geo.geopose import BODY_AXES
from featuredb.geometry.camera import Camera
from featuredb.stage_clock import StageClock
from reloc.service.handler import reply_from_result
from reloc.service.logs import Tally
from reloc.service.options import ServeOptions, check_wire_name, wire_name_of
from reloc.service.queueing import QueryQueue
from reloc.service.session import bind_free_port
from reloc.wire.keys import Keys
from reloc.wire.query import (
    ContributionReply,
    LocaliseWireRequest,
    Reason,
    RequestError,
    encode,
    parse_attachment,
)
from reloc.wording import ADVICE, describe
from tests.support.service import localised, not_localised


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("/data/My town.db", "My-town.db"),
        ("maps", "maps"),
        ("/data/maps/", "maps"),
        ("s3://bucket/prefix/oslo_2", "oslo_2"),
        ("/data/Zürich", "Z-rich"),
        ("/data/**", "default"),
        ("/data/" + "x" * 200, "x" * 64),
    ],
)
def test_the_wire_name_of_a_database(url, name):
    assert wire_name_of(url) == name
    assert Keys(database=name).localise("phone") == f"featuredb/{name}/localise/phone"


@pytest.mark.parametrize("name", ["", "a/b", "*", "a b", "-x", "a" * 65, "a?", "$x"])
def test_names_that_are_no_zenoh_chunk_are_refused(name):
    with pytest.raises(InvalidValueError, match="--name"):
        check_wire_name(name)


@pytest.mark.parametrize(
    "field", ["workers", "max_queue", "deadline_s", "poll_interval_s", "max_queued_bytes"]
)
def test_options_must_be_positive(field):
    with pytest.raises(InvalidValueError, match=field):
        ServeOptions(**{field: 0})


@pytest.mark.parametrize("port", [-1, 70_000])
def test_a_page_of_figures_needs_a_port(port):
    with pytest.raises(InvalidValueError, match=r"metrics_port: expected 0\.\.65535"):
        ServeOptions(metrics_port=port)


def test_port_zero_becomes_a_free_port_and_others_stay():
    first, second = (bind_free_port("tcp/127.0.0.1:0") for _ in range(2))
    for endpoint in (first, second):
        kind, address = endpoint.split("/")
        host, port = address.rsplit(":", 1)
        assert (kind, host) == ("tcp", "127.0.0.1")
        assert 1024 <= int(port) <= 65535
    assert bind_free_port("tcp/127.0.0.1:7447") == "tcp/127.0.0.1:7447"
    assert bind_free_port("tcp/[::1]:0").startswith("tcp/[::1]:")


def test_stages_sum_to_the_total_and_to_the_wall_time():
    start = time.perf_counter()
    clock = StageClock(start=start)
    time.sleep(0.002)
    clock.lap("queue")
    time.sleep(0.004)
    clock.lap("rest", {"features": 1.0, "total": 3.0, "matching": 2.0})
    wall_ms = (time.perf_counter() - start) * 1e3
    timings = clock.milliseconds()
    assert list(timings) == ["queue", "features", "matching", "rest", "total"]
    assert timings["total"] == pytest.approx(sum(list(timings.values())[:-1]), abs=1e-3)
    assert timings["total"] == pytest.approx(wall_ms, abs=0.5)
    assert timings["queue"] >= 2.0
    assert timings["rest"] >= 1.0


def test_percentiles_of_the_latency():
    tally = Tally()
    assert tally.latency(50) == {"count": 0, "p50": None, "max": None}
    for ms in range(1, 101):
        tally.add("not_localised", "TOO_FEW_MATCHES" if ms % 2 else "AMBIGUOUS", float(ms))
    assert tally.latency(50, 90) == {"count": 100, "p50": 50.5, "p90": 90.1, "max": 100.0}
    assert list(tally.by_code("not_localised").items()) == [("AMBIGUOUS", 50), ("TOO_FEW_MATCHES", 50)]
    assert (tally.count("not_localised"), tally.count("error")) == (100, 0)


def test_every_reason_has_advice():
    assert set(ADVICE) == set(get_args(Reason))


def test_people_read_the_reason_and_what_to_try():
    reply = reply_from_result(not_localised(3), request_id="r", timings_ms={"total": 12.0})
    text = describe("photo.jpg", reply, "town.db")
    assert text.startswith("photo.jpg: not localised in town.db: TOO_FEW_INLIERS (7 of 12 needed)")
    assert ADVICE["TOO_FEW_INLIERS"] in text


def test_a_reply_keeps_every_digit_of_the_pose():
    camera = Camera(model="PINHOLE", width=160, height=120, params=(150.0, 151.0, 80.5, 60.25))
    result = localised(3, camera, want_inliers=True)
    reply = reply_from_result(result, request_id="r", timings_ms={"total": 1.0})
    again = type(reply).model_validate_json(encode(reply))
    assert again == reply
    assert reply.body_axes == BODY_AXES
    assert (reply.utm.easting, reply.utm.northing, reply.utm.height) == tuple(result.pose.utm)
    assert reply.utm.cam_from_utm_xyzw == tuple(result.pose.cam_from_utm_xyzw)
    assert reply.covariance[3][3] == result.pose.covariance[3, 3]
    assert reply.camera.params == camera.params
    assert (reply.runner_up.lat, reply.runner_up.lon) == (49.0, 8.4)


def test_no_attachment_means_all_defaults():
    request = parse_attachment(LocaliseWireRequest, None)
    assert (
        request == parse_attachment(LocaliseWireRequest, b"") == parse_attachment(LocaliseWireRequest, b"{}")
    )
    assert request.prior is None
    assert not request.options.inliers


def test_people_read_what_a_grown_map_stands_on_and_what_became_of_their_photo():
    result = localised(7, Camera.from_focal(640, 480, 600.0))
    reply = reply_from_result(result, request_id="r", timings_ms={"total": 1.0})
    assert "lineage" not in describe("a.jpg", reply, "db"), "nothing is to be said of an anchor"
    grown = reply.lineage[0].model_copy(
        update={"steps": 3, "anchors": ("A12", "B"), "drift_m": 0.312, "budget_m": 0.5}
    )
    taken = ContributionReply(accepted=True, candidate_id="0" * 32, reason=None, detail="queued")
    text = describe("a.jpg", reply.model_copy(update={"lineage": (grown,), "contribution": taken}), "db")
    assert "  lineage   3 steps from anchor A12, 0.31 of 0.50 m\n" in text
    assert f"  given     candidate {'0' * 32}\n" in text
    full = ContributionReply(accepted=False, candidate_id=None, reason="QUEUE_FULL", detail="32 wait")
    lost = reply_from_result(not_localised(3), request_id="r", timings_ms={"total": 12.0})
    assert "  not taken QUEUE_FULL: 32 wait\n" in describe(
        "a.jpg", lost.model_copy(update={"contribution": full}), "db"
    )


class Waiting:
    """A query in the queue, no two of which are equal."""

    def __init__(self, asker: str, size: int) -> None:
        self.asker, self.size, self.answered = asker, size, False
        self.refused: list[RequestError] = []
        self.refuse = self.refused.append


def waiting(asker: str, size: int = 1) -> Waiting:
    return Waiting(asker, size)


def test_who_floods_waits_for_those_who_do_not():
    queue = QueryQueue(100, 1000)
    flood, honest = [waiting("flood") for _ in range(5)], waiting("honest")
    for item in (*flood, honest):
        queue.put(item)
    assert queue.get() is flood[0]
    assert queue.get() is honest, "the flood has one in hand"
    queue.done(honest, 0.1)
    assert queue.get() is flood[1]
    queue.done(flood[0], 4.0)
    queue.done(flood[1], 4.0)
    for item in (late := [waiting("late") for _ in range(3)]):
        queue.put(item)
    assert queue.get() is flood[2], "whoever comes later has no more credit than those who wait"
    queue.done(flood[2], 4.0)
    for item in late:
        assert queue.get() is item, "turns are by time, not by number"
        queue.done(item, 0.1)
    assert len(queue) == 2


@pytest.mark.parametrize(("length", "size"), [(4, 10**6), (100, 4)])
def test_in_a_full_queue_who_has_most_waiting_makes_room(length, size):
    queue = QueryQueue(length, size)
    flood = [waiting("flood") for _ in range(4)]
    for item in flood:
        queue.put(item)
    with pytest.raises(RequestError, match="full"):
        queue.put(waiting("flood"))
    honest = [waiting("honest") for _ in range(2)]
    for item in honest:
        queue.put(item)
    assert [bool(item.refused) for item in flood] == [False, False, True, True]
    assert flood[3].refused[0].code == "BUSY"
    with pytest.raises(RequestError, match="full"):
        queue.put(waiting("honest"))
    queue.close()
    assert {id(queue.get()) for _ in range(4)} == {id(item) for item in (*flood[:2], *honest)}
    assert queue.get() is None


def test_a_query_that_is_answered_keeps_no_place():
    queue = QueryQueue(2, 100)
    late = waiting("a"), waiting("a")
    for item in late:
        queue.put(item)
    late[1].answered = True
    queue.put(waiting("a"))
    assert len(queue) == 2


def test_nobody_goes_for_a_query_that_does_not_fit():
    queue = QueryQueue(10, 10)
    others = [waiting("a", 3), waiting("a", 3), waiting("a", 3)]
    for item in others:
        queue.put(item)
    with pytest.raises(RequestError):
        queue.put(waiting("b", 9))
    assert len(queue) == 3
