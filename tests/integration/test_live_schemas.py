"""The JSON Schemas of live sessions and the program say the same, on messages off the wire."""

import json

import jsonschema
import pytest
from pydantic import BaseModel, ValidationError

from reloc.service.options import ServeOptions
from reloc.wire.query import ErrorCode, RequestError, parse_attachment
from reloc.wire.track import (
    EndReason,
    TrackEvent,
    TrackFrame,
    TrackOpened,
    TrackOpenRequest,
    TrackPose,
)
from schemas import load_schema
from tests.support.live import LENS, jpeg, localiser, wait_until
from tests.support.service import client_of, running_server

MODELS: dict[str, type[BaseModel]] = {
    "track_open": TrackOpenRequest,
    "track_opened": TrackOpened,
    "track_frame": TrackFrame,
    "track_pose": TrackPose,
    "track_event": TrackEvent,
}


def validator(name: str) -> jsonschema.Draft202012Validator:
    schema = load_schema(f"wire/{name}")
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(
        schema, format_checker=jsonschema.Draft202012Validator.FORMAT_CHECKER
    )


@pytest.fixture(scope="module")
def messages() -> dict[str, list[bytes]]:
    """One of each message, as bytes off the wire: name -> list."""
    found: dict[str, list[bytes]] = {"track_pose": [], "track_event": [], "track_opened": [], "status": []}
    with running_server(localiser(), ServeOptions()) as server, client_of(server) as client:
        session = client._session()
        key = "featuredb/town/track/anonymous/*"
        with (
            session.declare_subscriber(
                f"{key}/poses", lambda s: found["track_pose"].append(s.payload.to_bytes())
            ),
            session.declare_subscriber(
                f"{key}/events", lambda s: found["track_event"].append(s.payload.to_bytes())
            ),
            client.track(LENS) as live,
        ):
            found["track_opened"].append(live.opened.model_dump_json().encode())
            live.send(b"no image", 0.0)
            wait_until(lambda: bool(live.refusals), "the refusal")
            state, number = "", 0
            while state != "tracking":
                number += 1
                live.send(jpeg(0), number / 30.0)
                pose = live.next(30.0)
                assert pose is not None
                state = pose.state
            (status,) = session.get("featuredb/town/status", timeout=30.0)
            assert status.ok is not None
            found["status"].append(status.ok.payload.to_bytes())
            server.close()
            wait_until(lambda: any(b'"ended"' in m for m in found["track_event"]), "the end")
    return found


def test_every_message_off_the_wire_is_valid_by_its_schema(messages: dict[str, list[bytes]]) -> None:
    for name, found in messages.items():
        assert found, name
        for message in found:
            validator(name).validate(json.loads(message))


def test_the_messages_cover_the_kinds(messages: dict[str, list[bytes]]) -> None:
    assert {json.loads(m)["state"] for m in messages["track_pose"]} == {"lost", "relocalised", "tracking"}
    assert {json.loads(m)["type"] for m in messages["track_event"]} == {"refused", "ended"}
    live = json.loads(messages["status"][0])["live"]
    assert live["open"] == 1
    assert live["frames"]["refused"] == {"BAD_IMAGE": 1}


def test_schemas_and_models_name_the_same_fields_and_codes() -> None:
    for name, model in MODELS.items():
        assert set(load_schema(f"wire/{name}")["properties"]) == set(model.model_fields), name
    codes = set(load_schema("wire/track_event")["properties"]["code"]["enum"])
    assert {reason.value for reason in EndReason} < codes
    assert codes - {reason.value for reason in EndReason} < {code.value for code in ErrorCode}


@pytest.mark.parametrize("field", ["position", "utm", "covariance", "accuracy", "camera", "map_id"])
def test_schema_and_reader_both_refuse_half_a_pose(messages: dict[str, list[bytes]], field: str) -> None:
    by_state = {json.loads(m)["state"]: json.loads(m) for m in messages["track_pose"]}
    lost, known = by_state["lost"], by_state["tracking"]
    for broken in ({**known, field: None}, {**lost, field: known[field]}, {**lost, "detail": ""}):
        assert not validator("track_pose").is_valid(broken)
        with pytest.raises(ValidationError):
            TrackPose.model_validate_json(json.dumps(broken))


GOOD = [
    ("track_open", {}),
    ("track_open", {"camera": None, "prior": {"lat": 1, "lon": 2, "sigma_m": 5}}),
    ("track_open", {"camera": {"model": "PINHOLE", "width": 4, "height": 3, "params": [1, 1, 1, 1]}}),
    ("track_frame", {"sequence": 0, "time_s": 0}),
    ("track_frame", {"sequence": 2**53 - 1, "time_s": -1.5}),
]
BAD = [
    ("track_open", []),
    ("track_open", {"maps": ["a"]}),
    ("track_open", {"prior": {"lat": 91, "lon": 2, "sigma_m": 5}}),
    ("track_frame", {}),
    ("track_frame", {"sequence": 1}),
    ("track_frame", {"time_s": 1}),
    ("track_frame", {"sequence": -1, "time_s": 0}),
    ("track_frame", {"sequence": 2**53, "time_s": 0}),
    ("track_frame", {"sequence": 1.5, "time_s": 0}),
    ("track_frame", {"sequence": True, "time_s": 0}),
    ("track_frame", {"sequence": 1, "time_s": "0"}),
    ("track_frame", {"sequence": 1, "time_s": 1e13}),
    ("track_frame", {"sequence": 1, "time_s": 0, "camera": None}),
]


@pytest.mark.parametrize(("name", "message"), GOOD)
def test_schema_and_server_take_the_same(name: str, message: object) -> None:
    validator(name).validate(message)
    model = MODELS[name]
    assert issubclass(model, TrackOpenRequest | TrackFrame)
    parsed = parse_attachment(model, json.dumps(message).encode())
    validator(name).validate(json.loads(parsed.model_dump_json()))


@pytest.mark.parametrize(("name", "message"), BAD)
def test_schema_and_server_refuse_the_same(name: str, message: object) -> None:
    assert not validator(name).is_valid(message)
    model = MODELS[name]
    assert issubclass(model, TrackOpenRequest | TrackFrame)
    with pytest.raises(RequestError) as caught:
        parse_attachment(model, json.dumps(message).encode())
    assert caught.value.code == "BAD_REQUEST"
