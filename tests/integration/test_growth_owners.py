"""Whose word counts: owners by identity, what makes their record, and how a community begins."""

import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from featuredb.maps.feature_map import FeatureMap, MapMethod, MapStatus
from featuredb.store import Database
from featuredb.store.candidates.photos import list_candidates, read_owners, withdraw
from featuredb.store.candidates.states import ANONYMOUS, OPERATOR
from featuredb.store.changes import IMPORTED
from featuredb.store.verify import verify
from ingest.growth.trust.canaries import CanaryCheck, CanaryRun
from ingest.growth.trust.confirmation import NewPhotos
from ingest.growth.trust.promotion import Promotion, promote_by_hand, promote_confirmed
from ingest.growth.values import GrowthOptions, GrowthPhotos
from reloc.localiser import Localiser
from tests.support.few_canaries import few_canaries as few_canaries
from tests.support.scene_strip import FRAME, note_contributed, put_on_record, strip_map

_OLD = Path(__file__).parent.parent / "data" / "claimed_owners.db"
_ANCHOR = strip_map("A", 20.0, owners=["survey"])
_NONE = NewPhotos(given=GrowthPhotos(), rows=(), localised={})


@pytest.fixture
def database(tmp_path: Path) -> Database:
    database = Database.create(tmp_path / "db")
    database.commit_map(_ANCHOR)
    return database


def _grown(map_id: str, east_m: float, *owners: str, seed: int = 1) -> FeatureMap:
    """Around 45 m a map shows what the anchor shows; around 85 m and beyond it does not."""
    return strip_map(map_id, east_m, owners=owners, parents=[_ANCHOR], seed=seed)


def _add(database: Database, feature_map: FeatureMap, owner: str = "") -> None:
    note_contributed(database, feature_map, owner)
    database.commit_map(feature_map)


def _promoted(database: Database, *trusted: str) -> dict[str, Promotion]:
    work = Path(tempfile.mkdtemp(dir=database.url))
    found = promote_confirmed(database, Localiser.open(database), GrowthOptions(trusted=trusted), work, _NONE)
    return {outcome.map_id: outcome for outcome in found}


def _on_record(database: Database) -> set[str]:
    return set(read_owners(database, database.snapshot()).on_record)


def test_two_names_of_one_identity_confirm_nothing(database: Database) -> None:
    """Mallory gives one photo in Anna's name, the next in Ben's; and her map beside another of hers."""
    put_on_record(database, "anna", "ben", "mallory")
    _add(database, _grown("m", 85.0, "anna", "ben"), owner="mallory")
    _add(database, _grown("n", 88.0, "anna", "ben", seed=2), owner="mallory")
    assert {p.reason_code for p in _promoted(database).values()} == {"ONE_SOURCE"}


def test_ten_fresh_identities_promote_nothing(database: Database) -> None:
    """Together, one map each, and with one among them who has a record."""
    ten = [f"stranger-{k}" for k in range(10)]
    _add(database, strip_map("m", 85.0, owners=ten, parents=[_ANCHOR], seed=1, cameras=20))
    for k, stranger in enumerate(ten[:3]):
        _add(database, _grown(f"n{k}", 86.0 + k, stranger, seed=2 + k))
    assert {p.reason_code for p in _promoted(database).values()} == {"ONE_SOURCE"}
    put_on_record(database, ten[0])
    assert {p.reason_code for p in _promoted(database).values()} == {"ONE_SOURCE"}
    assert _on_record(database) == {ten[0]}


def test_an_anchored_map_makes_a_record_and_two_on_record_confirm_each_other(database: Database) -> None:
    _add(database, _grown("far", 85.0, "anna", "ben"))
    assert _promoted(database)["far"].reason_code == "ONE_SOURCE"
    _add(database, _grown("near", 45.0, "anna", seed=2))
    found = _promoted(database)
    assert (found["near"].promoted, found["far"].promoted) == (True, False)
    assert _on_record(database) == {"anna"}
    _add(database, _grown("near too", 44.0, "ben", seed=3))
    assert all(p.promoted for p in _promoted(database).values())
    assert _on_record(database) == {"anna", "ben"}
    assert database.snapshot().get("far").status == "active"
    assert verify(database).ok


def test_newcomers_beside_an_anchor_add_what_both_show(database: Database) -> None:
    """What the anchor shows of them counts at once for what they show beyond it; one alone adds nothing."""
    _add(database, _grown("near", 45.0, "anna", "ben"))
    _add(database, _grown("west", -5.0, "eve", seed=2))
    assert all(p.promoted for p in _promoted(database).values())
    snapshot, east = database.snapshot(), {}
    for map_id in ("near", "west"):
        found = snapshot.load_map(map_id)
        seen = found.observations
        east[map_id] = found.points_local(FRAME)[seen.point_index[seen.has_descriptor], 0]
    assert east["near"].max() > 70.0
    assert -10.1 < east["west"].min() < -9.0  # the anchor begins at -10 m, her map at -20 m


@pytest.mark.parametrize("refused", ["near", pytest.param("wall", marks=pytest.mark.evaluation)])
def test_a_map_that_canaries_refuse_makes_no_record(
    database: Database, monkeypatch: pytest.MonkeyPatch, refused: str
) -> None:
    """Its photos and those of a map that they alone confirm were given by the same two."""
    _add(database, _grown("far", 85.0, "anna", "ben"))
    _add(database, _grown("near", 45.0, "anna", "ben", seed=2))
    _add(database, _grown("wall", -5.0, "eve", seed=3))

    def canaries(_: Database, before: Localiser, after: Localiser, maps: Sequence[FeatureMap]) -> CanaryRun:
        wrong = "wrong" if refused in {m.map_id for m in maps} else ""
        return CanaryRun(
            checks=(CanaryCheck(name="c", before="found", after="found", regression=wrong),), note=""
        )

    monkeypatch.setattr("ingest.growth.trust.promotion.run_canaries", canaries)
    found = _promoted(database)
    stays = {"near", "far"} if refused == "near" else {"wall"}
    assert {m for m, p in found.items() if not p.promoted} == stays
    assert found[refused].reason_code == "CANARY"
    assert refused == "wall" or found["far"].reason_code == "ONE_SOURCE"


def test_a_record_ends_with_the_maps_that_made_it(database: Database) -> None:
    _add(database, _grown("near", 45.0, "anna", "ben"))
    assert _promoted(database)["near"].promoted
    assert _on_record(database) == {"anna", "ben"}
    database.retire("near", "a wrong lens")
    assert _on_record(database) == set()
    _add(database, _grown("far", 85.0, "anna", "ben", seed=2))
    assert _promoted(database)["far"].reason_code == "ONE_SOURCE"


def test_who_gives_a_withdrawn_photo_again_is_its_owner_and_inherits_no_record(database: Database) -> None:
    feature_map = _grown("m", 45.0, "anna")
    _add(database, feature_map)
    assert promote_by_hand(database, "m", "I have seen it", force=False).promoted
    candidates = [c.candidate_id for c in list_candidates(database)]
    withdraw(database, candidates, "on request")
    assert _on_record(database) == {"anna"}
    note_contributed(database, feature_map, "ben")
    owners = read_owners(database, database.snapshot())
    assert {c.owner for c in list_candidates(database)} == {"ben"}
    assert set(owners.givers.values()) == {"ben"}
    assert owners.on_record == {"anna"}


def test_nobody_in_particular_has_no_record(database: Database) -> None:
    """What comes without a certificate is confirmed where the anchor shows it, and vouches for nothing."""
    _add(database, _grown("near", 45.0, "anna", "ben"), owner=ANONYMOUS)
    assert _promoted(database)["near"].promoted
    assert _on_record(database) == set()
    put_on_record(database, "carl")
    _add(database, _grown("far", 85.0, "carl", seed=2))
    _add(database, _grown("far too", 88.0, "anna", seed=3), owner=ANONYMOUS)
    assert {p.reason_code for p in _promoted(database).values()} == {"ONE_SOURCE"}
    assert _promoted(database, ANONYMOUS)["far too"].promoted  # where the wire is the operator's alone


def _by_scan(database: Database, feature_map: FeatureMap) -> None:
    """As `featuredb anchor` does."""
    _measured(database, feature_map, "lidar", "active")


def _by_control_points(database: Database, feature_map: FeatureMap) -> None:
    """As `featuredb register` does, which leaves a map in quarantine where it was."""
    _measured(database, feature_map, "gcp", "quarantined")
    assert _on_record(database) == set()
    _by_hand(database, feature_map)


def _measured(database: Database, feature_map: FeatureMap, method: MapMethod, status: MapStatus) -> None:
    placement = replace(feature_map.placement, method=method)
    anchor = replace(feature_map, placement=placement, parents=(), generation=0, status=status)
    database.commit_map(anchor, replaces=feature_map.map_id)


def _by_hand(database: Database, feature_map: FeatureMap) -> None:
    assert promote_by_hand(database, feature_map.map_id, "I know them", force=False).promoted


def _by_trust(database: Database, feature_map: FeatureMap) -> None:
    assert _promoted(database, "anna")[feature_map.map_id].promoted


@pytest.mark.parametrize("begins", [_by_scan, _by_control_points, _by_hand, _by_trust])
def test_a_community_begins(database: Database, begins: Callable[[Database, FeatureMap], None]) -> None:
    """Nobody has a record, and no anchor shows anything of it: a scan, control points or the operator do."""
    first = _grown("first", 85.0, "anna", "ben")
    _add(database, first)
    assert not _promoted(database)["first"].promoted
    begins(database, first)
    assert _on_record(database) == {"anna", "ben"}
    _add(database, _grown("next", 150.0, "anna", "ben", seed=2))
    assert _promoted(database)["next"].promoted


def test_photos_of_this_machine_are_the_operator_s(database: Database) -> None:
    """A map of an ingest that others have placed needs nobody; a copy of its bytes makes nobody its owner."""
    mine = strip_map("m", 85.0, owners=["survey"], parents=[_ANCHOR], seed=1)
    database.commit_map(mine)
    copied = replace(_ANCHOR, images=tuple(replace(i, owner="mallory") for i in _ANCHOR.images))
    note_contributed(database, replace(copied, map_id="another"))
    owners = read_owners(database, database.snapshot())
    assert set(owners.of_map(mine)) == set(owners.of_map(_ANCHOR)) == {OPERATOR}
    assert owners.on_record == set()
    assert _promoted(database)["m"].promoted


def test_owners_that_were_only_claimed_are_nobody_in_particular(database: Database, tmp_path: Path) -> None:
    """Tables of before owners were identities: eight photos by names, one whose sender was authenticated."""
    for name in ("candidates", "candidate_images"):
        shutil.copytree(_OLD / name, tmp_path / "db" / name)
    assert [(c.owner, c.credit) for c in list_candidates(database)] == [
        *(4 * [(ANONYMOUS, "anna"), (ANONYMOUS, "ben")]),
        ("carl", "Somebody"),
    ]
    claimed = _grown("m", 85.0, "anna", "ben")
    database.commit_map(claimed)
    owners = read_owners(database, database.snapshot())
    assert owners.of_map(claimed) == 8 * [ANONYMOUS]
    assert _promoted(database)["m"].reason_code == "ONE_SOURCE"
    put_on_record(database, "carl")  # new rows beside the old ones
    assert _on_record(database) == {"carl"}
    assert verify(database).ok


def test_growth_does_not_listen_to_what_was_imported(database: Database) -> None:
    """Such a map is not examined, and its photos are not the operator's, until it is promoted."""
    imported = strip_map("i", 88.0, owners=["survey"], parents=[_ANCHOR], seed=2)
    database.commit_maps([imported], reasons={"i": IMPORTED})
    put_on_record(database, "anna")
    _add(database, _grown("m", 85.0, "anna"))
    found = _promoted(database)
    assert (found["i"].reason_code, found["m"].reason_code) == ("IMPORTED", "ONE_SOURCE")
    database.commit_map(imported, replaces="i", moves=False)  # thinned, for example
    assert _promoted(database)["i"].reason_code == "IMPORTED"
    assert promote_by_hand(database, "i", "I know where it is from", force=False).promoted
    assert _promoted(database)["m"].promoted
