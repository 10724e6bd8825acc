"""Contributed queries from a client over Zenoh into a database, and everything that may refuse them."""

import json
import random
import struct
import time
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from featuredb.errors import InvalidValueError, ServiceError, StoreError
from featuredb.features.decode import DecodeLimits
from featuredb.store import Database
from featuredb.store.candidates.photos import InboxCounts, contribute, count_candidates, list_candidates
from featuredb.store.candidates.states import candidate_id_of
from reloc.client import PriorRequest
from reloc.service.contributions.inbox import Inbox, InboxOptions
from reloc.service.options import ServeOptions
from reloc.wire.query import LocaliseReply
from tests.support.contributions import load_image
from tests.support.service import (
    Gate,
    MemoryInbox,
    ScriptedLocaliser,
    client_of,
    not_localised,
    photo,
    running_server,
)

GIFT = {"contribute": True, "credit": "A. Person", "licence": "CC-BY-4.0"}
WAIT_S = 20.0


def inbox_of(database: Database) -> Inbox:
    return Inbox(partial(contribute, database), partial(count_candidates, database))


def exif() -> Image.Exif:
    found = Image.Exif()
    found[271], found[272] = "Maker", "Model 1"
    found.get_ifd(34665)[36867] = "2026:05:01 12:30:15"
    found.get_ifd(34853).update({1: "N", 2: (49.0, 30.0, 0.0), 3: "W", 4: (8.0, 15.0, 0.0)})
    return found


def raw(session, payload: bytes, request: object) -> tuple[bool, dict]:
    """One query as any client may send it: whether it got a reply, and the reply or error."""
    attachment = request if isinstance(request, bytes) else json.dumps(request).encode()
    (reply,) = session.get(
        "featuredb/town/localise/anonymous", payload=payload, attachment=attachment, timeout=10
    )
    return reply.ok is not None, json.loads((reply.ok or reply.err).payload.to_bytes())


def written(server, count: int) -> None:
    end = time.monotonic() + WAIT_S
    while server.status().contributions.written < count:
        assert time.monotonic() < end, server.status().contributions
        time.sleep(0.01)


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database.create(tmp_path / "town.db")


def test_a_contributed_query_lands_in_the_database(database):
    data = photo(exif=exif())
    localiser = ScriptedLocaliser(7)
    with (
        running_server(localiser, inbox=inbox_of(database)) as server,
        client_of(server) as client,
    ):
        assert list_candidates(database) == [], "the tables are made by the first photo"
        reply = client.localise(
            data,
            PriorRequest(lat=49.5, lon=-8.25, sigma_m=30.0),
            client_id="phone 7",
            request_id="r-1",
            inliers=True,
            **GIFT,
        )
        written(server, 1)
        assert client.localise(data).contribution is None
        status = client.status().contributions
    assert reply.status == "localised"
    assert reply.contribution.accepted
    assert reply.contribution.candidate_id == candidate_id_of(data)
    assert "contribution" in reply.timings_ms
    (found,) = list_candidates(database)
    assert load_image(database, found.candidate_id) == data
    assert (found.owner, found.credit) == ("anonymous", "A. Person")
    assert (found.licence, found.state) == ("CC-BY-4.0", "waiting")
    assert (found.contributors[0].client_id, found.snapshot) == ("phone 7", 7)
    assert (found.width, found.height) == (160, 120)
    assert found.request["prior"]["sigma_m"] == 30.0
    assert found.request["request_id"] == "r-1"
    assert found.request["exif"]["capture_time"] == "2026-05-01T12:30:15"
    assert (found.request["exif"]["make"], found.request["exif"]["latitude_deg"]) == ("Maker", 49.5)
    assert found.answer["utm"] == json.loads(reply.model_dump_json())["utm"]
    assert (found.answer["status"], found.answer["maps"]) == ("localised", ["map-a"])
    assert "inlier_points" not in found.answer
    assert (status.accepted, status.written, status.lost, status.refused) == (1, 1, 0, {})


def test_photos_that_are_not_localised_are_welcome(database):
    """They may be the ones from which the maps grow."""
    with (
        running_server(ScriptedLocaliser(1, lambda *_: not_localised(1)), inbox=inbox_of(database)) as server,
        client_of(server) as client,
    ):
        reply = client.localise(photo(), **GIFT)
        written(server, 1)
    assert (reply.status, reply.contribution.accepted) == ("not_localised", True)
    assert list_candidates(database)[0].answer["reason"] == "TOO_FEW_INLIERS"


def test_who_is_not_authenticated_is_one_owner_whatever_names_are_given(database):
    with (
        running_server(ScriptedLocaliser(1), inbox=inbox_of(database)) as server,
        client_of(server) as client,
    ):
        client.name = "Cleo"
        for name in ("Ada", "Bob", "Ada"):
            assert client.localise(
                photo(), contribute=True, credit=name, licence="CC0-1.0"
            ).contribution.accepted
        written(server, 3)
    (found,) = list_candidates(database)
    assert [(c.owner, c.credit) for c in found.contributors] == [("anonymous", "Ada")]


def test_a_server_that_stops_writes_what_it_has_taken(database):
    with (
        running_server(ScriptedLocaliser(1), inbox=inbox_of(database)) as server,
        client_of(server) as client,
    ):
        for seed in range(6):
            assert client.localise(photo(seed=seed), **GIFT).contribution.accepted
    assert len(list_candidates(database)) == 6


def test_a_query_never_waits_for_the_store():
    store = MemoryInbox()
    store.gate = Gate()
    options = InboxOptions(max_queue=2)
    with (
        running_server(
            ScriptedLocaliser(1),
            inbox=Inbox(lambda given: store.write(given), lambda: store.counts(), options),
        ) as server,
        client_of(server) as client,
    ):
        replies = [client.localise(photo(seed=i), timeout_s=10.0, **GIFT) for i in range(5)]
        assert [r.status for r in replies] == ["localised"] * 5
        assert [r.contribution.accepted for r in replies] == [True, True, False, False, False]
        assert {r.contribution.reason for r in replies[2:]} == {"QUEUE_FULL"}
        assert replies[2].contribution.candidate_id is None
        assert "send it again" in replies[2].contribution.detail
        # A queue in memory and a hash of some kilobytes: far below what localising takes.
        assert max(r.timings_ms["contribution"] for r in replies) < 50.0
        assert store.written == []
        store.gate.open()
        written(server, 2)


@pytest.mark.parametrize(
    ("options", "stored", "failure", "reason"),
    [
        (InboxOptions(max_owner_photos=1), {"anonymous": 1}, None, "OWNER_LIMIT"),
        (InboxOptions(max_photos=2), {"Ada": 2}, None, "INBOX_FULL"),
        (InboxOptions(max_stored_bytes=1000), {}, None, "INBOX_FULL"),
        (InboxOptions(), {}, StoreError("bucket unreachable"), "STORE_FAILED"),
    ],
)
def test_what_is_not_taken_is_answered_all_the_same(options, stored, failure, reason):
    store = MemoryInbox()
    store.stored = InboxCounts(
        by_state={"waiting": sum(stored.values())}, waiting_by_owner=stored, stored_bytes=500
    )
    if failure is not None:

        def fail() -> InboxCounts:
            raise failure

        store.counts = fail
    with (
        running_server(
            ScriptedLocaliser(1),
            inbox=Inbox(lambda given: store.write(given), lambda: store.counts(), options),
        ) as server,
        client_of(server) as client,
    ):
        reply = client.localise(photo(), **GIFT)
        status = client.status().contributions
    assert reply.status == "localised"
    assert (reply.contribution.accepted, reply.contribution.reason) == (False, reason)
    assert reply.contribution.detail
    assert status.refused == {reason: 1}
    assert store.written == []


def test_a_query_that_comes_too_late_contributes_nothing():
    """The place in the queue is given back, and the photo is not taken behind the client's back."""
    store = MemoryInbox()
    gate = Gate()

    def slow(gray, request):
        gate.wait()
        return not_localised(1)

    with (
        running_server(
            ScriptedLocaliser(1, slow),
            ServeOptions(deadline_s=0.2),
            inbox=Inbox(store.write, store.counts, InboxOptions(max_queue=1)),
        ) as server,
        client_of(server) as client,
    ):
        with pytest.raises(ServiceError, match="DEADLINE"):
            client.localise(photo(), **GIFT)
        gate.open()
        end = time.monotonic() + WAIT_S
        while server.status().queue.busy:
            assert time.monotonic() < end
            time.sleep(0.01)
        assert server.status().contributions.waiting == 0
        assert server.status().contributions.accepted == 0
    assert store.written == []


def test_what_fails_as_a_query_contributes_nothing():
    store = MemoryInbox()
    with (
        running_server(
            ScriptedLocaliser(1),
            ServeOptions(limits=DecodeLimits(max_bytes=50_000)),
            inbox=Inbox(store.write, store.counts),
        ) as server,
        client_of(server) as client,
    ):
        session = client._session()
        data = photo()
        bomb = bytearray(data)
        frame = bomb.index(b"\xff\xc0")
        bomb[frame + 5 : frame + 9] = struct.pack(">HH", 65_535, 65_535)
        for payload, code in (
            (b"", "BAD_IMAGE"),
            (b"x" * 100, "BAD_IMAGE"),
            (data[: len(data) // 2], "BAD_IMAGE"),
            (bytes(bomb), "TOO_LARGE"),
            (bytes(60_000), "TOO_LARGE"),
        ):
            ok, said = raw(session, payload, GIFT)
            assert (ok, said["code"]) == (False, code)
        for request in (
            {**GIFT, "credit": None},
            {**GIFT, "licence": ""},
            {**GIFT, "credit": "A" * 201},
            {**GIFT, "credit": "A\nB"},
            {**GIFT, "credit": "\x1b]0;title\x07"},
            {**GIFT, "credit": {"name": "A"}},
            {**GIFT, "licence": 4},
            {**GIFT, "client_id": ""},
            {**GIFT, "contribute": 1},
            b'{"contribute": true, "credit": "\\ud800", "licence": "x"}',
            b'{"contribute": true, "credit": "\xff\xfe", "licence": "x"}',
        ):
            ok, said = raw(session, data, request)
            assert (ok, said["code"]) == (False, "BAD_REQUEST"), request
        assert client.localise(data, **GIFT).contribution.accepted
        written(server, 1)
        assert server.status().contributions.accepted == 1
    assert len(store.written) == 1


def test_random_gifts_are_answered_one_by_one():
    """Whatever the fields say, there is one answer each, and what is accepted is written."""
    rng = random.Random(4)
    store = MemoryInbox()
    values = [
        "",
        " ",
        "A",
        "Ä ß",
        "A" * 200,
        "A" * 201,
        None,
        7,
        True,
        ["A"],
        "a\tb",
        "\u202eA",
        "\x00",
        "'; --",
    ]
    told = {"taken": 0, "refused": 0}
    with (
        running_server(ScriptedLocaliser(1), inbox=Inbox(store.write, store.counts)) as server,
        client_of(server) as client,
    ):
        for _ in range(150):
            request = {name: rng.choice(values) for name in ("credit", "licence") if rng.random() < 0.9}
            request["contribute"] = rng.choice([True, True, True, False, None])
            ok, said = raw(client._session(), photo(seed=rng.randrange(3)), request)
            if ok and said["contribution"] is not None and said["contribution"]["accepted"]:
                told["taken"] += 1
            elif not ok:
                assert said["code"] == "BAD_REQUEST"
                told["refused"] += 1
        assert client.localise(photo()).status == "localised"
    assert len(store.written) == told["taken"]
    assert min(told.values()) > 10, told


def test_a_server_without_an_inbox_says_so():
    with running_server(ScriptedLocaliser(1)) as server, client_of(server) as client:
        with pytest.raises(ServiceError, match="--contributions on") as caught:
            client.localise(photo(), **GIFT)
        assert caught.value.code == "UNSUPPORTED"
        assert client.status().contributions is None
        assert client.localise(photo(), credit="A. Person", licence="CC0-1.0").contribution is None


def test_the_client_refuses_what_no_server_takes():
    with running_server(ScriptedLocaliser(1)) as server, client_of(server) as client:
        with pytest.raises(InvalidValueError, match="expected licence"):
            client.localise(photo(), contribute=True, credit="A. Person")
        with pytest.raises(InvalidValueError, match="credit"):
            client.localise(photo(), contribute=True, credit="\n", licence="CC0-1.0")


def test_readers_take_replies_of_servers_that_know_no_contributions():
    with running_server(ScriptedLocaliser(1)) as server, client_of(server) as client:
        said = json.loads(client.localise(photo()).model_dump_json())
    said.pop("contribution")
    for entry in said["lineage"]:
        for name in ("steps", "anchors", "drift_m", "budget_m"):
            entry.pop(name)
    old = LocaliseReply.model_validate_json(json.dumps(said))
    assert (old.contribution, old.lineage[0].steps, old.lineage[0].anchors) == (None, None, ())
