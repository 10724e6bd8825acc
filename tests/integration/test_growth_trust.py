"""Promotion and canaries on databases of small maps whose truth is known."""

import hashlib
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import StoreError
from featuredb.store import Database
from ingest.growth.place.map_images import features_and_points
from ingest.growth.trust.canaries import CanaryRun, own_canaries, run_canaries
from ingest.growth.trust.confirmation import NewPhotos
from ingest.growth.trust.promotion import Promotion, promote_by_hand, promote_confirmed
from ingest.growth.values import GrowthOptions, GrowthPhotos
from reloc.localise.localise import localise_features
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from tests.support.scene_strip import (
    ANCHOR,
    DESCRIPTORS,
    POINTS,
    add,
    database_of,
    east,
    put_on_record,
    strip_map,
)
from tests.support.scenes import (
    CAMERA,
    box_points,
    looking_at,
    pixels_inside,
    query_features,
    random_descriptors,
    ring,
    scene_map,
)


def _promoted(database: Database, trusted: tuple[str, ...] = ()) -> dict[str, Promotion]:
    work = Path(tempfile.mkdtemp(dir=database.url))
    found = promote_confirmed(database, Localiser.open(database), GrowthOptions(trusted=trusted), work, _NONE)
    return {outcome.map_id: outcome for outcome in found}


def _status(database: Database, map_id: str) -> str:
    return database.snapshot().get(map_id).status


_NONE = NewPhotos(given=GrowthPhotos(), rows=(), localised={})


def test_a_map_of_two_owners_is_promoted(tmp_path: Path) -> None:
    database = database_of(
        tmp_path, ANCHOR, strip_map("m", 50.0, owners=["anna", "ben"], parents=[ANCHOR], seed=1)
    )
    outcome = _promoted(database)["m"]
    assert outcome.promoted
    assert _status(database, "m") == "active"
    assert "3 owners" in database.snapshot().get("m").status_reason  # the survey sees it, too
    assert all(gate["passes"] for gate in outcome.gates.values())
    assert {"confirmation", "canaries"} == set(outcome.gates)


def test_a_map_of_one_owner_waits_until_another_one_sees_it(tmp_path: Path) -> None:
    """Anna's map reaches beyond the anchor; Ben's map, quarantined too, shows the same from elsewhere."""
    mine = strip_map("m", 85.0, owners=["anna"], parents=[ANCHOR], seed=1)
    database = database_of(tmp_path, ANCHOR, mine)
    put_on_record(database, "anna", "ben")
    outcome = _promoted(database)["m"]
    assert not outcome.promoted
    assert outcome.reason_code == "ONE_SOURCE"
    assert _status(database, "m") == "quarantined"
    add(database, strip_map("n", 88.0, owners=["ben"], parents=[ANCHOR], seed=2))
    outcomes = _promoted(database)
    assert outcomes["m"].promoted
    assert outcomes["n"].promoted


def test_the_same_question_is_not_asked_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine = strip_map("m", 85.0, owners=["anna"], parents=[ANCHOR], seed=1)
    database, work = database_of(tmp_path, ANCHOR, mine), tmp_path / "work"
    put_on_record(database, "anna")

    def ask() -> Promotion:
        return promote_confirmed(database, Localiser.open(database), GrowthOptions(), work, _NONE)[0]

    first = ask()
    with monkeypatch.context() as patch:
        patch.setattr("ingest.growth.trust.promotion.corroborate", None)
        assert ask() == first
    add(database, strip_map("n", 88.0, owners=["ben"], parents=[ANCHOR], seed=2))
    assert not ask().promoted  # something new has come, of somebody whose word does not count yet
    put_on_record(database, "ben")
    assert ask().promoted


def test_photos_of_the_anchor_bear_witness_to_a_map_that_lies_on_it(tmp_path: Path) -> None:
    mine = strip_map("m", 22.0, owners=["anna"], parents=[ANCHOR], seed=1)
    assert _promoted(database_of(tmp_path, ANCHOR, mine))["m"].promoted


def test_a_map_that_has_known_photos_elsewhere_is_contradicted(tmp_path: Path) -> None:
    """Two owners agree on it, and it lies five metres from where the anchor's photos are."""
    wrong = strip_map("m", 30.0, owners=["anna", "eve"], parents=[ANCHOR], move=east(5.0), seed=1)
    database = database_of(tmp_path, ANCHOR, wrong)
    put_on_record(database, "anna", "eve")
    outcome = _promoted(database)["m"]
    assert not outcome.promoted
    assert outcome.reason_code == "CONTRADICTED"
    assert "5.0" in outcome.reason


def test_a_copy_of_a_block_elsewhere_is_refused_by_canaries(tmp_path: Path) -> None:
    """The anchor's block is claimed 500 m away, by two owners who agree."""
    copy = strip_map("m", 20.0, owners=["anna", "eve"], parents=[ANCHOR], move=east(500.0), seed=1)
    database = database_of(tmp_path, ANCHOR, copy)
    put_on_record(database, "anna", "eve")
    before = _answer(database, 20.0)
    outcome = _promoted(database)["m"]
    assert not outcome.promoted
    assert outcome.reason_code == "CANARY"
    assert _answer(database, 20.0) == before
    # Forced in by hand it does harm; retired, the earlier answers are back bit for bit.
    refused = promote_by_hand(database, "m", "looks fine to me", force=False)
    assert not refused.promoted
    assert refused.reason_code == "CANARY"
    assert promote_by_hand(database, "m", "I insist", force=True).promoted
    assert _answer(database, 20.0) != before
    database.retire("m", "it was wrong")
    assert _answer(database, 20.0) == before


def _answer(database: Database, at_east_m: float) -> tuple[object, ...]:
    """What a stranger's photo gets, as bytes."""
    rng = np.random.default_rng(77)
    pose = looking_at(np.array([at_east_m + 12.0, -30.0, 40.0]), np.array([at_east_m, 2.0, 3.0]))
    pixels, inside = pixels_inside(CAMERA, pose, POINTS)
    localiser = Localiser.open(database)
    areas = list(localiser.areas)
    features = query_features(
        rng, pixels[inside], DESCRIPTORS[inside], fingerprint=areas[0].area.extractor_fingerprint
    )
    result = localise_features(features, LocaliseRequest(camera=CAMERA), areas).result
    if result.pose is None:
        return (result.reason, result.inliers)
    pose_bytes = hashlib.sha256(
        result.pose.utm.tobytes() + result.pose.cam_from_utm_xyzw.tobytes() + result.pose.covariance.tobytes()
    ).hexdigest()
    return (result.reason, result.inliers, result.pose.map_ids, pose_bytes)


@pytest.mark.parametrize("more", [None, "m"])
def test_own_canaries_are_right_while_nothing_is_wrong(tmp_path: Path, more: str | None) -> None:
    database = database_of(
        tmp_path, ANCHOR, strip_map("m", 45.0, owners=["anna", "ben"], parents=[ANCHOR], seed=1)
    )
    before = Localiser.open(database)
    after = Localiser.open(database, previous=before, also=[more] if more else [])
    new = [database.snapshot().load_map("m")]
    run = run_canaries(database, before, after, new if more else [])
    assert run.checks
    assert all(check.before == "right" and check.after == "right" for check in run.checks)
    assert run.regressions == ()
    assert "no known queries" in run.note


def test_an_image_need_not_show_what_a_new_map_adds_around_its_points(tmp_path: Path) -> None:
    """A map of few points in one corner of its photos; a new one has the whole of what they look at."""
    rng = np.random.default_rng(5)
    corner, everything = box_points(rng, 120), box_points(rng, 1500)
    corner[:, :2] = np.abs(corner[:, :2])
    anchor, more = (
        scene_map(
            points=points,
            descriptors=random_descriptors(rng, len(points)),
            poses=ring(6),
            map_id=map_id,
            fingerprint=ANCHOR.extractor_fingerprint,
        )
        for map_id, points in (("A", corner), ("m", everything))
    )
    database = database_of(tmp_path, anchor, replace(more, status="quarantined"))
    before = Localiser.open(database)
    after = Localiser.open(database, previous=before, also=["m"])
    run = run_canaries(database, before, after, [more])
    assert [check.before for check in run.checks] == ["right"] * 6
    assert run.regressions == ()


def test_images_of_maps_by_another_extractor_are_not_asked(tmp_path: Path) -> None:
    """No query finds anything in such a map, and to ask there is an error."""
    older = replace(strip_map("B", 150.0, owners=["survey"], seed=3), extractor_fingerprint="older")
    database = database_of(tmp_path, ANCHOR, older)
    localiser = Localiser.open(database)
    run = run_canaries(database, localiser, localiser, [])
    assert {check.name.rpartition(" ")[2] for check in run.checks} == {"A"}
    assert run.note.endswith("; 1 maps of another extractor are not asked")


def test_canaries_are_the_same_in_every_run(tmp_path: Path) -> None:
    database = database_of(tmp_path, ANCHOR, strip_map("B", 150.0, owners=["survey"], seed=3))
    localiser = Localiser.open(database)
    chosen = own_canaries(database, localiser, [strip_map("m", 25.0, seed=1)])
    again = own_canaries(database, Localiser.open(database), [strip_map("m", 25.0, seed=1)])
    assert [(m.map_id, i.name) for m, i in chosen] == [(m.map_id, i.name) for m, i in again]
    assert [m.map_id for m, _ in chosen] == ["A"] * 8 + ["B"] * 4
    features = features_and_points(*chosen[0])[0]
    assert len(features) > 60
    assert features.width == CAMERA.width


def test_maps_that_are_held_back_are_not_examined(tmp_path: Path) -> None:
    owners = ["anna", "ben"]
    quarantined = strip_map("q", 60.0, owners=["anna"], parents=[ANCHOR], seed=1)
    database = database_of(
        tmp_path,
        ANCHOR,
        quarantined,
        strip_map("far", 40.0, owners=owners, parents=[ANCHOR], seed=2, drift_m=0.9),
        strip_map("orphan", 85.0, owners=owners, parents=[quarantined], seed=3),
    )
    outcomes = _promoted(database)
    assert outcomes["far"].reason_code == "DRIFT_BUDGET"
    assert outcomes["orphan"].reason_code == "NO_PARENT"


def test_by_hand_a_good_map_needs_no_confirmation(tmp_path: Path) -> None:
    database = database_of(tmp_path, ANCHOR, strip_map("m", 45.0, owners=["anna"], parents=[ANCHOR], seed=1))
    outcome = promote_by_hand(database, "m", "I know Anna", force=False)
    assert outcome.promoted
    assert "I know Anna" in database.snapshot().get("m").status_reason
    assert promote_by_hand(database, "m", "again", force=False).promoted


def test_a_trusted_owner_is_promoted_alone(tmp_path: Path) -> None:
    mine = strip_map("m", 85.0, owners=["anna"], parents=[ANCHOR], seed=1)
    assert _promoted(database_of(tmp_path, ANCHOR, mine), trusted=("anna",))["m"].promoted


def test_what_is_retired_is_promoted_by_hand_alone_and_with_a_reason(tmp_path: Path) -> None:
    mine = strip_map("mine", 45.0, owners=["anna"], parents=[ANCHOR], seed=1)
    database = database_of(tmp_path, ANCHOR, mine)
    database.retire("mine", "wrong")
    assert _promoted(database) == {}
    with pytest.raises(StoreError, match="map mine is retired"):
        database.set_status(["mine"], "active", "again")
    with pytest.raises(StoreError, match="promote mi: expected a reason"):
        promote_by_hand(database, "mi", " ", force=True)
    assert database.snapshot().get("mine").status == "retired"
    assert promote_by_hand(database, "mi", "it was right", force=False).promoted
    assert database.snapshot().get("mine").status == "active"


def test_a_run_of_canaries_says_what_regressed() -> None:
    assert "0 canaries answered as before" in CanaryRun(checks=(), note="none").gate.message
