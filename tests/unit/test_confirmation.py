"""Who confirms whom: gates of confirmation that fire and that do not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from featuredb.maps.feature_map import FeatureMap
from featuredb.store.candidates.states import ANONYMOUS, OPERATOR
from ingest.growth.trust.confirmation import (
    Confirmation,
    OutsidePhoto,
    Source,
    confirm,
    independent,
)
from tests.support.scene_strip import sources_of, strip_map

_KNOWN = ("anna", "ben", "carl", "eve")  # have a record, where a test does not say otherwise


def _reason(found: Confirmation) -> str:
    """Why it is not confirmed; "" if it is."""
    return "" if found.gate.passes else found.gate.reason


def _owned(owners: Sequence[str], **more: object) -> FeatureMap:
    return strip_map("m", 40.0, owners=owners, **more)  # type: ignore[arg-type]


def _confirm(
    feature_map: FeatureMap,
    corroborating: Sequence[OutsidePhoto] = (),
    *,
    on_record: Sequence[str] = _KNOWN,
    trusted: Sequence[str] = (),
    against: Sequence[tuple[Source, str]] = (),
) -> Confirmation:
    sources = sources_of(feature_map, on_record=on_record, trusted=trusted)
    contradicting = [
        OutsidePhoto(name="w", source=s, center=np.zeros(3), points=np.arange(200), contradicts=said)
        for s, said in against
    ]
    return confirm(feature_map, sources, [*corroborating, *contradicting])


def test_two_owners_on_record_confirm_each_other() -> None:
    feature_map = _owned(["anna", "ben"])
    found = _confirm(feature_map)
    assert found.gate.passes
    confirmed = {image.owner for image in feature_map.images if image.image_id in found.confirmed}
    assert confirmed == {"anna", "ben"}
    assert len(found.confirmed) == 8
    assert "8 photos confirmed by 2 owners" in found.gate.message


def test_one_owner_does_not_confirm_himself() -> None:
    """Whatever names are given, and whatever days and cameras his files tell."""
    found = _confirm(_owned(["anna"], days=(1, 2)))
    assert not found.gate.passes
    assert _reason(found) == "ONE_SOURCE"
    assert found.confirmed == found.earned == ()


@pytest.mark.parametrize("on_record", [(), ("stranger 0",)])
def test_ten_identities_without_a_record_confirm_nothing(on_record: Sequence[str]) -> None:
    """Nor do they together with one that has a record: it would be one person's word still."""
    ten = [f"stranger {k}" for k in range(10)]
    found = _confirm(_owned(ten, cameras=20), on_record=on_record)
    assert _reason(found) == "ONE_SOURCE"
    assert found.confirmed == found.earned == ()
    assert _confirm(_owned(ten, cameras=20), on_record=ten).gate.passes


def test_all_without_a_certificate_are_one() -> None:
    assert _reason(_confirm(_owned([ANONYMOUS]))) == "ONE_SOURCE"
    assert _reason(_confirm(_owned([ANONYMOUS, "anna"]))) == "ONE_SOURCE"


def test_what_makes_a_record() -> None:
    """A proven photo of the same, or photos of two others on record; a copy of a proven photo does not."""
    alone = _owned(["dora", "anna"])
    assert _confirm(alone).earned == ()
    two = _confirm(_owned(["dora", "anna", "ben"]))
    dora = [i.image_id for i in _owned(["dora", "anna", "ben"]).images if i.owner == "dora"]
    assert set(two.earned) >= set(dora)
    mine = _owned(["dora"])
    outside = _outside(mine, OPERATOR)
    by_operator = _confirm(mine, [outside], on_record=())
    assert by_operator.earned == tuple(i.image_id for i in mine.images)
    copied = replace(outside, center=mine.images[0].cam_from_local.center)
    assert _confirm(mine, [outside, copied], on_record=()).earned == by_operator.earned[1:]
    assert _confirm(mine, on_record=(), trusted=("dora",)).earned == by_operator.earned


def test_photos_of_the_operator_and_of_whom_he_trusts_need_nobody() -> None:
    assert _confirm(_owned(["survey"]), on_record=()).gate.passes
    assert _confirm(_owned(["anna"]), on_record=(), trusted=("anna",)).gate.passes
    assert not _confirm(_owned(["eve"]), on_record=(), trusted=("anna",)).gate.passes


def test_photos_that_share_no_points_confirm_nothing() -> None:
    """Two owners in one map, and none of their photos show the same."""
    feature_map = _owned(["anna", "ben"])
    seen = feature_map.observations
    west = feature_map.points_local()[seen.point_index, 0] < 40.0
    anna = seen.image_id % 2 == 0
    keep = np.flatnonzero(west == anna)
    parts = {name: getattr(seen, name)[keep] for name in type(seen).__slots__}
    apart = replace(feature_map, observations=type(seen)(**parts))
    assert _reason(_confirm(apart)) == "ONE_SOURCE"


def test_the_same_picture_given_by_two_is_one_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every second photo is the one before it, sent again by someone else: no parallax."""
    feature_map = _owned(["anna", "eve"])
    images = list(feature_map.images)
    for k in range(1, 8, 2):
        images[k] = replace(images[k], cam_from_local=images[k - 1].cam_from_local)
    copied = replace(feature_map, images=tuple(images))
    pair_only = replace(
        copied,
        images=tuple(images[:2]),
        observations=type(copied.observations)(
            **{
                name: getattr(copied.observations, name)[copied.observations.image_id < 2]
                for name in type(copied.observations).__slots__
            }
        ),
    )
    assert _reason(_confirm(pair_only)) == "ONE_SOURCE"
    monkeypatch.setattr("ingest.growth.trust.confirmation._LEAST_PARALLAX", 0.0)
    assert _reason(_confirm(pair_only)) == "FEW_PAIRS"


def test_one_pair_at_the_rim_confirms_no_map() -> None:
    """Ben's one photo looks at points that only one of Anna's seven shows."""
    feature_map = _owned(["anna"])
    images = list(feature_map.images)
    images[7] = replace(images[7], owner="ben")
    seen = feature_map.observations
    shared = np.flatnonzero(seen.image_id == 0)[:40]
    keep = (seen.image_id != 7) & ~np.isin(seen.point_index, seen.point_index[shared]) | (
        np.isin(seen.point_index, seen.point_index[shared]) & np.isin(seen.image_id, [0, 7])
    )
    parts = {name: getattr(seen, name)[keep] for name in type(seen).__slots__}
    found = _confirm(replace(feature_map, images=tuple(images), observations=type(seen)(**parts)))
    assert found.confirmed == (0, 7)
    assert _reason(found) == "FEW_PAIRS"


def test_one_photo_confirms_nothing_alone() -> None:
    """Eve's photo shows what all nineteen of Anna's do."""
    one = _owned(["eve"] + 19 * ["anna"], cameras=20)
    found = _confirm(one)
    assert len(found.confirmed) == 20
    assert _reason(found) == "FEW_PAIRS"
    assert "confirmed by one photo alone" in found.gate.message
    assert _reason(_confirm(_owned(["eve", "anna"], cameras=2))) == "FEW_PAIRS"
    assert _confirm(_owned(["eve", "eve"] + 18 * ["anna"], cameras=20)).gate.passes
    assert _confirm(_owned(["eve", "anna", "ben"], cameras=3)).gate.passes
    assert _confirm(one, trusted=("anna",)).gate.passes


def _outside(feature_map: FeatureMap, owner: str, points: int = 200) -> OutsidePhoto:
    return OutsidePhoto(
        name="w",
        source=sources_of(on_record=_KNOWN).of_owner(owner),
        center=np.array([20.0, -50.0, 30.0]),
        points=np.arange(points, dtype=np.int64),
    )


def test_two_witnesses_of_other_owners_confirm_and_one_does_not() -> None:
    feature_map = _owned(["anna"])
    assert _reason(_confirm(feature_map, [_outside(feature_map, "ben")])) == "FEW_PAIRS"
    two = [_outside(feature_map, "ben"), _outside(feature_map, "carl")]
    assert _confirm(feature_map, two).gate.passes
    found = _confirm(feature_map, [_outside(feature_map, "anna")])
    assert _reason(found) == "ONE_SOURCE"
    few = _confirm(feature_map, [_outside(feature_map, "ben", points=5)])
    assert not few.gate.passes


def test_photos_from_outside_that_contradict_count_against_pairs() -> None:
    feature_map = _owned(["anna", "ben"])
    pairs = _confirm(feature_map).gate.figure
    assert pairs == 4.0
    proven = [(Source(owner=OPERATOR, proven=True), "a is 5.0 m off")]
    assert _confirm(feature_map, against=proven * 2).gate.passes
    found = _confirm(feature_map, against=proven * 3)
    assert _reason(found) == "CONTRADICTED"
    assert "a is 5.0 m off" in found.gate.message
    # One owner on record may lie with all photos, and counts once; three owners count.
    lies = [(Source(owner=name, on_record=True), "b") for name in ("carl", "eve", "dan")]
    assert _confirm(feature_map, against=lies[:1] * 9).gate.passes
    assert _reason(_confirm(feature_map, against=lies)) == "CONTRADICTED"
    assert _confirm(_owned(["anna"]), trusted=("anna",)).gate.passes
    assert _reason(_confirm(_owned(["anna"]), trusted=("anna",), against=proven)) == "CONTRADICTED"


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        (Source(owner="x", on_record=True), Source(owner="y", on_record=True), True),
        (Source(owner="x", on_record=True), Source(owner="y"), False),
        (Source(owner="x"), Source(owner="y"), False),
        (Source(owner="x", proven=True), Source(owner="y"), True),
        (Source(owner="x", proven=True, on_record=True), Source(owner="x", proven=True), False),
    ],
)
def test_independence(a: Source, b: Source, expected: bool) -> None:
    assert independent(a, b) is expected
    assert independent(b, a) is expected


def test_who_is_asked_about_a_map() -> None:
    """Those whose word counts, of another owner; strangers speak neither for it nor against it."""
    own = [Source(owner="x"), Source(owner="y")]
    assert Source(owner="x", on_record=True).speaks_to(own)
    assert Source(owner="z", proven=True).speaks_to(own)
    assert not Source(owner="z").speaks_to(own)
    assert not Source(owner="x", proven=True).speaks_to(own[:1])
