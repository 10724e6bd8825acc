"""A dataset back into a database: the same maps, once, checked before anything is written."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from featuredb.cli.main import main
from featuredb.errors import ExportError
from featuredb.export.dataset import import_dataset, layout, read_dataset
from featuredb.export.dataset.layout import write_sums
from featuredb.export.selection import Selection
from featuredb.store import Database
from featuredb.store.changes import IMPORTED
from featuredb.store.encode import content_digest
from featuredb.store.verify import verify
from tests.support.command_line import only_command
from tests.support.datasets import EVERYTHING, export, files_of, map_at, varied_database
from tests.support.maps import assert_same_map, random_map, random_unplaced_map


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Database:
    return varied_database(tmp_path_factory.mktemp("varied") / "maps.db")


@pytest.fixture(scope="module")
def exported(source: Database, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "out"
    export(source, out)
    return out


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    for name, data in files_of(exported).items():
        (tmp_path / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "copy" / name).write_bytes(data)
    return tmp_path / "copy"


@pytest.fixture
def target(tmp_path: Path) -> Database:
    return Database.create(tmp_path / "target.db")


def test_all_tables_are_the_same(source: Database, exported: Path, target: Database) -> None:
    done = import_dataset(target, exported, trusted=True)
    assert len(done.created) == 10
    assert done.present == ()
    assert done.quarantined == {}
    before, after = source.snapshot(), target.snapshot()
    assert [m.map_id for m in after.maps(include_retired=True)] == [
        m.map_id for m in before.maps(include_retired=True)
    ]
    for old in before.maps(include_retired=True):
        new = after.get(old.map_id)
        assert_same_map(after.load_map(old.map_id), before.load_map(old.map_id))
        assert new.content_digest == old.content_digest
        assert (new.status, new.status_reason) == (old.status, old.status_reason)
        assert replace(new, write_id="", created_at=old.created_at) == replace(old, write_id="")
    assert before.lineages() == after.lineages()
    for table in ("images", "points", "observations"):
        plain = [s.dataset(table).to_table().drop_columns(["write_id"]).to_pylist() for s in (before, after)]
        index = {"images": "image_index", "points": "point_index", "observations": "observation_index"}[table]
        a, b = (sorted(rows, key=lambda r: (r["map_id"], r[index])) for rows in plain)
        assert a == b
        assert len(a) > 30
    assert verify(target).ok


def test_a_second_export_of_what_was_imported_is_the_same(
    exported: Path, target: Database, tmp_path: Path
) -> None:
    import_dataset(target, exported, trusted=True)
    export(target, tmp_path / "again")
    first, second = files_of(exported), files_of(tmp_path / "again")
    for name in first:
        if name.startswith(("points/", "images/", "observations/", "cameras", "attribution")):
            assert first[name] == second[name], name


def test_again_changes_nothing(exported: Path, target: Database) -> None:
    first = import_dataset(target, exported)
    version = target.poll_version()
    second = import_dataset(target, exported)
    assert second.created == ()
    assert sorted(second.present) == sorted(first.created)
    assert target.poll_version() == version


def test_an_import_goes_on_where_it_was_killed(exported: Path, target: Database) -> None:
    def stop(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_dataset(target, exported, told=stop)
    done = import_dataset(target, exported)
    assert (len(done.created), len(done.present)) == (6, 4)


def test_a_dry_run_writes_nothing(exported: Path, target: Database) -> None:
    done = import_dataset(target, exported, dry_run=True)
    assert len(done.created) == 10
    assert done.dry_run
    assert target.poll_version() == 0
    assert target.snapshot().maps(include_retired=True) == []


@pytest.mark.parametrize(
    "name",
    [
        "README.md",
        "attribution.csv",
        "maps.parquet",
        "points/32734-egm96-0000.parquet",
        "stac/items/fiji.json",
    ],
)
def test_damage_is_found_and_named(folder: Path, target: Database, name: str) -> None:
    data = bytearray((folder / name).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / name).write_bytes(data)
    for read in (lambda: import_dataset(target, folder), lambda: read_dataset(folder)):
        with pytest.raises(ExportError, match=rf"{name}: the content is not what SHA256SUMS says"):
            read()
    (folder / name).unlink()
    with pytest.raises(ExportError, match=rf"{name}: SHA256SUMS lists this file, and it is missing"):
        import_dataset(target, folder)
    assert target.poll_version() == 0


def test_what_is_no_dataset_is_refused(folder: Path, target: Database, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="expected a dataset's folder with SHA256SUMS"):
        import_dataset(target, tmp_path / "nowhere")
    sums = (folder / "SHA256SUMS").read_text()
    for line in ("hello\n", f"{'0' * 64}  ../outside\n", f"{'0' * 64}  /etc/passwd\n"):
        (folder / "SHA256SUMS").write_text(sums + line)
        with pytest.raises(ExportError, match=r"SHA256SUMS, line \d+: expected a SHA-256 and a path"):
            import_dataset(target, folder)
    (folder / "SHA256SUMS").write_text("".join(s for s in sums.splitlines(True) if "maps.parquet" not in s))
    with pytest.raises(ExportError, match=r"does not list maps\.parquet"):
        import_dataset(target, folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format_version": 2}, "expected version 1 of the format, found 2"),
        ({"format": "other"}, "expected the format 'featuredb-dataset', found 'other'"),
    ],
)
def test_other_formats_are_refused(
    folder: Path, target: Database, change: dict[str, object], message: str
) -> None:
    description = json.loads((folder / "dataset.json").read_text()) | change
    (folder / "dataset.json").write_text(json.dumps(description))
    rewritten(folder)
    with pytest.raises(ExportError, match=message):
        import_dataset(target, folder)


def test_a_forged_map_is_found_by_its_digest(folder: Path, target: Database) -> None:
    """Checksums can be made anew with the files; what a map's digest says still does not fit."""
    path = folder / "points/32734-egm96-0000.parquet"
    table = pq.read_table(path)
    red = table["red"].to_pylist()
    red[3] = (red[3] + 1) % 256
    column = table.schema.get_field_index("red")
    pq.write_table(table.set_column(column, "red", pa.array(red, pa.uint8())), path)
    rewritten(folder)
    with pytest.raises(ExportError, match="map cape-town: the files hold another map"):
        list(read_dataset(folder))
    with pytest.raises(ExportError, match="map cape-town: the files hold another map"):
        import_dataset(target, folder, dry_run=True)


def test_rows_that_are_missing_are_found(folder: Path, target: Database) -> None:
    path = folder / "observations/32734-egm96-0000.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)
    rewritten(folder)
    with pytest.raises(ExportError, match=r"map cape-town: its files do not make a map .*expected 200 rows"):
        import_dataset(target, folder, dry_run=True)


def test_another_map_of_the_same_id_is_not_touched(exported: Path, target: Database) -> None:
    target.commit_map(map_at(99, 49.0, 8.4, "unknown", map_id="fiji"))
    with pytest.raises(ExportError, match="has other maps of the ids fiji"):
        import_dataset(target, exported)
    assert target.poll_version() == 1
    target.retire("fiji", "gives way")
    assert "fiji" in import_dataset(target, exported).created
    assert target.snapshot().get("fiji").status == "quarantined"


@pytest.mark.usefixtures("_command")
def test_what_is_retired_here_stays_so(
    exported: Path, target: Database, capsys: pytest.CaptureFixture[str]
) -> None:
    import_dataset(target, exported, trusted=True)
    target.retire("fiji", "a wrong lens")
    done = import_dataset(target, exported, trusted=True)
    assert done.retired["fiji"] == "a wrong lens"
    assert "fiji" in done.present
    assert target.snapshot().get("fiji").status == "retired"
    assert main(["import", target.url, str(exported)]) == 0
    assert "fiji: is retired here (a wrong lens) and stays so; `featuredb promote`" in capsys.readouterr().out


def test_maps_that_came_before_a_broken_one_are_named(folder: Path, target: Database) -> None:
    path = folder / layout.MAPS
    rows = pq.read_table(path)
    names = rows.column("name").to_pylist()
    names[rows.column("map_id").to_pylist().index("grandchild")] = "changed"
    pq.write_table(rows.set_column(rows.schema.get_field_index("name"), "name", [names]), path)
    rewritten(folder)
    with pytest.raises(
        ExportError, match=r"map grandchild: the files hold another map.*; imported before it:"
    ) as told:
        import_dataset(target, folder)
    there = [m.map_id for m in target.snapshot().any_maps(include_retired=True)]
    assert {"karlsruhe", "child"} <= set(there)  # its parents come before it
    assert all(map_id in str(told.value) for map_id in there)


def test_a_new_map_below_one_that_is_retired_here_is_held_back(
    source: Database, exported: Path, target: Database, tmp_path: Path
) -> None:
    export(source, tmp_path / "one", replace(EVERYTHING, maps=("karlsruhe",)))
    import_dataset(target, tmp_path / "one", trusted=True)
    target.retire("karlsruhe", "a wrong lens")
    done = import_dataset(target, exported, trusted=True)
    assert "karlsruhe" in done.quarantined["grandchild"]
    statuses = {m.map_id: m.status for m in target.snapshot().maps(include_retired=True)}
    assert (statuses["karlsruhe"], statuses["grandchild"]) == ("retired", "quarantined")
    assert statuses["fiji"] == "active"


def test_a_table_that_lacks_values_or_columns_is_told_in_a_line(folder: Path, target: Database) -> None:
    path = folder / layout.MAPS
    rows = pq.read_table(path)
    at = rows.schema.get_field_index("parents")
    pq.write_table(rows.set_column(at, "parents", pa.nulls(len(rows), rows.schema.field(at).type)), path)
    rewritten(folder)
    with pytest.raises(ExportError, match=r"maps\.parquet: expected values in parents, some are missing"):
        import_dataset(target, folder)
    pq.write_table(rows.drop_columns(["status"]), path)
    rewritten(folder)
    with pytest.raises(ExportError, match="cannot read it") as told:
        import_dataset(target, folder)
    assert "\n" not in str(told.value)
    assert target.poll_version() == 0


def test_nothing_of_it_answers_before_somebody_vouches_for_it(
    source: Database, exported: Path, target: Database
) -> None:
    """Later, too: by an import that is trusted, or map by map."""
    done = import_dataset(target, exported)
    active = {m.map_id for m in source.snapshot().maps() if m.status == "active"}
    assert set(done.quarantined) == active
    kept = {m.map_id: m for m in target.snapshot().maps()}
    assert {m.status for m in kept.values()} == {"quarantined"}
    assert {m.status_reason for m in kept.values()} == {IMPORTED}  # not what the dataset says
    assert len(active) < len(kept)
    before = target.poll_version()
    assert import_dataset(target, exported, trusted=True, dry_run=True).created == ()
    assert target.poll_version() == before
    assert import_dataset(target, exported, trusted=True).created == ()
    assert {m.map_id for m in target.snapshot().maps() if m.status == "active"} == active
    target.rollback(before)
    target.set_status(["fiji"], "active", "I know where it is from")
    assert {m.map_id for m in target.snapshot().maps() if m.status == "active"} == {"fiji"}


def test_who_vouches_later_vouches_for_all_maps(tmp_path: Path, target: Database) -> None:
    """Those without a place and in quarantine, too; one whose parent somebody here holds back waits."""
    source = Database.create(tmp_path / "source.db")
    source.commit_maps([random_unplaced_map(1), random_map(2), random_map(3), random_map(4)])
    source.commit_map(random_map(5, parents=("map-2",)))
    source.set_status(["map-3"], "quarantined", "one owner only")
    source.set_status(["map-4"], "quarantined", IMPORTED)  # from elsewhere, there
    export(source, tmp_path / "out", Selection(statuses=("active", "quarantined", "unplaced")))
    import_dataset(target, tmp_path / "out")
    reasons = _reasons(target)
    assert set(reasons.values()) == {IMPORTED}
    target.set_status(["map-2"], "active", "known")
    target.set_status(["map-2"], "quarantined", "it is blurred")
    import_dataset(target, tmp_path / "out", trusted=True)
    reasons = _reasons(target)
    assert IMPORTED not in reasons.values()
    assert reasons["map-3"] == "one owner only"
    assert reasons["map-5"] == "what placed it is not active: map-2"
    assert target.snapshot().get("map-5").status == "quarantined"
    before = target.poll_version()
    import_dataset(target, tmp_path / "out", trusted=True)
    assert target.poll_version() == before
    assert verify(target).ok


def _reasons(database: Database) -> dict[str, str]:
    snapshot = database.snapshot()
    return {m.map_id: m.status_reason for m in (*snapshot.maps(), *snapshot.unplaced_maps())}


def test_a_map_whose_parents_are_missing_waits_in_quarantine(source: Database, tmp_path: Path) -> None:
    export(source, tmp_path / "out", Selection(maps=("grandchild", "cape-town")))
    target = Database.create(tmp_path / "target.db")
    done = import_dataset(target, tmp_path / "out", trusted=True)
    assert done.quarantined == {"grandchild": ("child", "karlsruhe")}
    found = target.snapshot().get("grandchild")
    assert found.status == "quarantined"
    assert found.status_reason == "what placed it is not here: child, karlsruhe"
    assert target.snapshot().get("cape-town").status == "active"
    # With one of them there, a chain leads to an anchor, and the map can be promoted.
    target.commit_map(source.snapshot().load_map("karlsruhe"))
    target.set_status(["grandchild"], "active", "its parent has come")


def test_parents_may_be_in_the_database_already(source: Database, tmp_path: Path) -> None:
    export(source, tmp_path / "out", Selection(maps=("grandchild",)))
    target = Database.create(tmp_path / "target.db")
    target.commit_map(source.snapshot().load_map("karlsruhe"))
    assert import_dataset(target, tmp_path / "out", trusted=True).quarantined == {}
    assert target.snapshot().get("grandchild").status == "active"


def test_parents_come_first(tmp_path: Path) -> None:
    """Whatever the order in which they were committed."""
    source, target = Database.create(tmp_path / "a.db"), Database.create(tmp_path / "b.db")
    source.commit_map(random_map(1, map_id="third", parents=("second",)))
    source.commit_map(random_map(2, map_id="second", parents=("first",)))
    source.commit_map(random_map(3, map_id="first"))
    export(source, tmp_path / "out")
    assert import_dataset(target, tmp_path / "out", trusted=True).created == ("first", "second", "third")
    assert import_dataset(target, tmp_path / "out").quarantined == {}


def test_a_part_by_licence_is_another_map_to_its_own_database(source: Database, tmp_path: Path) -> None:
    database = Database.create(tmp_path / "db")
    whole = random_map(1)
    images = tuple(replace(i, licence="CC0-1.0" if i.image_id else "MIT") for i in whole.images)
    database.commit_map(replace(whole, images=images))
    export(database, tmp_path / "out", Selection(licences=("cc0",)))
    with pytest.raises(ExportError, match="exported in part, by licence"):
        import_dataset(database, tmp_path / "out")
    target = Database.create(tmp_path / "target.db")
    import_dataset(target, tmp_path / "out")
    assert target.snapshot().get("map-1").images == 3
    assert verify(target).ok


@pytest.fixture
def _command(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with only_command(monkeypatch, "import", "featuredb.cli.import_dataset:register"):
        yield


@pytest.mark.usefixtures("_command")
def test_the_command(
    source: Database, target: Database, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(source, tmp_path / "out", replace(EVERYTHING, maps=("grandchild", "fiji")))
    argv = ["import", target.url, str(tmp_path / "out")]
    held = (
        "2 of them in quarantine, because nobody here has vouched for them: `featuredb promote` takes one "
        "into service, `--trusted` the whole of a dataset\n"
    )
    assert main([*argv, "--dry-run"]) == 0
    missing = (
        "grandchild: in quarantine, what placed it is neither in the dataset nor in the database: child, "
        "karlsruhe\n"
    )
    assert capsys.readouterr().out == f"would import 2 maps; 0 were there already\n{held}{missing}"
    assert main(argv) == 0
    assert capsys.readouterr().out == f"imported 2 maps; 0 were there already\n{held}{missing}version 2\n"
    assert main(argv) == 0
    assert capsys.readouterr().out == "imported 0 maps; 2 were there already\nversion 2\n"
    assert main([*argv, "--trusted"]) == 0
    assert target.snapshot().get("fiji").status == "active"
    assert target.snapshot().get("grandchild").status == "quarantined"
    (tmp_path / "out" / "README.md").write_text("mine")
    assert main(argv) == 2
    assert "README.md: the content is not what SHA256SUMS says" in capsys.readouterr().err


def rewritten(folder: Path) -> None:
    """Make the checksums fit again."""
    (folder / "SHA256SUMS").unlink()
    write_sums(folder)


def test_maps_without_a_place_come_back_beside_the_others(tmp_path: Path, target: Database) -> None:
    source = Database.create(tmp_path / "source.db")
    unplaced = random_unplaced_map(1)
    source.commit_maps([unplaced, random_map(2)])
    source.commit_map(random_unplaced_map(3))
    source.retire("map-3", "blurred")
    export(source, tmp_path / "out", Selection(statuses=("active", "unplaced", "retired")))
    assert "maps without a place" in (tmp_path / "out" / "README.md").read_text()
    assert import_dataset(target, tmp_path / "out", dry_run=True).created == ("map-2", "map-1", "map-3")
    assert import_dataset(target, tmp_path / "out").created == ("map-2", "map-1", "map-3")
    assert import_dataset(target, tmp_path / "out").created == ()
    again = target.snapshot().load_unplaced("map-1")
    assert content_digest(again) == content_digest(unplaced)
    (retired,) = (m for m in target.snapshot().unplaced_maps(include_retired=True) if m.map_id == "map-3")
    assert (retired.status, retired.status_reason) == ("retired", "blurred")
    assert verify(target).ok
    points = tmp_path / "out" / "own_frame" / "points.parquet"
    pq.write_table(pq.read_table(points).slice(1), points)
    (tmp_path / "out" / "SHA256SUMS").unlink()
    write_sums(tmp_path / "out")
    with pytest.raises(ExportError, match="map-1: its files do not make a map"):
        import_dataset(Database.create(tmp_path / "third.db"), tmp_path / "out")
