"""Ingest of photos end to end, against the truth of rendered hills."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.store import Database
from ingest.map_builder import MapOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions
from ingest.sfm.mapper import SfmOptions
from tests.support.hill_map import MAKING, hill_map, hill_work
from tests.support.hill_photos import FRAME, HillPhoto, hill_height, hill_photos, write_hill_photos

_TRUTH = IngestOptions(workers=1, gps_sigma_m=(0.02, 0.02), making=MAKING)


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[HillPhoto]]:
    return hill_map(tmp_path_factory) / "photos", hill_photos()


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where features and matches are kept for the next test with the same photos."""
    return hill_work(tmp_path_factory)


def test_map_agrees_with_the_truth(hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path: Path) -> None:
    folder, truth = hills
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, folder, replace(_TRUTH, work=work))
    assert [m.status for m in report.maps] == ["committed"]
    assert report.count("registered") == len(truth) == 9
    feature_map = database.snapshot().load_map(report.maps[0].map_id)
    assert feature_map.epsg == 32632
    frame_from_map = FRAME.enu_from(feature_map.frame)
    poses = {photo.name: photo.cam_from_local for photo in truth}
    for image in feature_map.images:
        cam_from_frame = image.cam_from_local @ frame_from_map.inverse()
        assert np.linalg.norm(cam_from_frame.center - poses[image.name].center) < 0.05
        assert cam_from_frame.angle_to_deg(poses[image.name]) < 0.1
    points = FRAME.enu_from_utm(feature_map.points.utm, feature_map.epsg)
    above = points[:, 2] - hill_height(points[:, 0], points[:, 1])
    assert abs(np.median(above)) < 0.05
    assert np.percentile(np.abs(above), 95) < 0.4
    # 68 % of the errors within the reported deviation, if they were normal; a few wrong matches that
    # survive widen the residuals, and with them the deviation, so that more of the good ones are within.
    sigma = np.sqrt(feature_map.points.covariance[:, 5])
    assert 0.6 < (np.abs(above - np.median(above)) < sigma).mean() < 0.92


def test_only_long_tracks_carry_descriptors(
    hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path: Path
) -> None:
    options = IngestOptions(
        workers=1,
        gps_sigma_m=(0.02, 0.02),
        work=work,
        making=MapMakingOptions(extractor=MAKING.extractor, maps=MapOptions(min_track_length=4)),
    )
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, hills[0], options)
    feature_map = database.snapshot().load_map(report.maps[0].map_id)
    observations = feature_map.observations
    long = feature_map.points.track_length[observations.point_index] >= 4
    assert long.any()
    assert (~long).any()
    np.testing.assert_array_equal(observations.has_descriptor, long)
    norms = np.linalg.norm(observations.descriptors.astype(float), axis=1)
    assert norms[long].min() > 480
    assert norms[~long].max() == 0
    # Tracks are what the observations say.
    counted = np.bincount(observations.point_index, minlength=len(feature_map.points))
    np.testing.assert_array_equal(counted, feature_map.points.track_length)


def test_photos_without_gps_become_a_map_without_a_place(tmp_path: Path) -> None:
    write_hill_photos(tmp_path / "photos", columns=2, rows=2, with_gps=False)
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, tmp_path / "photos", IngestOptions(workers=1, making=MAKING))
    assert [(m.status, m.reason_code, m.photos) for m in report.maps] == [("unplaced", "TOO_FEW", 4)]
    assert {(p.status, p.reason_code) for p in report.photos} == {("unplaced", "too_few")}
    snapshot = database.snapshot()
    assert not snapshot.maps()
    (summary,) = snapshot.unplaced_maps()
    assert summary.no_place.reason_code == "TOO_FEW"
    unplaced = snapshot.load_unplaced(summary.map_id)
    assert not unplaced.frame.metric
    seen = unplaced.observations
    centers = np.array([image.cam_from_local.center for image in unplaced.images])
    distances = np.linalg.norm(unplaced.points.xyz[seen.point_index] - centers[seen.image_id], axis=1)
    assert np.median(distances) == pytest.approx(50.0, rel=0.02)
    again = ingest_photos(database, tmp_path / "photos", IngestOptions(workers=1, making=MAKING))
    assert [m.map_id for m in again.maps] == [summary.map_id]
    assert len(database.snapshot().unplaced_maps()) == 1


def test_two_places_become_two_maps(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    for seed, east in ((1, 0.0), (2, 400.0)):
        write_hill_photos(folder, columns=2, rows=2, texture_seed=seed, east_m=east, prefix=f"place{seed}")
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, folder, _TRUTH)
    assert [m.photos for m in report.maps] == [4, 4]
    snapshot = database.snapshot()
    loaded = [snapshot.load_map(m.map_id) for m in report.maps]
    names = [{image.name[:6] for image in m.images} for m in loaded]
    assert sorted(len(n) for n in names) == [1, 1]
    assert names[0] != names[1]
    east = sorted(float(np.median(FRAME.enu_from_utm(m.points.utm, m.epsg)[:, 0])) for m in loaded)
    assert east[1] - east[0] == pytest.approx(400.0, abs=10.0)


def test_a_wrong_position_is_named_and_left_out(work: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    write_hill_photos(folder, gps_noise_m=0.01)
    stray = write_hill_photos(tmp_path / "stray", east_m=30.0)[4]
    (tmp_path / "stray" / stray.name).replace(folder / stray.name)
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, folder, replace(_TRUTH, work=work))
    assert [m.status for m in report.maps] == ["committed"]
    unused = [p for p in report.photos if p.gps_used is False]
    assert [p.name for p in unused] == [stray.name]
    residual = unused[0].gps_residual_m
    assert residual is not None
    assert residual[0] == pytest.approx(30.0, abs=0.3)
    assert report.maps[0].residual_rms_m is not None
    assert report.maps[0].residual_rms_m < 0.1
    # Nothing tells how much of a stated sigma all positions share: 95 % of two axes are 2.45 sigmas.
    assert report.maps[0].place is not None
    assert report.maps[0].place.horizontal_m == pytest.approx(2.45 * 0.02, rel=0.3)


def test_photos_that_another_map_has_are_told(
    hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path: Path
) -> None:
    database = Database.create(tmp_path / "db")
    first = ingest_photos(database, hills[0], replace(_TRUTH, work=work))
    otherwise = replace(_TRUTH, work=work, gps_sigma_m=(0.03, 0.03))
    second = ingest_photos(database, hills[0], otherwise)
    old, new = (report.maps[0].map_id for report in (first, second))
    assert old != new
    assert not any("both answer" in w for w in first.warnings)
    assert f"9 of the 9 photos of map {new} are in active map {old}, too" in second.warnings[0]
    assert not any("both answer" in w for w in ingest_photos(database, hills[0], otherwise).warnings)


def test_positions_that_agree_on_another_place_keep_their_photos_out(work: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    write_hill_photos(folder, gps_noise_m=0.01)
    strays = write_hill_photos(tmp_path / "stray", east_m=30.0)[3:5]
    for stray in strays:
        (tmp_path / "stray" / stray.name).replace(folder / stray.name)
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, folder, replace(_TRUTH, work=work))
    assert [(m.status, m.photos, m.reason_code) for m in report.maps] == [
        ("committed", 7, ""),
        ("refused", 2, "ELSEWHERE"),
    ]
    out = {p.name: p.reason for p in report.photos if p.status != "registered"}
    assert list(out) == [stray.name for stray in strays]
    assert all("30 m from where their matches put them" in reason for reason in out.values())
    (summary,) = database.snapshot().maps()
    assert summary.images == 7


def test_unrelated_photos_give_no_map_and_say_why(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        write_hill_photos(tmp_path / "photos", columns=1, rows=1, texture_seed=seed, prefix=f"p{seed}")
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, tmp_path / "photos", IngestOptions(workers=1, making=MAKING))
    assert report.maps == ()
    assert report.verified_pairs == 0
    assert {p.reason_code for p in report.photos} == {"no_matches"}
    assert "overlap" in report.warnings[0]


def test_a_kept_focal_length_is_that_of_exif(
    hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path: Path
) -> None:
    making = MapMakingOptions(extractor=MAKING.extractor, sfm=SfmOptions(refine_focal=False))
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, hills[0], replace(_TRUTH, making=making, work=work))
    (camera,) = report.maps[0].cameras
    assert camera.focal_before_px == camera.focal_after_px
    assert report.count("registered") == 9


def test_a_map_without_a_good_point_is_refused(
    hills: tuple[Path, list[HillPhoto]], work: Path, tmp_path: Path
) -> None:
    making = MapMakingOptions(extractor=MAKING.extractor, maps=MapOptions(max_sigma_over_distance=1e-9))
    database = Database.create(tmp_path / "db")
    report = ingest_photos(database, hills[0], replace(_TRUTH, making=making, work=work))
    assert [(m.status, m.reason_code) for m in report.maps] == [("refused", "NO_POINTS")]
    assert not database.snapshot().maps()


def test_positions_that_are_shifted_together_are_told_beside_a_map_of_the_scene(
    hills: tuple[Path, list[HillPhoto]],
    work: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The same hills 50 km away: the map is placed, does not answer, and it is said everywhere why."""
    database = Database.create(tmp_path / "db")
    (right,) = ingest_photos(database, hills[0], replace(_TRUTH, work=work)).maps
    write_hill_photos(tmp_path / "shifted", rows=2, east_m=50_000.0)
    for _ in range(2):  # the second run finds the map there, and says the same
        report = ingest_photos(database, tmp_path / "shifted", replace(_TRUTH, work=work))
        (note,) = [w for w in report.warnings if "50.0 km to the west" in w]
        assert right.map_id in note
    shifted = database.snapshot().get(report.maps[0].map_id)
    assert (shifted.status, shifted.method) == ("quarantined", "gps")
    assert main(["maps", database.url]) == 0
    assert f"{shifted.map_id}: map {right.map_id}" in capsys.readouterr().out
    assert database.snapshot().get(right.map_id).status == "active"
