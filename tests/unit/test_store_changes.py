"""Changes to the rows of `maps`: who is retired with whom, what gives way to what."""

from typing import Any

import pytest

from featuredb.errors import MapNotFoundError, StoreError
from featuredb.store.changes import (
    Change,
    add_maps,
    anchored,
    change_status,
    descendants,
    live_row,
    retire_map,
)


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
    assert change.added is None
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
    assert change.added is not None
    assert [r["map_id"] for r in change.rows] == ["a", "b", "c", "d", "e", "f", "x", "n"]


def test_replacing() -> None:
    same = add_maps([row("a"), row("b")], [row("a", "b")], ["a"])
    assert same.added is None
    assert [(r["map_id"], r["parents"]) for r in same.rows] == [("b", []), ("a", ["b"])]
    other = add_maps([row("a"), row("b")], [row("n")], ["a"])
    assert [(r["map_id"], r["status"]) for r in other.rows] == [
        ("a", "retired"),
        ("b", "active"),
        ("n", "active"),
    ]
    assert other.rows[0]["status_reason"] == "replaced by n"


def test_what_hangs_on_a_replaced_map_is_quarantined_with_the_reason() -> None:
    change = add_maps(FAMILY, [row("c", "a")], ["c"])
    assert change.flagged == ("d", "e", "f")
    status = {r["map_id"]: (r["status"], r["status_reason"]) for r in change.rows}
    assert {m for m, (s, _) in status.items() if s == "quarantined"} == {"d", "e", "f"}
    assert "map c, which placed it, was placed anew" in status["f"][1]
    assert status["a"] == status["b"] == status["c"] == ("active", "")
    assert all(r["status"] == "active" for r in FAMILY), "the old rows are untouched"


def test_children_placed_anew_with_their_parent_and_retired_ones_are_left_alone() -> None:
    rows = [row("a"), row("c", "a"), row("d", "a", status="retired"), row("e", "d"), row("g", "c")]
    change = add_maps(rows, [row("a"), row("c", "a")], ["a", "c"])
    assert change.flagged == ("g",)
    assert [r["status"] for r in change.rows] == ["retired", "active", "quarantined", "active", "active"]
    assert add_maps(change.rows, [row("a")], ["a"]).flagged == ("c",), "g is in quarantine already"


def test_descendants_name_the_ancestor_and_end_in_cycles() -> None:
    assert descendants(FAMILY, ["a"]) == {"c": "a", "d": "a", "e": "a", "f": "a"}
    assert descendants(FAMILY, ["f"]) == {}
    assert descendants([row("p", "q"), row("q", "p")], ["p"]) == {"q": "p"}


def test_a_retired_row_of_the_same_id_gives_way() -> None:
    change = add_maps([row("a", status="retired")], [row("a")], ())
    assert [(r["map_id"], r["status"]) for r in change.rows] == [("a", "active")]
    assert change.added is None


def statuses(change: Change) -> dict[str, str]:
    return {r["map_id"]: r["status"] for r in change.rows}


def test_quarantine_takes_what_stands_on_the_map_alone() -> None:
    change, changed = change_status(FAMILY, ["a"], "quarantined", "doubt")
    assert changed == ["a", "c", "d"]
    assert {m for m, status in statuses(change).items() if status == "quarantined"} == {"a", "c", "d"}
    reasons = {r["map_id"]: r["status_reason"] for r in change.rows}
    assert (reasons["a"], reasons["c"], reasons["e"]) == ("doubt", "doubt (a)", "")
    assert all(r["status"] == "active" for r in FAMILY), "the old rows are untouched"


def test_promotion_needs_a_chain_of_active_parents() -> None:
    rows = [row("a"), row("b", "a", status="quarantined"), row("c", "b", status="quarantined")]
    assert change_status(rows, ["b"], "active", "seen")[1] == ["b"]
    assert change_status(rows, ["c", "b"], "active", "seen")[1] == ["c", "b"]
    with pytest.raises(StoreError, match=r"b is quarantined.*promote the parents first"):
        change_status(rows, ["c"], "active", "seen")
    with pytest.raises(StoreError, match="gone is not there"):
        change_status([row("x", "gone", status="quarantined")], ["x"], "active", "seen")


def test_a_promotion_leaves_others_alone() -> None:
    """x is active on a parent that is not there, as after a hand-made change: not this commit's business."""
    rows = [*FAMILY, row("n", "a", status="quarantined")]
    change, changed = change_status(rows, ["n", "n"], "active", "seen")
    assert changed == ["n"]
    assert {m for m, status in statuses(change).items() if status != "active"} == set()
    assert change.added is None


def test_nothing_to_change_is_no_change() -> None:
    change, changed = change_status(FAMILY, ["a", "b"], "active", "seen")
    assert (changed, change.added) == ([], ())
