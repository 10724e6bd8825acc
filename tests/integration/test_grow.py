"""`featuredb grow` from contributed photos to answers, over the test hills; truth is known."""

import json
import shutil
import threading
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ingest.growing as growing_module
import ingest.growth.place.localised as localised_module
from featuredb.cli.main import main
from featuredb.errors import StoreError
from featuredb.features.features import Features
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute, read_owners
from featuredb.store.candidates.states import Contribution
from featuredb.store.verify import verify
from ingest.growing import grow_candidates, watch_and_grow
from ingest.growth.growth_report import GrowthReport
from ingest.photos.photo import Photo
from reloc.localise.candidates import IndexedArea
from tests.support.few_canaries import few_canaries as few_canaries
from tests.support.grown_maps import ask, copied, described, states
from tests.support.hill_scan import write_hill_scan
from tests.support.hill_walk import (
    NOW,
    WEST_M,
    Shot,
    add_survey,
    anchored_database,
    error_m,
    give,
    growing,
    step_of,
    survey,
)
from tests.support.made_once import made_once
from tests.support.power_cut import Disk, State, write_state

_EAST_M = WEST_M + 13.0  # photos there see half of what the survey saw
_AWAY_M = WEST_M + 90.0  # and there nothing of it
_Prepared = tuple[Path, Path, GrowthReport]


@pytest.fixture(scope="module")
def anchored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an anchored database, to be copied."""
    return made_once("anchored-hills", anchored_database, tmp_path_factory) / "db"


@pytest.fixture
def database(anchored: Path, tmp_path: Path) -> Database:
    shutil.copytree(anchored, tmp_path / "db")
    return Database.open(tmp_path / "db")


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    """Three photos of Anna's, three of Ben's, of one place."""
    return step_of(_EAST_M)


@pytest.fixture(scope="module")
def prepared(anchored: Path, shots: list[Shot], tmp_path_factory: pytest.TempPathFactory) -> _Prepared:
    folder = tmp_path_factory.mktemp("given")
    shutil.copytree(anchored, folder / "given")
    give(Database.open(folder / "given"), shots)
    shutil.copytree(folder / "given", folder / "grown")
    report = grow_candidates(Database.open(folder / "grown"), growing())
    shutil.copytree(folder / "grown" / "_work", folder / "given" / "_work", dirs_exist_ok=True)
    return folder / "given", folder / "grown", report


@pytest.fixture
def given(prepared: _Prepared) -> Path:
    """The anchored database with all six photos waiting, and all work done up to their models."""
    return prepared[0]


@pytest.fixture
def grown(prepared: _Prepared) -> tuple[Path, GrowthReport]:
    """What a run has made of it."""
    return prepared[1:]


def test_photos_of_one_answer_where_others_show_the_same(database: Database, shots: list[Shot]) -> None:
    """The survey shows a part of what Anna's photos do, and of what Ben's do later: that part answers."""
    beyond = step_of(_EAST_M + 9.0, owners=("stranger",), each=1)[0]
    asked_before = ask(database, beyond)
    anna = give(database, shots[:3])
    first = grow_candidates(database, growing())
    assert [(m.status, len(m.photos)) for m in first.maps] == [("active", 3)]
    assert 0.3 < described(database, first.promoted[0]) < 0.7

    ben = give(database, shots[3:])
    second = grow_candidates(database, growing())
    assert len(second.promoted) == 1
    assert 0.3 < described(database, second.promoted[0]) < 1.0
    assert states(database) == dict.fromkeys([*anna, *ben], "used")
    for map_id in (*first.promoted, *second.promoted):
        summary = database.snapshot().get(map_id)
        assert summary.status == "active"
        assert error_m(database, shots, map_id) < min(0.1, summary.drift_m + 0.05)
        assert summary.method == "map"
    error = ask(database, beyond)
    assert error is not None
    assert error < 0.2
    assert asked_before is None or error < asked_before + 0.05


def test_two_owners_at_once_are_promoted_in_one_run(grown: tuple[Path, GrowthReport], tmp_path: Path) -> None:
    database, report = copied(grown[0], tmp_path), grown[1]
    assert report.count("promoted") == 6
    assert report.rounds == 2
    entry = report.maps[0]
    assert (entry.status, entry.generation) == ("active", 1)
    assert all(gate["passes"] for gate in entry.gates.values())
    assert {"agreement", "visibility", "drift", "confirmation", "canaries"} <= set(entry.gates)
    evidence = database.snapshot().load_map(entry.map_id).placement.evidence["growth"]
    assert evidence["drift_m"] == pytest.approx(entry.drift_m, abs=1e-6)
    assert {"agreement", "visibility", "drift"} <= set(evidence["gates"])
    assert len(evidence["covariance_relative"]) == 49
    assert {edge["map_id"] for edge in evidence["edges"]} == set(entry.parents)
    images = database.snapshot().load_map(entry.map_id).images
    assert {image.owner for image in images} == {"name of anna", "name of ben"}  # whom to name, no owner
    owners = read_owners(database, database.snapshot())
    assert set(owners.made_of) == {entry.map_id}
    assert owners.on_record == {"anna", "ben"}
    assert json.loads(json.dumps(report.as_json()))["version"] == database.poll_version()
    text = report.as_text()
    assert "6 in active maps" in text
    assert f"map {entry.map_id}: active" in text
    # Run again: nothing waits, nothing changes.
    version = database.poll_version()
    again = grow_candidates(database, growing())
    assert again.photos == ()
    assert database.poll_version() == version


def test_beyond_the_budget_nothing_is_taken_and_photos_wait(given: Path, tmp_path: Path) -> None:
    database = copied(given, tmp_path)
    version = database.poll_version()
    report = grow_candidates(database, growing(budget_m=0.005))
    assert {p.reason_code for p in report.photos} == {"DRIFT_BUDGET"}
    assert {m.reason_code for m in report.maps} == {"DRIFT_BUDGET"}
    assert database.poll_version() == version
    assert set(states(database).values()) == {"waiting"}
    # With a larger budget, an anchor that came near for example, they go in.
    assert grow_candidates(database, growing()).count("promoted") == 6


def test_a_map_that_was_retired_does_not_come_back(grown: tuple[Path, GrowthReport], tmp_path: Path) -> None:
    database = copied(grown[0], tmp_path)
    map_id = grown[1].promoted[0]
    database.retire(map_id, "the photos are not ours")
    assert set(states(database).values()) == {"waiting"}
    report = grow_candidates(database, growing())
    assert {(p.outcome, p.reason_code) for p in report.photos} == {("refused", "RETIRED_MAP")}
    assert set(states(database).values()) == {"refused"}
    assert database.snapshot().get(map_id).status == "retired"


def test_a_run_that_dies_is_finished_by_the_next(
    given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = copied(given, tmp_path)
    version = database.poll_version()

    def dies(*args: object, **more: object) -> None:
        raise StoreError("the power went out")

    with monkeypatch.context() as patch:
        patch.setattr(Database, "commit_map", dies)
        with pytest.raises(StoreError, match="power"):
            grow_candidates(database, growing())
    assert database.poll_version() == version
    assert set(states(database).values()) == {"waiting"}  # used by a map that is not there
    with monkeypatch.context() as patch:
        patch.setattr(Database, "set_status", dies)
        with pytest.raises(StoreError, match="power"):
            grow_candidates(database, growing())
    assert {m.status for m in database.snapshot().maps()} == {"active", "quarantined"}
    report = grow_candidates(database, growing())
    assert len(report.promoted) == 1
    assert set(states(database).values()) == {"used"}


@pytest.mark.evaluation
@pytest.mark.timeout(3600)
def test_a_power_cut_leaves_what_was_seen(
    given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every write of a run what is left is what readers saw, or saw just before, and growth goes on."""
    database = copied(given, tmp_path)
    Path(database.url, "_work").rename(tmp_path / "work")
    options = replace(growing(), work=tmp_path / "work")

    def look(at: Database) -> object:
        return {m.map_id: m.status for m in at.snapshot().maps()}, states(at)

    shown = [look(database)]
    left: list[tuple[int, State]] = []

    def cut() -> None:
        if (now := look(database)) != shown[-1]:
            shown.append(now)
        left.extend((len(shown) - 1, disk.surviving(names=names)) for names in (False, True))

    with monkeypatch.context() as patch:
        disk = Disk(Path(database.url), patch, cut)
        assert len(grow_candidates(database, options).promoted) == 1
        cut()
    assert len(shown) == 3  # photos wait, a map is in quarantine, it is active
    assert look(database) == shown[-1]
    gone_on = set()
    for i, (stage, state) in enumerate(left):
        if any(state == other for _, other in left[:i]):
            continue
        place = tmp_path / "left.db"
        write_state(state, place)
        found = Database.open(place)
        assert verify(found).problems == ()
        assert look(found) in shown[max(stage - 1, 0) : stage + 1]
        if (reached := shown.index(look(found))) not in gone_on:
            gone_on.add(reached)
            grow_candidates(found, options)
            assert set(states(found).values()) == {"used"}
            assert {m.status for m in found.snapshot().maps()} == {"active"}
        shutil.rmtree(place)
    assert gone_on == set(range(len(shown)))


def test_photos_of_elsewhere_wait_broken_ones_and_copies_are_refused(
    anchored: Path, database: Database, shots: list[Shot]
) -> None:
    rng = np.random.default_rng(3)
    noise = rng.integers(0, 255, (480, 640), dtype=np.uint8)
    good, copy = (
        shots[0],
        Shot(data=shots[0].data + b"\0", cam_from_local=shots[0].cam_from_local, owner="eve"),
    )
    nowhere = Shot(data=_jpeg(noise), cam_from_local=good.cam_from_local, owner="eve")
    ours = Shot(
        data=(anchored.parent / "survey" / "survey_0_4.jpg").read_bytes(),
        cam_from_local=good.cam_from_local,
        owner="eve",
    )
    broken = Shot(data=good.data[:5000], cam_from_local=good.cam_from_local, owner="eve")
    ids = give(database, [good, copy, nowhere, broken, ours])
    report = grow_candidates(database, growing())
    fates = {p.name: (p.outcome, p.reason_code) for p in report.photos}
    assert fates[ids[0]] == ("waiting", "ALONE")  # a single localised photo is never enough
    assert fates[ids[2]][0] == "waiting"
    assert fates[ids[2]][1] in ("TOO_FEW_MATCHES", "TOO_FEW_INLIERS")
    assert fates[ids[1]][0] == "refused"
    assert fates[ids[3]][0] == "refused"
    assert fates[ids[4]] == ("refused", "DUPLICATE")  # the map was made from the same file
    assert states(database)[ids[0]] == "waiting"
    later = grow_candidates(database, growing(give_up_days=30), now=NOW + timedelta(days=31))
    assert {p.reason_code for p in later.photos} == {"GAVE_UP"}
    assert "waiting" not in states(database).values()


def test_a_photo_is_not_looked_for_twice_in_the_same_maps(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[tuple[str, int]] = []
    honest = localised_module.localise_photo

    def counted(photo: Photo, features: Features, areas: list[IndexedArea], *rest: Any) -> Any:
        looked.append((Path(photo.name).stem, sum(int(a.area.searched.sum()) for a in areas)))
        return honest(photo, features, areas, *rest)

    monkeypatch.setattr(localised_module, "localise_photo", counted)
    away = step_of(_AWAY_M, owners=("anna",), each=1)[0]
    noise = np.random.default_rng(3).integers(0, 255, (480, 640), dtype=np.uint8)
    nowhere = Shot(data=_jpeg(noise), cam_from_local=away.cam_from_local, owner="eve")
    ids = give(database, [away, nowhere])
    first = grow_candidates(database, growing())
    assert sorted(looked) == sorted((i, 1) for i in ids)
    looked.clear()
    again = grow_candidates(database, growing())
    assert looked == []
    assert [(p.name, p.reason_code, p.reason) for p in again.photos] == [
        (p.name, p.reason_code, p.reason) for p in first.photos
    ]
    # A new map: both are looked for in it alone; what is found there, in all maps.
    survey(tmp_path / "away", _AWAY_M, 1)
    add_survey(database, tmp_path / "away")
    later = grow_candidates(database, growing())
    assert sorted(looked) == sorted([(ids[0], 1), (ids[1], 1), (ids[0], 2)])
    assert {p.name: p.reason_code for p in later.photos}[ids[0]] == "ALONE"


def _jpeg(picture: np.ndarray) -> bytes:
    import cv2

    return bytes(cv2.imencode(".jpg", picture)[1])


def test_a_worker_grows_when_photos_arrive_and_survives_errors(
    given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = copied(given, tmp_path)
    stop, reports, calls = threading.Event(), [], []
    real = growing_module.grow_candidates

    def sometimes(*args: object, **more: object) -> GrowthReport:
        calls.append(1)
        if len(calls) == 1:
            raise StoreError("the store is away for a moment")
        return real(*args, **more)  # type: ignore[arg-type]

    def heard(report: GrowthReport) -> None:
        reports.append(report)
        stop.set()

    monkeypatch.setattr(growing_module, "grow_candidates", sometimes)
    worker = threading.Thread(
        target=watch_and_grow, args=(database, growing(), stop, heard), kwargs={"poll_s": 0.05}
    )
    worker.start()
    worker.join(120)
    assert not worker.is_alive()
    assert len(calls) == 2
    assert reports[0].count("promoted") == 6


def test_trusted_owners_and_commands(given: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copied(given, tmp_path)
    url, report = str(tmp_path / "db"), tmp_path / "report.json"
    photo = tmp_path / "known.jpg"
    photo.write_bytes(step_of(WEST_M, owners=("x",), each=1)[0].data)
    assert main(["canary", url, "add", str(photo)]) == 0
    assert main(["canary", url, "list"]) == 0
    assert "known.jpg" in capsys.readouterr().out
    assert main(["grow", url, "--trust", "anna", "--max-features", "1000", "--report", str(report)]) == 0
    assert "6 in active maps" in capsys.readouterr().out
    told = json.loads(report.read_text())
    assert told["maps"][0]["gates"]["canaries"]["passes"]
    assert "1 known queries" in told["maps"][0]["reason"]
    assert main(["canary", url, "run"]) == 0
    assert "right" in capsys.readouterr().out
    map_id = told["maps"][0]["map_id"]
    assert main(["promote", url, map_id, "--reason", "again"]) == 0
    assert main(["canary", url, "remove", "known.jpg"]) == 0


def test_a_trusted_owner_alone(database: Database, shots: list[Shot]) -> None:
    give(database, shots[:3])
    options = growing(trusted=("anna",))
    assert grow_candidates(database, options).count("promoted") == 3


def test_an_empty_inbox_is_no_error(database: Database) -> None:
    version = database.poll_version()
    report = grow_candidates(database, growing())
    assert report.photos == ()
    assert database.poll_version() == version
    contribute(
        database,
        [Contribution(image=b"no image", width=1, height=1, credit="x", licence="y", received_at=NOW)],
    )
    assert [p.outcome for p in grow_candidates(database, growing()).photos] == ["refused"]


@pytest.mark.parametrize(("up_m", "other_datum"), [(0.0, False), (1.0, False), (1.0, True)])
def test_a_scan_in_store_has_its_say(given: Path, tmp_path: Path, up_m: float, other_datum: bool) -> None:
    """The grown map claims centimetres; a scan that has the hills a metre higher keeps it out.

    With heights of another datum it cannot say so, and the report tells.
    """
    pytest.importorskip("laspy")
    from featuredb.lidar.add import AddOptions, add_scan

    database = copied(given, tmp_path)
    anchor = next(iter(database.snapshot().maps()))
    datum = database.snapshot().load_map(anchor.map_id).height_datum
    if other_datum:
        datum = next(d for d in ("ellipsoidal", "egm2008") if d != datum)
    scan = write_hill_scan(tmp_path / "hills.laz", offset_m=(0.0, 0.0, up_m), half_side_m=50.0, spacing_m=0.4)
    add_scan(database, [scan], AddOptions(height_datum=datum))
    report = grow_candidates(database, growing())
    said = [note for note in report.notes if "scans in store" in note]
    assert bool(said) == other_datum
    if up_m and not other_datum:
        assert {m.reason_code for m in report.maps} == {"CONTRADICTS_SCAN"}
        assert {p.outcome for p in report.photos} == {"waiting"}
        assert len(database.snapshot().maps()) == 1
        return
    (grown,) = (m for m in report.maps if m.map_id)
    assert ("scan" in grown.gates) != other_datum
    if not other_datum:
        assert grown.gates["scan"]["passes"]
        assert 0.0 < grown.gates["scan"]["figure"] < grown.gates["scan"]["limit"]
