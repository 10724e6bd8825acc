"""The JSON Schemas and the program say the same, on messages that a real server sent and took."""

import json

import jsonschema
import pytest
from pydantic import ValidationError

from featuredb.features.decode import DecodeLimits
from reloc.service.contributions.inbox import Inbox, InboxOptions
from reloc.service.options import ServeOptions
from reloc.wire.query import (
    ErrorCode,
    LocaliseReply,
    LocaliseWireRequest,
    RequestError,
    parse_attachment,
)
from reloc.wire.server import MapsReply, StatusReply
from schemas import load_schema
from tests.support.events import watch_events
from tests.support.service import (
    MemoryInbox,
    MemorySource,
    ScriptedLocaliser,
    area_of,
    client_of,
    map_info,
    not_localised,
    photo,
    running_server,
)

NAMES = ("localise_request", "localise_reply", "error", "status", "maps", "event")


def validator(name: str) -> jsonschema.Draft202012Validator:
    schema = load_schema(f"wire/{name}")
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(
        schema, format_checker=jsonschema.Draft202012Validator.FORMAT_CHECKER
    )


def raw(session, leaf: str, **kwargs) -> bytes:
    (reply,) = session.get(f"featuredb/town/{leaf}", timeout=10, **kwargs)
    return (reply.ok or reply.err).payload.to_bytes()


@pytest.fixture(scope="module")
def messages():
    """One of each message, as bytes off the wire: name -> list."""
    reasons = iter([False, False, True, False, False])

    def answer(gray, request):
        if next(reasons):
            return not_localised(1)
        return None

    plain = ScriptedLocaliser(1)

    class Mixed(ScriptedLocaliser):
        def localise(self, gray, request, size):
            return answer(gray, request) or plain.localise(gray, request, size)

    source = MemorySource(area_of(Mixed(1)))
    options = ServeOptions(poll_interval_s=0.05, limits=DecodeLimits(max_bytes=100_000))
    found: dict[str, list[bytes]] = {name: [] for name in NAMES}
    given = MemoryInbox()
    inbox = Inbox(given.write, given.counts, InboxOptions(max_owner_photos=1))
    with running_server(source, options, inbox=inbox) as server, client_of(server) as client:
        session = client._session()
        with session.declare_subscriber(
            "featuredb/town/events", lambda s: found["event"].append(s.payload.to_bytes())
        ):
            for attachment in (b"", b'{"options": {"inliers": true}}', b'{"request_id": "r1"}'):
                found["localise_reply"].append(
                    raw(session, "localise/anonymous", payload=photo(), attachment=attachment)
                )
            gift = b'{"contribute": true, "credit": "A", "licence": "CC0-1.0"}'
            for seed in (1, 2):
                found["localise_reply"].append(
                    raw(session, "localise/anonymous", payload=photo(seed=seed), attachment=gift)
                )
            for payload, attachment in ((b"x", b""), (photo(), b"{"), (bytes(200_000), b"")):
                found["error"].append(
                    raw(session, "localise/anonymous", payload=payload, attachment=attachment)
                )
            found["status"].append(raw(session, "status"))
            found["maps"].append(raw(session, "maps"))
            with watch_events(client) as events:
                source.publish(area_of(ScriptedLocaliser(2), map_info("map-b")))
                while (event := events.next(timeout_s=10)) is not None and event.type != "reloaded":
                    pass
            found["status"].append(raw(session, "status"))
    return found


@pytest.mark.parametrize("name", [n for n in NAMES if n != "localise_request"])
def test_every_message_off_the_wire_is_valid_by_its_schema(messages, name):
    assert messages[name]
    for message in messages[name]:
        validator(name).validate(json.loads(message))


def test_the_messages_cover_the_kinds(messages):
    replies = [json.loads(m) for m in messages["localise_reply"]]
    assert [r["status"] for r in replies[:3]] == ["localised", "localised", "not_localised"]
    assert [r["inlier_points"] is None for r in replies[:3]] == [True, False, True]
    assert [r["contribution"] and r["contribution"]["reason"] for r in replies[2:]] == [
        None,
        None,
        "OWNER_LIMIT",
    ]
    assert [r["contribution"] and r["contribution"]["accepted"] for r in replies[2:]] == [None, True, False]
    status = json.loads(messages["status"][0])["contributions"]
    assert (status["accepted"], status["refused"]) == (1, {"OWNER_LIMIT": 1})
    assert {json.loads(m)["code"] for m in messages["error"]} == {"BAD_IMAGE", "BAD_REQUEST", "TOO_LARGE"}
    assert {json.loads(m)["type"] for m in messages["event"]} == {"map_committed", "map_retired", "reloaded"}


def test_a_localised_reply_is_a_geopose_and_readers_that_know_only_that_can_read_it(messages):
    from featuredb.geo.geopose import BODY_AXES, GeoPose

    reply = json.loads(messages["localise_reply"][0])
    place = reply["position"]
    pose = GeoPose(
        latitude_deg=place["lat"],
        longitude_deg=place["lon"],
        height_m=place["h"],
        quaternion_xyzw=tuple(reply["quaternion"][axis] for axis in "xyzw"),
    )
    assert (pose.latitude_deg, pose.longitude_deg) == (place["lat"], place["lon"])
    assert reply["body_axes"] == BODY_AXES


@pytest.mark.parametrize(
    "field", ["position", "utm", "covariance", "accuracy", "camera", "snapshot", "timings_ms"]
)
def test_schema_and_reader_both_refuse_a_localised_reply_without(messages, field):
    reply = json.loads(messages["localise_reply"][0])
    del reply[field]
    assert not validator("localise_reply").is_valid(reply)
    with pytest.raises(ValidationError):
        LocaliseReply.model_validate_json(json.dumps(reply))


def test_schema_and_reader_both_refuse_a_fallback_pose(messages):
    localised, _, failed = (json.loads(m) for m in messages["localise_reply"][:3])
    for field in ("position", "utm", "accuracy"):
        broken = {**failed, field: localised[field]}
        assert not validator("localise_reply").is_valid(broken)
        with pytest.raises(ValidationError):
            LocaliseReply.model_validate_json(json.dumps(broken))


def test_schemas_and_models_name_the_same_fields():
    for name, model in (("localise_reply", LocaliseReply), ("status", StatusReply), ("maps", MapsReply)):
        assert set(load_schema(f"wire/{name}")["properties"]) == set(model.model_fields), name
    assert set(load_schema("wire/localise_request")["properties"]) == set(LocaliseWireRequest.model_fields)
    assert set(load_schema("wire/error")["properties"]["code"]["enum"]) == {c.value for c in ErrorCode}


GOOD_REQUESTS = [
    {},
    {"request_id": "a.b:c-1"},
    {"prior": {"lat": -90, "lon": 180, "sigma_m": 0.01}},
    {"prior": {"lat": 1.5, "lon": 2, "sigma_m": 5, "h": None}},
    {"prior": {"lat": 1.5, "lon": 2, "sigma_m": 5, "h": -100.5, "sigma_vertical_m": 3}},
    {
        "camera": {
            "model": "SIMPLE_RADIAL",
            "width": 4000,
            "height": 3000,
            "params": [3000, 2000, 1500, -0.01],
        }
    },
    {
        "camera": {
            "model": "SIMPLE_RADIAL",
            "width": 4000,
            "height": 3000,
            "params": [3000, 2000, 1500, -0.01],
            "sigmas": [3, 1.5, 1.5, 0],
        }
    },
    {"camera": None, "prior": None, "request_id": None, "contribute": False, "options": {}},
    {"contribute": True, "credit": "A. Person", "licence": "CC-BY-4.0", "client_id": "phone 7"},
    {"contribute": True, "credit": "Ä" * 200, "licence": "x", "client_id": None},
    {"contribute": False, "credit": None, "licence": "CC0-1.0"},
    {"options": {"inliers": True, "exif_prior": False, "maps": ["a", "b"], "deadline_ms": 250}},
]
BAD_REQUESTS = [
    [],
    "text",
    {"unknown": 1},
    {"request_id": ""},
    {"request_id": "a b"},
    {"request_id": "a" * 129},
    {"request_id": 5},
    {"prior": {}},
    {"prior": {"lat": 90.001, "lon": 0, "sigma_m": 5}},
    {"prior": {"lat": 0, "lon": -180.5, "sigma_m": 5}},
    {"prior": {"lat": 0, "lon": 0, "sigma_m": 0}},
    {"prior": {"lat": 0, "lon": 0, "sigma_m": 1e9}},
    {"prior": {"lat": True, "lon": 0, "sigma_m": 5}},
    {"prior": {"lat": 0, "lon": 0, "sigma_m": 5, "height": 3}},
    {"camera": {"model": "PINHOLE", "width": 0, "height": 1, "params": [1, 1, 1, 1]}},
    {"camera": {"model": "PINHOLE", "width": 1.5, "height": 1, "params": [1, 1, 1, 1]}},
    {"camera": {"model": "pinhole", "width": 1, "height": 1, "params": [1, 1, 1, 1]}},
    {"camera": {"model": "PINHOLE", "width": 1, "height": 1, "params": [1, 1]}},
    {"camera": {"model": "PINHOLE", "width": 1, "height": 1, "params": [1, 1, 1e7]}},
    {"camera": {"model": "PINHOLE", "width": 1, "height": 1, "params": [1] * 13}},
    {"camera": {"model": "PINHOLE", "width": 1, "height": 1}},
    {"contribute": "yes"},
    {"contribute": 1},
    {"contribute": True},
    {"contribute": True, "credit": "A"},
    {"contribute": True, "licence": "CC0-1.0"},
    {"contribute": True, "credit": None, "licence": "CC0-1.0"},
    {"contribute": True, "credit": "", "licence": "CC0-1.0"},
    {"contribute": True, "credit": " A", "licence": "CC0-1.0"},
    {"contribute": True, "credit": "A" * 201, "licence": "CC0-1.0"},
    {"contribute": True, "credit": "A\nB", "licence": "CC0-1.0"},
    {"contribute": True, "credit": "A\x1b[2J", "licence": "CC0-1.0"},
    {"contribute": True, "credit": "A\x9b2J", "licence": "CC0-1.0"},
    {"contribute": True, "credit": ["A"], "licence": "CC0-1.0"},
    {"client_id": "\t"},
    {"options": None},
    {"options": {"inlier": True}},
    {"options": {"maps": [""]}},
    {"options": {"maps": "a"}},
    {"options": {"deadline_ms": 0}},
    {"options": {"deadline_ms": 1e9}},
]


@pytest.mark.parametrize("request_json", GOOD_REQUESTS)
def test_schema_and_server_take_the_same_requests(request_json):
    validator("localise_request").validate(request_json)
    parsed = parse_attachment(LocaliseWireRequest, json.dumps(request_json).encode())
    validator("localise_request").validate(json.loads(parsed.model_dump_json()))


@pytest.mark.parametrize("request_json", BAD_REQUESTS)
def test_schema_and_server_refuse_the_same_requests(request_json):
    assert not validator("localise_request").is_valid(request_json)
    with pytest.raises(RequestError) as caught:
        parse_attachment(LocaliseWireRequest, json.dumps(request_json).encode())
    assert caught.value.code == "BAD_REQUEST"
