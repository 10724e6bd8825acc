"""What contributed photos, known queries and promotion must do at any place; see `store_suite`."""

import threading

import numpy as np
import pytest

from featuredb.errors import (
    CanaryNotFoundError,
    CandidateNotFoundError,
    ConflictError,
    InvalidValueError,
    MapNotFoundError,
    StoreError,
)
from featuredb.store import Database
from featuredb.store.canaries import add_canary, list_canaries, load_canary_image, remove_canary
from featuredb.store.candidates.photos import (
    contribute,
    count_candidates,
    list_candidates,
    load_images,
    mark_used,
    refuse,
    withdraw,
)
from featuredb.store.maintenance import VacuumOptions, compact, vacuum
from featuredb.store.sql import SqlSession
from featuredb.store.verify import verify
from tests.support.contributions import contribution, find_candidate, known_pose, load_image
from tests.support.maps import random_map
from tests.support.store_suite import NOTHING_KEPT, Place


class GrowthSuite:
    """The behaviour of the inbox, wherever it lies."""

    @pytest.fixture
    def place(self) -> Place:
        raise NotImplementedError

    @pytest.fixture
    def database(self, place: Place) -> Database:
        return place.create()

    def test_a_database_without_an_inbox(self, database: Database) -> None:
        assert list_candidates(database) == []
        assert count_candidates(database).by_state == {}
        assert list_canaries(database) == []
        with pytest.raises(CandidateNotFoundError):
            load_image(database, "0" * 32)
        with pytest.raises(CanaryNotFoundError):
            remove_canary(database, "x")
        report = verify(database)
        assert (report.ok, report.candidates, report.canaries) == (True, 0, 0)

    def test_photos_come_back_as_they_were_given(self, database: Database) -> None:
        given = [contribution(i, minute=i) for i in range(3)]
        ids = contribute(database, given)
        assert [c.candidate_id for c in list_candidates(database)] == ids
        for candidate_id, one in zip(ids, given, strict=True):
            found = find_candidate(database, candidate_id)
            assert load_image(database, candidate_id) == one.image
            assert (found.owner, found.licence, found.received_at) == (
                one.owner,
                one.licence,
                one.received_at,
            )
            assert (found.request, found.answer, found.snapshot) == (one.request, one.answer, 3)
            assert (found.width, found.height, found.size_bytes) == (640, 480, len(one.image))
            assert found.contributors[0].client_id == "phone 7"
        assert dict(load_images(database, ids[::-1])) == {i: c.image for i, c in zip(ids, given, strict=True)}
        assert count_candidates(database).stored_bytes == sum(len(c.image) for c in given)

    def test_the_same_bytes_are_one_candidate(self, database: Database) -> None:
        first = contribute(database, [contribution(1, "Ada"), contribution(1, "Bob", minute=1)])
        again = contribute(database, [contribution(1, "Ada", minute=2), contribution(1, "Cleo", minute=3)])
        assert len({*first, *again}) == 1
        (found,) = list_candidates(database)
        assert [c.owner for c in found.contributors] == ["Ada", "Bob", "Cleo"]
        counts = count_candidates(database)
        assert counts.waiting_by_owner == {"Ada": 1}
        assert counts.stored_bytes == found.size_bytes

    def test_withdrawal_removes_the_bytes_at_once(self, database: Database) -> None:
        one, other = contribute(database, [contribution(1, "Ada"), contribution(2, "Bob")])
        database.commit_map(random_map(1))
        mark_used(database, [one], "map-1")
        report = withdraw(database, [one], "asked by mail")
        assert report.candidates == (one,)
        assert report.used_by == ("map-1",)
        assert report.files
        with pytest.raises(CandidateNotFoundError, match="withdrawn"):
            load_image(database, one)
        assert load_image(database, other) == contribution(2).image
        assert find_candidate(database, one).state == "withdrawn"
        assert withdraw(database, [one], "again").candidates == (one,)
        with pytest.raises(StoreError, match="reason"):
            withdraw(database, [other], "")
        with pytest.raises(CandidateNotFoundError):
            withdraw(database, ["0" * 32], "asked")
        assert verify(database).ok
        contribute(database, [contribution(1, "Ada", minute=-60)])  # its clock is behind
        assert load_image(database, one) == contribution(1).image
        assert find_candidate(database, one).state == "waiting"

    def test_threads_that_contribute_at_once(self, database: Database, place: Place) -> None:
        contribute(database, [contribution(99)])

        def give(owner: str) -> None:
            for seed in range(3):
                contribute(place.open(), [contribution(seed, owner)])

        threads = [threading.Thread(target=give, args=(owner,)) for owner in ("Ada", "Bob", "Cleo")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(120)
        found = {c.candidate_id: {g.owner for g in c.contributors} for c in list_candidates(database)}
        assert sorted(map(len, found.values())) == [1, 3, 3, 3]
        report = verify(database)
        assert (report.ok, report.candidates) == (True, 4)


class DecisionsSuite(GrowthSuite):
    """What is decided about photos, known queries and maps, too: the code is the same wherever they lie."""

    def test_compact_and_vacuum_keep_the_inbox(self, database: Database) -> None:
        ids = [contribute(database, [contribution(i)])[0] for i in range(4)]
        refuse(database, {ids[0]: ("BLUR", "blurred")})
        saved = compact(database)
        assert saved["candidate_images"] == 3
        assert saved["candidates"] == 4
        vacuum(database, VacuumOptions(orphan_grace_h=0, file_grace_h=0))
        assert dict(load_images(database, ids)) == {i: contribution(k).image for k, i in enumerate(ids)}
        dry = vacuum(database, NOTHING_KEPT, dry_run=True)
        assert dry.candidate_images == (ids[0],)
        assert load_image(database, ids[0])
        assert vacuum(database, NOTHING_KEPT).candidate_images == (ids[0],)
        with pytest.raises(CandidateNotFoundError):
            load_image(database, ids[0])
        assert find_candidate(database, ids[0]).reason_code == "BLUR"
        assert vacuum(database, NOTHING_KEPT).candidate_images == ()
        report = verify(database)
        assert (report.ok, report.candidates, report.orphans) == (True, 4, ())

    def test_used_counts_while_the_map_lives(self, database: Database) -> None:
        ids = contribute(database, [contribution(1), contribution(2)])
        mark_used(database, ids, "map-1")
        assert count_candidates(database).by_state == {"waiting": 2}, "the map is not there yet"
        version = database.commit_map(random_map(1)).version
        assert find_candidate(database, ids[0]).used_by == ("map-1",)
        assert count_candidates(database).by_state == {"used": 2}
        database.set_status(["map-1"], "quarantined", "one owner only")
        assert count_candidates(database).by_state == {"used": 2}
        database.retire("map-1", "wrong")
        assert count_candidates(database).by_state == {"waiting": 2}
        database.rollback(version)
        assert count_candidates(database).by_state == {"used": 2}
        database.rollback(0)
        assert count_candidates(database).by_state == {"waiting": 2}

    def test_refused_and_unknown(self, database: Database) -> None:
        (one,) = contribute(database, [contribution(1)])
        refuse(database, {one: ("ALTERED", "its bytes were edited")})
        found = find_candidate(database, one)
        assert (found.state, found.reason_code, found.reason) == (
            "refused",
            "ALTERED",
            "its bytes were edited",
        )
        assert list_candidates(database, state="waiting") == []
        before = list_candidates(database)
        with pytest.raises(StoreError, match="expected a reason code"):
            refuse(database, {one: (" ", "x")})
        with pytest.raises(CandidateNotFoundError, match="0000"):
            refuse(database, {one: ("X", "x"), "0" * 32: ("X", "x")})
        with pytest.raises(CandidateNotFoundError):
            mark_used(database, ["0" * 32], "map-1")
        assert list_candidates(database) == before

    def test_sql_shows_the_inbox_without_images(self, database: Database) -> None:
        query = "select count(*), count(distinct candidate_id), max(happened_at) from candidates"
        with SqlSession(database.snapshot(), database) as session:
            assert next(session.query(query).rows) == (0, 0, None)
        one, _ = contribute(database, [contribution(1), contribution(2)])
        refuse(database, {one: ("BLUR", "blurred")})
        add_canary(database, "gate", b"photo", known_pose(), origin="person")
        with SqlSession(database.snapshot(), database) as session:
            assert next(session.query(query).rows)[:2] == (3, 2)
            assert "image" not in session.query("select * from canaries").columns
            assert next(session.query("select name, tolerance_m from canaries").rows) == ("gate", 0.3)

    def test_known_queries(self, database: Database) -> None:
        pose = known_pose()
        first = add_canary(
            database,
            "gate",
            b"photo",
            pose,
            origin="answer",
            snapshot=4,
            request={"prior": None},
        )
        add_canary(database, "another town", b"elsewhere", None, origin="person")
        assert (
            add_canary(
                database,
                "gate",
                b"photo",
                pose,
                origin="answer",
                snapshot=4,
                request={"prior": None},
            ).created_at
            == first.created_at
        )
        other, gate = list_canaries(database)
        assert (other.name, other.pose, gate.name, gate.origin, gate.snapshot) == (
            "another town", None, "gate", "answer", 4,
        )  # fmt: skip
        assert gate.pose is not None
        np.testing.assert_array_equal(gate.pose.utm, pose.utm)
        np.testing.assert_array_equal(gate.pose.cam_from_utm_xyzw, pose.cam_from_utm_xyzw)
        assert (gate.pose.epsg, gate.pose.height_datum) == (pose.epsg, pose.height_datum)
        assert (gate.pose.tolerance_m, gate.pose.tolerance_deg) == (0.3, 0.5)
        assert gate.request == {"prior": None}
        assert load_canary_image(database, gate) == b"photo"
        for image, expected, word in (
            (b"photo 2", pose, "sha256"),
            (b"photo", known_pose(0.4), "tolerance_m"),
        ):
            with pytest.raises(StoreError, match=word):
                add_canary(
                    database, "gate", image, expected, origin="answer", snapshot=4, request={"prior": None},
                )  # fmt: skip
        compact(database)
        assert verify(database).canaries == 2
        remove_canary(database, "gate")
        assert [c.name for c in list_canaries(database)] == ["another town"]
        with pytest.raises(CanaryNotFoundError, match="removed"):
            load_canary_image(database, gate)
        with pytest.raises(CanaryNotFoundError, match="gate"):
            remove_canary(database, "gate")
        add_canary(database, "gate", b"photo 2", None, origin="person")
        assert verify(database).ok

    def test_what_is_no_known_query(self, database: Database) -> None:
        for name, image, origin, snapshot, request, word in (
            (" ", b"x", "person", None, {}, "name"),
            ("n" * 201, b"x", "person", None, {}, "name"),
            ("n", b"", "person", None, {}, "bytes"),
            ("n", b"x", "answer", None, {}, "snapshot"),
            ("n", b"x", "person", 3, {}, "snapshot"),
            ("n", b"x", "person", None, {"x": object()}, "JSON"),
        ):
            with pytest.raises(InvalidValueError, match=word):
                add_canary(database, name, image, None, origin=origin, snapshot=snapshot, request=request)  # type: ignore[arg-type]
        assert list_canaries(database) == []

    def test_promotion_and_quarantine_are_commits(self, database: Database) -> None:
        quarantined = random_map(2, parents=("map-1",)).with_status("quarantined")
        database.commit_maps([random_map(1), quarantined])
        result = database.set_status(["map-2"], "active", "three owners agree")
        assert result.changed == ("map-2",)
        promoted = database.snapshot().get("map-2")
        assert (promoted.status, promoted.status_reason) == ("active", "three owners agree")
        entry = database.history()[0]
        assert (entry.operation, entry.maps, entry.reason) == ("promote", ("map-2",), "three owners agree")
        again = database.set_status(["map-2"], "active", "again")
        assert (again.changed, again.version) == ((), result.version)
        # Quarantine takes along what hangs on the map alone.
        assert database.set_status(["map-1"], "quarantined", "doubt").changed == ("map-1", "map-2")
        assert database.history()[0].operation == "quarantine"
        assert database.snapshot().get("map-2").status_reason == "doubt (map-1)"
        with pytest.raises(StoreError, match="map-1 is quarantined"):
            database.set_status(["map-2"], "active", "alone")
        assert database.set_status(["map-2", "map-1"], "active", "both").changed == ("map-2", "map-1")
        database.rollback(result.version - 1)
        assert database.snapshot().get("map-2").status == "quarantined"
        assert verify(database).ok

    def test_a_status_decided_on_an_earlier_state_is_refused(self, database: Database) -> None:
        first = database.commit_map(random_map(1).with_status("quarantined"))
        second = database.commit_map(random_map(2))
        active = [second.write_id]
        database.set_status(["map-1"], "active", "seen", based_on={"map-1": first.write_id}, active=active)
        database.set_status(["map-1"], "quarantined", "doubt")
        replaced = random_map(9, map_id="map-1").with_status("quarantined")
        database.commit_map(replaced, replaces="map-1")
        version = database.poll_version()
        with pytest.raises(ConflictError, match="map-1 was placed anew"):
            database.set_status(["map-1"], "active", "seen", based_on={"map-1": first.write_id})
        database.commit_map(random_map(3))
        with pytest.raises(ConflictError, match="1 came, 0 went"):
            database.set_status(["map-1"], "active", "seen", active=active)
        database.retire("map-2", "wrong")
        with pytest.raises(ConflictError, match="1 came, 1 went"):
            database.set_status(["map-1"], "active", "seen", active=active)
        assert database.snapshot().get("map-1").status == "quarantined"
        assert database.poll_version() == version + 2

    def test_statuses_that_cannot_be_set(self, database: Database) -> None:
        database.commit_maps([random_map(1), random_map(2)])
        database.retire("map-2", "wrong street")
        for map_ids, status, reason, error, word in (
            (["map-9"], "active", "x", MapNotFoundError, "map-9"),
            (["map-2"], "active", "x", StoreError, "is retired"),
            (["map-1"], "retired", "x", StoreError, "use `retire`"),
            (["map-1"], "quarantined", " ", StoreError, "reason"),
        ):
            with pytest.raises(error, match=word):
                database.set_status(map_ids, status, reason)  # type: ignore[arg-type]
        assert database.poll_version() == 2
