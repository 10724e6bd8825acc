"""Who confirms whom: gates of confirmation that fire and that do not."""

from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from featuredb.maps.feature_map import FeatureMap
from ingest.growth.trust.confirmation import (
    Confirmation,
    ConfirmationOptions,
    CorroboratingImage,
    Source,
    confirm,
    independent,
)
from tests.support.scene_strip import strip_map

_OPTIONS = ConfirmationOptions()


def _reason(found: Confirmation) -> str:
    """Why it is not confirmed; "" if it is."""
    return "" if found.gate.passes else found.gate.reason


def _owned(owners: list[str], **more: object) -> FeatureMap:
    return strip_map("m", 40.0, owners=owners, **more)  # type: ignore[arg-type]


def test_two_owners_of_one_place_confirm_each_other() -> None:
    found = confirm(_owned(["anna", "ben"]), _OPTIONS)
    assert found.gate.passes
    assert {s.owner for s in found.sources} == {"anna", "ben"}
    assert len(found.confirmed) == 8
    assert "8 photos confirmed by 2 sources" in found.message


def test_one_owner_does_not_confirm_himself() -> None:
    found = confirm(_owned(["anna"], days=(1, 2)), _OPTIONS)
    assert not found.gate.passes
    assert _reason(found) == "ONE_SOURCE"
    assert found.confirmed == ()


def test_another_day_is_enough_where_it_is_asked_so() -> None:
    found = confirm(_owned(["anna"], days=(1, 2)), replace(_OPTIONS, independent_by="any"))
    assert found.gate.passes
    same = confirm(_owned(["anna"], days=(1,)), replace(_OPTIONS, independent_by="any"))
    assert _reason(same) == "ONE_SOURCE"


def test_a_trusted_owner_needs_nobody() -> None:
    found = confirm(_owned(["anna"]), replace(_OPTIONS, trusted_owners=("anna",)))
    assert found.gate.passes
    assert not confirm(_owned(["eve"]), replace(_OPTIONS, trusted_owners=("anna",))).gate.passes


def test_photos_that_share_no_points_confirm_nothing() -> None:
    """Two owners in one map, and none of their photos show the same."""
    feature_map = _owned(["anna", "ben"])
    seen = feature_map.observations
    west = feature_map.points_local()[seen.point_index, 0] < 40.0
    anna = seen.image_id % 2 == 0
    keep = np.flatnonzero(west == anna)
    parts = {name: getattr(seen, name)[keep] for name in type(seen).__slots__}
    apart = replace(feature_map, observations=type(seen)(**parts))
    assert _reason(confirm(apart, _OPTIONS)) == "ONE_SOURCE"


def test_the_same_picture_given_by_two_is_one_source() -> None:
    """Every second photo is the one before it, sent again by someone else: no parallax."""
    feature_map = _owned(["anna", "eve"])
    images = list(feature_map.images)
    for k in range(1, 8, 2):
        images[k] = replace(images[k], cam_from_local=images[k - 1].cam_from_local)
    copied = replace(feature_map, images=tuple(images))
    alone = replace(_OPTIONS, min_parallax=0.0)
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
    assert _reason(confirm(pair_only, alone)) == "FEW_PAIRS"
    assert _reason(confirm(pair_only, _OPTIONS)) == "ONE_SOURCE"


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
    found = confirm(replace(feature_map, images=tuple(images), observations=type(seen)(**parts)), _OPTIONS)
    assert found.confirmed == (0, 7)
    assert _reason(found) == "FEW_PAIRS"


def test_one_photo_confirms_nothing_alone() -> None:
    """Eve's photo shows what all nineteen of Anna's do."""
    one = _owned(["eve"] + 19 * ["anna"], cameras=20)
    found = confirm(one, _OPTIONS)
    assert len(found.confirmed) == 20
    assert _reason(found) == "FEW_PAIRS"
    assert "confirmed by one photo alone" in found.message
    assert _reason(confirm(_owned(["eve", "anna"], cameras=2), _OPTIONS)) == "FEW_PAIRS"
    assert confirm(_owned(["eve", "eve"] + 18 * ["anna"], cameras=20), _OPTIONS).gate.passes
    assert confirm(_owned(["eve", "anna", "ben"], cameras=3), _OPTIONS).gate.passes
    assert confirm(one, replace(_OPTIONS, trusted_owners=("anna",))).gate.passes


def _outside(feature_map: FeatureMap, owner: str, points: int = 200) -> CorroboratingImage:
    return CorroboratingImage(
        name="w",
        source=Source(owner=owner),
        center=np.array([20.0, -50.0, 30.0]),
        points=np.arange(points, dtype=np.int64),
    )


def test_two_witnesses_of_other_owners_confirm_and_one_does_not() -> None:
    feature_map = _owned(["anna"])
    assert _reason(confirm(feature_map, _OPTIONS, [_outside(feature_map, "ben")])) == "FEW_PAIRS"
    two = [_outside(feature_map, "ben"), _outside(feature_map, "carl")]
    assert confirm(feature_map, _OPTIONS, two).gate.passes
    found = confirm(feature_map, _OPTIONS, [_outside(feature_map, "anna")])
    assert _reason(found) == "ONE_SOURCE"
    assert found.corroborating == ()
    few = confirm(feature_map, _OPTIONS, [_outside(feature_map, "ben", points=5)])
    assert not few.gate.passes


def test_photos_from_outside_that_contradict_count_against_pairs() -> None:
    feature_map = _owned(["anna", "ben"])
    pairs = confirm(feature_map, _OPTIONS).gate.figure
    assert pairs == 4.0
    assert confirm(feature_map, _OPTIONS, against=["a", "b"]).gate.passes
    found = confirm(feature_map, _OPTIONS, against=["a is 5.0 m off", "b", "c"])
    assert _reason(found) == "CONTRADICTED"
    assert "a is 5.0 m off" in found.message
    trusted = replace(_OPTIONS, trusted_owners=("anna",))
    assert confirm(_owned(["anna"]), trusted).gate.passes
    assert _reason(confirm(_owned(["anna"]), trusted, against=["a"])) == "CONTRADICTED"


@pytest.mark.parametrize(
    ("a", "b", "by", "expected"),
    [
        (Source(owner="x"), Source(owner="y"), "owner", True),
        (Source(owner="x", camera="c", day=date(2026, 1, 1)), Source(owner="x", camera="d"), "owner", False),
        (Source(owner="x", camera="c"), Source(owner="x", camera="d"), "any", True),
        (Source(camera="c"), Source(camera="d"), "owner", True),
        (Source(owner="x", camera="c"), Source(camera="c"), "owner", False),
        (Source(day=date(2026, 1, 1)), Source(day=date(2026, 1, 2)), "owner", True),
        (Source(), Source(), "any", False),
    ],
)
def test_independence(a: Source, b: Source, by: str, expected: bool) -> None:
    assert independent(a, b, by) is expected  # type: ignore[arg-type]
    assert independent(b, a, by) is expected  # type: ignore[arg-type]
