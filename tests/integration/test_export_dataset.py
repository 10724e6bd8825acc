"""A dataset is written whole, the same each time, and holds nothing that was not asked for."""

import csv
import gc
import hashlib
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import ExportError
from featuredb.export.dataset import read_dataset, write_dataset
from featuredb.export.job import size_of
from featuredb.export.selection import Selection
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store import Database
from featuredb.store.encode import content_digest
from featuredb.store.snapshot import Snapshot
from tests.support.datasets import export, files_of, job_of, varied_database
from tests.support.maps import assert_same_map, random_map


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Database:
    return varied_database(tmp_path_factory.mktemp("varied") / "maps.db")


@pytest.fixture(scope="module")
def folder(database: Database, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset") / "out"
    export(database, out)
    return out


def test_what_is_read_back_is_what_was_there(database: Database, folder: Path) -> None:
    snapshot = database.snapshot()
    wanted = [m.map_id for m in snapshot.maps(include_retired=True)]
    found = list(read_dataset(folder))
    assert [m.map_id for m in found] == wanted
    for feature_map in found:
        original = snapshot.load_map(feature_map.map_id)
        assert_same_map(feature_map, original)
        assert feature_map.status == original.status
        assert (
            content_digest(feature_map)
            == content_digest(original)
            == snapshot.get(original.map_id).content_digest
        )


def test_it_says_what_it_wrote(database: Database, tmp_path: Path) -> None:
    done = export(database, tmp_path / "out")
    summaries = database.snapshot().maps(include_retired=True)
    assert done.maps == len(summaries)
    assert done.points == sum(m.points for m in summaries)
    assert done.images == sum(m.images for m in summaries)
    assert done.observations == sum(m.observations for m in summaries)
    assert done.bytes == size_of(tmp_path / "out")


def test_zones_and_datums_have_files_of_their_own(folder: Path) -> None:
    assert sorted(p.name for p in (folder / "points").iterdir()) == [
        "32612-navd88-0000.parquet",
        "32632-egm2008-0000.parquet",
        "32632-unknown-0000.parquet",
        "32734-egm96-0000.parquet",
        "32760-ellipsoidal-0000.parquet",
    ]


def test_two_exports_have_the_same_bytes(database: Database, folder: Path, tmp_path: Path) -> None:
    export(database, tmp_path / "another name")
    first, second = files_of(folder), files_of(tmp_path / "another name")
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_the_same_maps_of_an_older_snapshot(database: Database, tmp_path: Path) -> None:
    """Only the snapshot's own maps are exported, with the status that they had in it."""
    version = next(e.version for e in database.history() if e.operation == "retire") - 1
    job = replace(job_of(database, tmp_path / "out"), snapshot=database.snapshot(version))
    write_dataset(job)
    statuses = {m.map_id: m.status for m in read_dataset(tmp_path / "out")}
    assert statuses["old"] == "active"
    assert json.loads((tmp_path / "out" / "dataset.json").read_text())["snapshot"] == version


def test_checksums_cover_every_file(folder: Path) -> None:
    lines = (folder / "SHA256SUMS").read_text().splitlines()
    listed = {line[66:]: line[:64] for line in lines}
    files = files_of(folder)
    del files["SHA256SUMS"]
    assert listed == {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    check = subprocess.run(
        ["sha256sum", "--check", "--strict", "SHA256SUMS"], cwd=folder, capture_output=True
    )
    assert check.returncode == 0


def test_every_photo_is_attributed(database: Database, folder: Path) -> None:
    with (folder / "attribution.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["map_id", "image", "sha256", "owner", "licence", "capture_time", "source"]
    snapshot = database.snapshot()
    expected = [
        (
            *(m.map_id, i.name, i.sha256, i.owner, i.licence),
            *(i.capture_time.isoformat() if i.capture_time else "", m.source),
        )
        for m in map(snapshot.load_map, (s.map_id for s in snapshot.maps(include_retired=True)))
        for i in m.images
    ]
    assert [tuple(row.values()) for row in rows] == expected


def test_a_licence_leaves_nothing_of_other_photos(tmp_path: Path) -> None:
    """No file has a byte of their names or hashes, not even in what the placement says of them."""
    database = Database.create(tmp_path / "db")
    whole = random_map(3, images=6)
    images = tuple(
        replace(i, name=f"secret/hidden_{i.image_id}.jpg", owner="Nobody Else", licence="all rights reserved")
        if i.image_id in (1, 4)
        else i
        for i in whole.images
    )
    evidence = {"residuals_m": {i.name: 0.5 for i in images}, "outliers": [images[4].name]}
    database.commit_map(replace(whole, images=images, placement=replace(whole.placement, evidence=evidence)))
    hidden = [images[k] for k in (1, 4)]
    words = [w.encode() for i in hidden for w in (i.name, i.sha256, i.sha256[:32], "hidden_", "Nobody Else")]
    export(database, tmp_path / "part", Selection(licences=("cc-by",)))
    export(database, tmp_path / "whole", Selection())
    for out, expected in ((tmp_path / "part", False), (tmp_path / "whole", True)):
        files = list(read_plainly(out).values())
        for word in words:
            assert any(word in data for data in files) is expected, word
    (part,) = read_dataset(tmp_path / "part")
    assert {i.image_id for i in part.images} == {0, 2, 3, 5}
    observed = {d.tobytes() for d in part.observations.descriptors}
    lost = whole.observations.has_descriptor & np.isin(whole.observations.image_id, (1, 4))
    assert lost.any()
    assert not any(d.tobytes() in observed for d in whole.observations.descriptors[lost])


def read_plainly(folder: Path) -> dict[str, bytes]:
    """The files as they are, and what is compressed in them."""
    import pyarrow.parquet as pq

    files = files_of(folder)
    for path in folder.rglob("*.parquet"):
        files[f"{path} decoded"] = repr(pq.read_table(path).to_pylist()).encode()
    return files


def test_one_map_is_in_memory_at_a_time(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def maps() -> int:
        gc.collect()
        return sum(isinstance(thing, FeatureMap) for thing in gc.get_objects())

    load, most = Snapshot.load_any, []

    def counted(snapshot: Snapshot, map_id: str) -> AnyMap:
        most.append(maps())
        return load(snapshot, map_id)

    monkeypatch.setattr(Snapshot, "load_any", counted)
    gc.collect()
    gc.freeze()  # what was there before is not gone through each time
    try:
        export(database, tmp_path / "out")
    finally:
        gc.unfreeze()
    assert most == [0] * 10  # nothing is left of one when the next is loaded


def test_a_kill_in_the_middle_leaves_nothing(database: Database, tmp_path: Path) -> None:
    program = """
import os, signal, sys
from dataclasses import replace
from pathlib import Path
from featuredb.export.dataset import write_dataset
from featuredb.maps.feature_map import FeatureMap
from featuredb.maps.unplaced_map import AnyMap
from featuredb.store import Database
from tests.support.datasets import job_of
job = job_of(Database.open(sys.argv[1]), Path(sys.argv[2]))
die = lambda done, total: os.kill(os.getpid(), signal.SIGKILL) if done == 5 else None
write_dataset(replace(job, told=die))
"""
    out = tmp_path / "out"
    command = [sys.executable, "-c", program, database.url, str(out)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert not out.exists()
    assert all(p.name.startswith(".out.part-") for p in tmp_path.iterdir())
    export(database, out)
    assert len(list(read_dataset(out))) == 10


def test_an_error_in_the_middle_leaves_nothing(database: Database, tmp_path: Path) -> None:
    def fail(done: int, total: int) -> None:
        if done == total:
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_dataset(replace(job_of(database, tmp_path / "out"), told=fail))
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_written_over(folder: Path, database: Database) -> None:
    before = files_of(folder)
    with pytest.raises(ExportError, match="nothing is overwritten"):
        export(database, folder)
    assert files_of(folder) == before


def test_the_datasheet_has_the_figures(database: Database, folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    summaries = database.snapshot().maps(include_retired=True)
    for name in ("images", "points", "observations", "descriptors"):
        assert f"| {name} | {sum(getattr(m, name) for m in summaries):,} |" in text
    assert "| maps | 10 |" in text
    assert "| status of the maps | 7 active, 2 quarantined, 1 retired |" in text
    assert "| CC-BY-4.0 | 36 |" in text
    assert "| EPSG:32734 | egm96 | WGS 84 / UTM zone 34S + EGM96 height | 1 | 4 | 60 |" in text
    assert "| `rootsift-test` | 10 |" in text
    for column in ("earth_covariance", "cov_ee", "descriptor", "placement_evidence"):
        assert f"| `{column}` |" in text


def test_large_tables_are_cut_between_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from featuredb.export.dataset import partitions

    monkeypatch.setattr(partitions, "LARGEST_ROWS", 100)
    database = Database.create(tmp_path / "db")
    for k in range(5):
        database.commit_map(random_map(k))
    export(database, tmp_path / "out")
    assert len(list((tmp_path / "out" / "points").iterdir())) == 3  # of 60 points each: two, two and one
    assert len(list((tmp_path / "out" / "observations").iterdir())) == 5  # of 200 each
    found = {m.map_id: m for m in read_dataset(tmp_path / "out")}
    for k in range(5):
        assert_same_map(found[f"map-{k}"], random_map(k))
