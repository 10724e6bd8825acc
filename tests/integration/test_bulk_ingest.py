"""Bulk ingest: tables, blocks that are joined, and the same maps from every executor."""

import csv
import os
import shutil
import signal
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap
from featuredb.store import Database
from featuredb.store.encode import content_digest
from ingest.clusters import reconstruct
from ingest.clusters.graph import ClusterOptions
from ingest.clusters.join import JoinedModel
from ingest.colmap.bridge import Model
from ingest.photos.scan import ScanOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions
from ingest.report.values import IngestReport
from tests.support.hill_map import MAKING, hill_map, hill_work
from tests.support.hill_photos import FRAME, HillPhoto, hill_photos, write_hill_photos

_OPTIONS = IngestOptions(
    workers=1,
    gps_sigma_m=(0.02, 0.02),
    making=MapMakingOptions(
        extractor=ExtractorOptions(max_features=600),
        # As small as hills of twenty photos allow: several blocks, joined by their seams.
        clusters=ClusterOptions(max_block_photos=8, least_seam_photos=4),
    ),
)


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[HillPhoto]]:
    folder = tmp_path_factory.mktemp("hills")
    return folder, write_hill_photos(folder, columns=5, rows=4, spacing_m=8.0)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of `in_process`."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def in_process(
    hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[FeatureMap, IngestReport]:
    database = Database.create(tmp_path_factory.mktemp("in-process") / "db")
    report = ingest_photos(database, hills[0], replace(_OPTIONS, work=work))
    return _only_map(database), report


def _only_map(database: Database) -> FeatureMap:
    snapshot = database.snapshot()
    (summary,) = snapshot.maps()
    return snapshot.load_map(summary.map_id)


def test_blocks_are_joined_into_one_map_that_agrees_with_the_truth(
    hills: tuple[Path, list[HillPhoto]], in_process: tuple[FeatureMap, IngestReport]
) -> None:
    feature_map, report = in_process
    blocks = {s.name: s.total for s in report.stages}["reconstruct"]
    assert blocks >= 3
    assert report.count("registered") == len(feature_map.images) == 20
    frame_from_map = FRAME.enu_from(feature_map.frame)
    poses = {photo.name: photo.cam_from_local for photo in hills[1]}
    for image in feature_map.images:
        cam_from_frame = image.cam_from_local @ frame_from_map.inverse()
        assert np.linalg.norm(cam_from_frame.center - poses[image.name].center) < 0.05
        assert cam_from_frame.angle_to_deg(poses[image.name]) < 0.1
    # Tracks run across the seams.
    assert feature_map.points.track_length.max() >= 9


def test_a_wrong_joint_is_undone_and_the_blocks_stay_apart(
    hills: tuple[Path, list[HillPhoto]],
    in_process: tuple[FeatureMap, IngestReport],
    work: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Blocks laid on top of each other at random: no match fits, yet no block is lost for it."""

    def at_random(models: Sequence[Model]) -> list[JoinedModel]:
        rng = np.random.default_rng(1)
        turned = [Sim3.exp(np.append(rng.normal(0, 1, 4), rng.normal(0, 5, 3))) for _ in models]
        return [dict(enumerate(turned))]

    monkeypatch.setattr(reconstruct, "join", at_random)
    for done in ("features", "matches", "models"):
        shutil.copytree(work / done, tmp_path / "work" / done)
    # Blocks are as they were; what was joined of them came last.
    shutil.rmtree(max((tmp_path / "work" / "models").iterdir(), key=lambda made: made.stat().st_mtime_ns))
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, hills[0], replace(_OPTIONS, work=tmp_path / "work"))
    poses = {photo.name: photo.cam_from_local for photo in hills[1]}
    snapshot = database.snapshot()
    maps = [snapshot.load_map(m.map_id) for m in snapshot.maps()]
    assert len(maps) >= 2, [(m.status, m.reason) for m in report.maps]
    assert report.count("registered") >= 16
    for feature_map in maps:
        for image in feature_map.images:
            cam_from_frame = image.cam_from_local @ FRAME.enu_from(feature_map.frame).inverse()
            assert np.linalg.norm(cam_from_frame.center - poses[image.name].center) < 0.2


@pytest.mark.evaluation
def test_the_pool_gives_the_same_map(
    hills: tuple[Path, list[HillPhoto]], in_process: tuple[FeatureMap, IngestReport], tmp_path: Path
) -> None:
    database = Database.create(tmp_path / "db")
    ingest_photos(database, hills[0], replace(_OPTIONS, workers=2))
    assert content_digest(_only_map(database)) == content_digest(in_process[0])


@pytest.fixture
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason="needs the extra `dask`")
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as cluster:
        yield cluster


@pytest.mark.evaluation  # tests of the executors do the same with small tasks
def test_dask_gives_the_same_map_although_a_worker_is_killed(
    cluster: Any,
    hills: tuple[Path, list[HillPhoto]],
    in_process: tuple[FeatureMap, IngestReport],
    tmp_path: Path,
) -> None:
    killed: list[int] = []

    def kill_one(stage: str, done: int, total: int) -> None:
        """One worker in the middle of each of two stages."""
        if (stage, done) in (("extract", total // 2), ("reconstruct", 1)) and len(killed) < 2:
            pid = cluster.workers[len(killed)].process.pid
            os.kill(pid, signal.SIGKILL)
            killed.append(pid)

    database = Database.create(tmp_path / "db")
    options = replace(_OPTIONS, dask=cluster.scheduler_address)
    report = ingest_photos(database, hills[0], options, kill_one)
    assert len(killed) == 2
    assert report.count("registered") == 20
    assert content_digest(_only_map(database)) == content_digest(in_process[0])


def _write_table(folder: Path, photos: list[HillPhoto], path: Path, *, owner: str) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["path", "lat", "lon", "accuracy", "owner", "licence", "title", "camera club"])
        for photo in photos:
            latitude, longitude, _ = FRAME.geodetic_from_enu(photo.cam_from_local.center)
            writer.writerow(
                [os.path.relpath(folder / photo.name, path.parent), latitude, longitude, 0.5, owner,
                 "CC0-1.0", "hills", "none"]
            )  # fmt: skip
        writer.writerow(["gone.jpg", 48.0, 8.0, 5, owner, "", "", ""])
        writer.writerow(["", 48.0, 8.0, 5, owner, "", "", ""])


@pytest.mark.parametrize(("trust", "status"), [(False, "quarantined"), (True, "active")])
def test_positions_of_a_table_place_active_maps_only_when_they_are_trusted(
    trust: bool, status: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    table = tmp_path / "site.csv"
    _write_table(hill_map(tmp_path_factory) / "photos", hill_photos(), table, owner="Ann")
    database = Database.create(tmp_path / "db")
    work, scan = hill_work(tmp_path_factory), ScanOptions(trust_geotags=trust)
    options = IngestOptions(workers=1, making=MAKING, scan=scan, work=work)
    report = ingest_photos(database, table, options)
    assert report.count("registered") == 9
    found = _only_map(database)
    assert found.status == status
    assert found.name == "site"
    assert {(image.owner, image.licence) for image in found.images} == {("Ann", "CC0-1.0")}
    assert {round(image.gps.sigma_horizontal_m, 3) for image in found.images if image.gps} == {0.5}
    reasons = {p.name: p.reason_code for p in report.photos if p.status == "skipped"}
    assert reasons == {"gone.jpg": "missing", "row 11": "bad_row"}
    assert "ignored: camera club" in report.warnings[0]
    assert "row 11 is left out" in report.warnings[1]
    assert ("Maps in quarantine" in report.warnings[-1]) == (not trust)
