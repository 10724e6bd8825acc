"""Changes to the rows of `maps`: who is retired with whom, what gives way to what."""

from typing import Any

import pytest

from featuredb.errors import MapNotFoundError, StoreError
from featuredb.store.changes import add_maps, anchored, live_row, retire_map


def row(map_id: str, *parents: str, status: str = "active") -> dict[str, Any]:
    return {"map_id": map_id, "parents": list(parents), "status": status, "status_reason": ""}


# a and b are anchors; c hangs on a; d on c; e on c and b; f on d and e; x on a map that is not there.
FAMILY = [
    row("a"),
    row("b"),
    row("c", "a"),
    row("d", "c"),
    row("e", "c", "b"),
    row("f", "d", "e"),
    row("x", "?"),
]


@pytest.mark.parametrize(
    ("map_id", "retired"),
    [
        ("a", ["a", "c", "d"]),
        ("b", ["b"]),
        ("c", ["c", "d"]),
        ("d", ["d"]),
        ("e", ["e"]),
        ("f", ["f"]),
        ("x", ["x"]),
    ],
)
def test_retired_are_those_with_no_other_chain_to_an_anchor(map_id: str, retired: list[str]) -> None:
    change, found = retire_map(FAMILY, map_id, "wrong")
    assert found == retired
    assert [r["map_id"] for r in change.rows if r["status"] == "retired"] == sorted(retired)
    assert not change.only_adds
    assert all(r["status"] == "active" for r in FAMILY), "the old rows are untouched"


def test_both_anchors_gone_take_everything_that_was_anchored() -> None:
    change, _ = retire_map(FAMILY, "a", "wrong")
    change, found = retire_map(change.rows, "b", "wrong, too")
    assert found == ["b", "e", "f"]
    assert anchored(change.rows) == set()
    assert live_row(change.rows, "x") is not None


def test_a_cycle_of_parents_is_not_anchored() -> None:
    rows = [row("a"), row("p", "q"), row("q", "p")]
    assert anchored(rows) == {"a"}
    assert retire_map(rows, "p", "cycle")[1] == ["p"]


def test_retiring_needs_a_map_and_a_reason() -> None:
    with pytest.raises(MapNotFoundError, match="nowhere"):
        retire_map(FAMILY, "nowhere", "wrong")
    with pytest.raises(StoreError, match="reason"):
        retire_map(FAMILY, "a", "  ")


def test_adding_appends_and_touches_nothing() -> None:
    change = add_maps(FAMILY, [row("n")], ())
    assert change.only_adds
    assert [r["map_id"] for r in change.rows] == ["a", "b", "c", "d", "e", "f", "x", "n"]


def test_replacing() -> None:
    same = add_maps([row("a"), row("b")], [row("a", "b")], ["a"])
    assert not same.only_adds
    assert [(r["map_id"], r["parents"]) for r in same.rows] == [("b", []), ("a", ["b"])]
    other = add_maps([row("a"), row("b")], [row("n")], ["a"])
    assert [(r["map_id"], r["status"]) for r in other.rows] == [
        ("a", "retired"),
        ("b", "active"),
        ("n", "active"),
    ]
    assert other.rows[0]["status_reason"] == "replaced by n"


def test_a_retired_row_of_the_same_id_gives_way() -> None:
    change = add_maps([row("a", status="retired")], [row("a")], ())
    assert [(r["map_id"], r["status"]) for r in change.rows] == [("a", "active")]
    assert not change.only_adds
