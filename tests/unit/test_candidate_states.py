"""What has become of a contributed photo, from its events and the maps that live."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from featuredb.errors import InvalidValueError
from featuredb.store.candidates.states import (
    ANONYMOUS,
    candidate_id_of,
    candidate_of,
    event_order,
    standing_of,
)
from tests.support.contributions import contribution

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def events(text: str) -> list[dict[str, Any]]:
    """ "contributed:Ada used:m1 refused:BLUR" as rows, a minute apart."""
    rows = []
    for i, word in enumerate(text.split()):
        kind, _, detail = word.partition(":")
        row: dict[str, Any] = {
            "candidate_id": "c0",
            "event": kind,
            "happened_at": NOON + timedelta(minutes=i),
            "write_id": f"{i:032x}",
            "event_index": 0,
            "owner": None,
            "map_id": None,
            "reason_code": None,
            "reason": None,
        }
        if kind == "contributed":
            row |= {"owner": "A. Person", "licence": "CC0-1.0", "client_id": None, "sha256": "c0"}
            row |= {"request": json.dumps({"identity": detail or "Ada"}), "answer": "{}"}
            row |= {"size_bytes": 9, "width": 3, "height": 2, "snapshot": 1}
        elif kind in ("used", "confirmed"):
            row["map_id"] = detail
        else:
            row |= {"reason_code": detail, "reason": f"because of {detail}"}
        rows.append(row)
    return rows


@pytest.mark.parametrize(
    ("history", "live", "state"),
    [
        ("contributed", "", "waiting"),
        ("contributed used:m1", "m1", "used"),
        ("contributed used:m1", "", "waiting"),  # the map was retired or rolled back
        ("contributed used:m1 used:m2", "m2", "used"),
        ("contributed used:m1 used:m2", "m1", "used"),
        ("contributed used:m1 used:m2", "m3", "waiting"),
        ("contributed refused:BLUR", "m1", "refused"),
        ("contributed refused:BLUR contributed:Bob", "", "refused"),
        ("contributed refused:BLUR used:m1", "", "waiting"),
        ("contributed refused:BLUR reopened", "", "waiting"),  # as earlier versions wrote
        ("contributed refused:BLUR reopened used:m1", "m1", "used"),
        ("contributed used:m1 reopened", "m1", "waiting"),
        ("contributed used:m1 refused:ALTERED", "m1", "refused"),
        ("contributed withdrawn:OWNER", "", "withdrawn"),
        ("contributed withdrawn:OWNER used:m1", "m1", "withdrawn"),  # a map that was under way
        ("contributed used:m1 withdrawn:OWNER", "m1", "withdrawn"),
        ("contributed withdrawn:OWNER contributed", "", "waiting"),
        ("contributed used:m1 withdrawn:OWNER contributed", "m1", "waiting"),
        ("contributed used:m1 confirmed:m1", "m1", "used"),
        ("contributed used:m1 withdrawn:OWNER confirmed:m1", "m1", "withdrawn"),
        ("contributed used:m1 confirmed:m1", "", "waiting"),
    ],
)
def test_states(history: str, live: str, state: str) -> None:
    assert standing_of(events(history), set(live.split())).state == state


def test_reasons_and_maps_are_told() -> None:
    refused = standing_of(events("contributed refused:BLUR"), ())
    assert (refused.reason_code, refused.reason) == ("BLUR", "because of BLUR")
    used = standing_of(events("contributed used:m2 used:m1 used:m2 used:gone"), {"m1", "m2"})
    assert used.used_by == ("m2", "m1")
    assert standing_of(events("contributed used:gone"), ()).reason == ""


def test_the_same_bytes_by_another_are_noted() -> None:
    rows = events("contributed:Ada contributed:Bob contributed:Ada")
    assert [(c.owner, c.at) for c in candidate_of(rows, ()).contributors] == [
        ("Ada", NOON),
        ("Bob", NOON + timedelta(minutes=1)),
    ]
    candidate = candidate_of(rows, ())
    assert (candidate.owner, candidate.licence, candidate.received_at) == ("Ada", "CC0-1.0", NOON)
    assert (candidate.credit, candidate.request) == ("A. Person", {})


def test_who_gives_a_withdrawn_photo_again_is_its_contributor() -> None:
    rows = events("contributed:Ada contributed:Bob withdrawn:OWNER")
    assert [c.owner for c in candidate_of(rows, ()).contributors] == ["Ada", "Bob"]
    rows += events("contributed:Ada contributed:Ada withdrawn:OWNER contributed:Cleo")[3:]
    assert [c.owner for c in candidate_of(rows, ()).contributors] == ["Cleo"]


@pytest.mark.parametrize("asked", [None, "", "{}", '{"prior": null}', '{"identity": null}'])
def test_a_claimed_name_is_no_owner(asked: str | None) -> None:
    """Rows of before there were identities have nothing but a name that their senders chose."""
    rows = events("contributed contributed")
    for row, name in zip(rows, ("Ada", "Bob"), strict=True):
        row |= {"owner": name, "request": asked}
    (only,) = candidate_of(rows, ()).contributors
    assert (only.owner, only.credit) == (ANONYMOUS, "Ada")


def test_events_sort_by_time_then_as_they_were_given() -> None:
    rows = events("contributed refused:A used:m1")
    rows[1]["happened_at"] = rows[2]["happened_at"]
    rows[1]["write_id"] = rows[2]["write_id"]
    rows[2]["event_index"] = 1
    assert sorted([rows[2], rows[0], rows[1]], key=event_order) == rows


def test_a_photo_is_named_by_its_bytes() -> None:
    assert candidate_id_of(b"abc") == "ba7816bf8f01cfea414140de5dae2223"  # FIPS 180-2, B.1


@pytest.mark.parametrize(
    "wrong",
    [
        {"image": b""},
        {"owner": " "},
        {"credit": ""},
        {"licence": ""},
        {"owner": "x" * 201},
        {"received_at": datetime(2026, 1, 1)},
        {"request": {"x": object()}},
        {"answer": {"x": float("nan")}},
    ],
)
def test_what_is_no_contribution(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValueError, match="Contribution"):
        replace(contribution(), **wrong)


_KINDS = st.sampled_from(
    [
        "contributed",
        "contributed:Bob",
        "used:m1",
        "used:m2",
        "confirmed:m1",
        "refused:X",
        "withdrawn:OWNER",
    ]
)


@given(st.lists(_KINDS, max_size=8), st.sets(st.sampled_from(["m1", "m2"])))
def test_laws_of_states(more: list[str], live: set[str]) -> None:
    rows = events(" ".join(["contributed", *more]))
    standing = standing_of(rows, live)
    # A map that goes away never makes a photo used, refused or withdrawn.
    without = standing_of(rows, ())
    if standing.state == "used":
        assert set(standing.used_by) <= live
        assert standing.used_by
        assert without.state == "waiting"
    else:
        assert without == standing
    # The last word is final for as long as nobody speaks again.
    last = more[-1].split(":")[0] if more else "contributed"
    if last in ("refused", "withdrawn"):
        assert standing.state == last
    # Withdrawn bytes come back only by being given again.
    if "withdrawn:OWNER" in more:
        after = more[len(more) - more[::-1].index("withdrawn:OWNER") :]
        if not after:
            assert standing.state == "withdrawn"
