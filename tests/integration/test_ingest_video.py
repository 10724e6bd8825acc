"""`featuredb ingest video`: a film over the test hills becomes a map where its telemetry has them."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from featuredb.cli.main import main
from featuredb.errors import TelemetryError
from featuredb.features.exif.read import read_exif
from featuredb.geo.geopose import geopose_from_camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.store import Database
from featuredb.video.telemetry.read import read_telemetry
from featuredb.video.writer import VideoWriter
from ingest.video import stills as keyframe_files
from ingest.video.film_time import film_start
from ingest.video.keyframes import KeyframeOptions
from ingest.video.stills import Stills, StillsOptions, make_stills
from tests.support.hill_photos import CAMERA, FRAME, _render
from tests.support.planar_map import field_texture, view
from tests.support.remembered import remembered

_RATE_HZ = 10.0
# For what telemetry does: a handful of photos, each of which is looked at for what is burnt in.
_FEW = KeyframeOptions(step=0.25, least=4)


def _pose(frame: int) -> Rigid3:
    """East, north, west: 1.5 m a frame."""
    leg, along = divmod(frame, 16)
    east = 1.5 * along if leg == 0 else 24.0 if leg == 1 else 24.0 - 1.5 * along
    north = 0.0 if leg == 0 else 1.2 * along if leg == 1 else 19.2
    return view(east - 12.0, north - 9.0, 46.0 + 2.0 * np.sin(frame / 5.0), tilt_deg=6.0, heading_deg=20.0)


def _clock(time_s: float) -> str:
    return f"00:00:{int(time_s):02d},{round(1000 * (time_s % 1)):03d}"


@pytest.fixture(scope="module", autouse=True)
def _looked_at_once() -> Iterator[None]:
    """Most tests choose the same keyframes, in which the same is burnt in: nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keyframe_files, "find_burnt_in", remembered(keyframe_files.find_burnt_in))
        yield


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty-eight frames, and subtitles as a DJI drone writes them."""
    folder = tmp_path_factory.mktemp("film")
    texture, blocks = field_texture(1), []
    with VideoWriter(folder / "hills.mp4", width=CAMERA.width, height=CAMERA.height, fps=_RATE_HZ) as writer:
        for i in range(48):
            writer.write(_render(texture, _pose(i), i))
            place = geopose_from_camera(_pose(i), FRAME)
            blocks.append(
                f"{i + 1}\n{_clock(i / _RATE_HZ)} --> {_clock((i + 1) / _RATE_HZ)}\nFrameCnt: {i + 1}\n"
                f"2026-05-01 12:00:{i / _RATE_HZ:06.3f}\n[latitude: {place.latitude_deg:.9f}] [longitude: "
                f"{place.longitude_deg:.9f}] [rel_alt: 0.0 abs_alt: {place.height_m:.4f}] "
                "[gb_yaw: 20.0 gb_pitch: -84.0 gb_roll: 0.0]\n\n"
            )
    (folder / "hills.srt").write_text("".join(blocks))
    return folder / "hills.mp4"


@pytest.mark.slow
def test_a_film_becomes_a_map_where_its_telemetry_says(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["ingest", "video", str(tmp_path / "db"), str(film), "--gps-sigma", "0.05", "--quiet"]
    command += ["--workers", "1", "--max-features", "800", "--keyframes", "12"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "telemetry of hills.srt" in said
    snapshot = Database.open(tmp_path / "db").snapshot()
    (summary,) = snapshot.maps()
    assert summary.name == "hills"
    feature_map = snapshot.load_map(summary.map_id)
    assert 6 <= len(feature_map.images) <= 16
    assert len(feature_map.cameras) == 1
    assert feature_map.cameras[0].focal_px == pytest.approx(CAMERA.focal_px, rel=0.02)
    angles = feature_map.placement.evidence["angles"]  # the gimbal's, of the subtitles
    assert angles["told"]
    assert max(angles["tilt_off_deg"], angles["yaw_off_deg"]) < 1.0, angles
    own_from_hills = feature_map.frame.enu_from(FRAME)
    for image in feature_map.images:
        true = own_from_hills.act(_pose(int(Path(image.name).stem)).center)
        assert np.linalg.norm(image.cam_from_local.center - true) < 0.3, image.name
    # Again: nothing is decoded or made anew, and nothing is committed twice.
    stills = sorted((tmp_path / "db" / "_work" / "films").rglob("*.jpg"))
    before = [f.stat().st_mtime_ns for f in stills]
    assert main(command) == 0
    assert [f.stat().st_mtime_ns for f in stills] == before
    assert len(Database.open(tmp_path / "db").snapshot().maps()) == 1


def _photos(stills: Stills) -> int:
    return sum(len(shot.keyframes) for shot in stills.shots)


def test_stills_are_photos_of_one_camera_with_positions(film: Path, tmp_path: Path) -> None:
    telemetry = read_telemetry(film.with_suffix(".srt"))
    options = StillsOptions(keyframes=KeyframeOptions(step=0.2, window=0, least=0))
    stills = make_stills(film, telemetry, tmp_path, options)
    files = sorted(stills.folder.glob("*.jpg"))
    assert len(files) == _photos(stills) == stills.positions
    assert sum(shot.frames for shot in stills.shots) == 48
    told = [read_exif(f.read_bytes()) for f in files]
    assert len({t.camera_key for t in told}) == 1
    assert told[0].camera_key.startswith("film|")
    for file, t in zip(files, told, strict=True):
        place = geopose_from_camera(_pose(int(file.stem)), FRAME)
        assert t.latitude_deg == pytest.approx(place.latitude_deg, abs=2e-8)
        assert t.altitude_m == pytest.approx(place.height_m, abs=2e-3)
    with Image.open(files[0]) as picture:
        assert picture.size == (CAMERA.width, CAMERA.height)


def test_gimbal_angles_of_the_telemetry_are_those_of_the_photos(film: Path, tmp_path: Path) -> None:
    """A camera that looks ahead and down; the first two seconds tell no angles."""
    telemetry = read_telemetry(film.with_suffix(".srt"))
    angles = np.tile([-170.0, -84.0, 0.5], (len(telemetry), 1))
    angles[telemetry.times_s < 2.0] = np.nan
    stills = make_stills(
        film, replace(telemetry, gimbal_ypr_deg=angles), tmp_path, StillsOptions(keyframes=_FEW)
    )
    told = {int(f.stem): read_exif(f.read_bytes()).angles for f in stills.folder.glob("*.jpg")}
    assert told
    for frame, found in told.items():
        if frame < 20:
            assert found is None
        else:
            assert found is not None
            assert (found.yaw_deg, found.pitch_deg, found.roll_deg) == (-170.0, -84.0, 0.5)
    assert len({found is None for found in told.values()}) == 2


def test_telemetry_that_lags_is_taken_from_later(film: Path, tmp_path: Path) -> None:
    telemetry = read_telemetry(film.with_suffix(".srt"))
    late = make_stills(film, telemetry, tmp_path, StillsOptions(telemetry_late_s=0.2, keyframes=_FEW))
    file = sorted(late.folder.glob("*.jpg"))[0]
    there = geopose_from_camera(_pose(int(file.stem) + 2), FRAME)
    assert read_exif(file.read_bytes()).longitude_deg == pytest.approx(there.longitude_deg, abs=2e-8)


def test_the_lag_is_looked_for_and_what_was_found_is_said(film: Path, tmp_path: Path) -> None:
    """Not much of a curve in five seconds: no lag is believed, and none is applied."""
    options = StillsOptions(keyframes=_FEW)
    stills = make_stills(film, read_telemetry(film.with_suffix(".srt")), tmp_path, options)
    assert stills.late_s == 0.0
    assert any("lag" in note for note in stills.notes)


@pytest.mark.evaluation
def test_other_telemetry_and_other_names_are_made_anew(film: Path, tmp_path: Path) -> None:
    """The same file name with other positions; the same film under another name."""
    telemetry = read_telemetry(film.with_suffix(".srt"))
    first = make_stills(film, telemetry, tmp_path / "work")
    moved = tmp_path / film.with_suffix(".srt").name
    moved.write_text(film.with_suffix(".srt").read_text().replace("[latitude: 4", "[latitude: 3"))
    second = make_stills(film, read_telemetry(moved), tmp_path / "work")
    latitudes = [
        read_exif(sorted(s.folder.glob("*.jpg"))[0].read_bytes()).latitude_deg for s in (first, second)
    ]
    assert latitudes[0] is not None
    assert latitudes[1] is not None
    assert latitudes[0] - latitudes[1] == pytest.approx(10.0, abs=1e-3)
    renamed = tmp_path / "renamed.mp4"
    renamed.write_bytes(film.read_bytes())
    for name in (film, renamed):
        stills = make_stills(name, None, tmp_path / "work")
        assert len(list(stills.folder.glob("*.jpg"))) == _photos(stills)
    # A photo that somebody deleted is made again.
    next(iter(first.folder.glob("*.jpg"))).unlink()
    again = make_stills(film, telemetry, tmp_path / "work")
    assert len(list(again.folder.glob("*.jpg"))) == _photos(first)


def test_telemetry_that_cannot_place_the_film_is_refused_at_once(
    film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = _log(tmp_path / "log.csv")
    database = str(tmp_path / "db")
    command = ["ingest", "video", database, str(film), "--quiet", "--telemetry"]
    for more, said in (
        (
            [],
            "log.csv has positions from 2026-05-01T12:00:00.0Z to 2026-05-01T12:00:19.0Z; hills.mp4 has less",
        ),
        (["--film-start", "2026-05-01T11:00:00Z"], "has no moment in common with it"),
        (["--film-start", "2026-05-01T12:00:03"], "name the zone"),
        (["--telemetry-late", "0.2"], "give --film-start"),
        (["--no-telemetry"], "--no-telemetry: expected no --telemetry beside it"),
    ):
        assert main([*command, str(log), *more]) == 2
        assert said in capsys.readouterr().err
    for name, content in (
        ("a.gpx", b"<gpx><trk>"),
        ("b.csv", b"x,y\n1,2\n"),
        ("c.srt", b""),
        ("d.mp4", b"no"),
    ):
        (tmp_path / name).write_bytes(content)
        assert main([*command, str(tmp_path / name)]) == 2
        assert capsys.readouterr().err.startswith(f"featuredb: {name}: ")
    assert not (tmp_path / "db").exists()
    relative = tmp_path / "relative.srt"
    text = film.with_suffix(".srt").read_text()
    relative.write_text(re.sub(r" abs_alt: [\d.]+", "", text))
    assert main([*command, str(relative), "--height-datum", "egm96"]) not in (0, 1)
    assert "above the place of take-off only" in capsys.readouterr().err
    assert not (tmp_path / "db").exists()


def _log(path: Path) -> Path:
    """Places of the film, a row a second, from three seconds before it begins; it stands before and after."""
    places = [
        geopose_from_camera(_pose(min(max(0, round(_RATE_HZ * (k - 3.0))), 47)), FRAME) for k in range(20)
    ]
    rows = [
        f"2026-05-01T12:00:{k:02d}Z,{p.latitude_deg:.9f},{p.longitude_deg:.9f},{p.height_m:.4f}\n"
        for k, p in enumerate(places)
    ]
    path.write_text("time,latitude,longitude,height\n" + "".join(rows))
    return path


def _gpx(log: Path, path: Path) -> Path:
    """The same as a track."""
    points = [row.split(",") for row in log.read_text().splitlines()[1:]]
    path.write_text(
        "<gpx><trk><trkseg>"
        + "".join(
            f'<trkpt lat="{p[1]}" lon="{p[2]}"><ele>{p[3]}</ele><time>{p[0]}</time></trkpt>' for p in points
        )
        + "</trkseg></trk></gpx>"
    )
    return path


@pytest.mark.parametrize("kind", ["csv", pytest.param("gpx", marks=pytest.mark.evaluation)])
def test_a_log_places_the_film_where_it_is_told_to_begin(film: Path, tmp_path: Path, kind: str) -> None:
    log = _log(tmp_path / "log.csv")
    telemetry = read_telemetry(log if kind == "csv" else _gpx(log, tmp_path / "log.gpx"))
    begins = film_start("2026-05-01T14:00:03+02:00", telemetry)
    options = StillsOptions(film_start_s=begins, keyframes=_FEW)
    stills = make_stills(film, telemetry, tmp_path, options)
    assert stills.late_s == 3.0
    assert stills.positions == _photos(stills) > 2
    assert any("as was told" in note for note in stills.notes)
    for file in stills.folder.glob("*.jpg"):
        # Between rows a second apart the drone flies straight, but for one corner of its way.
        place, told = geopose_from_camera(_pose(int(file.stem)), FRAME), read_exif(file.read_bytes())
        assert told.latitude_deg == pytest.approx(place.latitude_deg, abs=5.0 / 111_000)
        assert told.longitude_deg == pytest.approx(place.longitude_deg, abs=5.0 / 73_000)
    # Other clocks are other photos, and beside control points a log that does not fit is only told.
    again = make_stills(film, telemetry, tmp_path, replace(options, telemetry_late_s=1.0))
    assert (again.late_s, again.folder == stills.folder) == (4.0, False)
    without = make_stills(film, telemetry, tmp_path, StillsOptions(positions=False, keyframes=_FEW))
    assert (without.late_s, without.positions) == (None, 0)
    assert any("less than 40 s of movement" in note for note in without.notes)


def test_a_log_that_cannot_be_laid_writes_nothing(film: Path, tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="less than 40 s of movement"):
        make_stills(film, read_telemetry(_log(tmp_path / "log.csv")), tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_a_table_in_the_films_time_needs_no_clock(film: Path, tmp_path: Path) -> None:
    rows = _log(tmp_path / "log.csv").read_text().splitlines()[1:]
    table = tmp_path / "film.csv"
    table.write_text(
        "film_time_s,latitude,longitude,height\n"
        + "".join(f"{k - 3}{row[row.index(',') :]}\n" for k, row in enumerate(rows))
    )
    telemetry = read_telemetry(table)
    assert telemetry.in_video_time
    stills = make_stills(
        film, telemetry, tmp_path / "work", StillsOptions(telemetry_late_s=0.0, keyframes=_FEW)
    )
    assert stills.positions == _photos(stills)


def test_a_film_that_stands_still_is_one_photo_and_no_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = _render(field_texture(1), _pose(0), 0)
    with VideoWriter(tmp_path / "still.mp4", width=CAMERA.width, height=CAMERA.height, fps=10.0) as writer:
        for _ in range(12):
            writer.write(picture)
    assert main(["ingest", "video", str(tmp_path / "db"), str(tmp_path / "still.mp4"), "--quiet"]) == 2
    assert "two keyframes are needed" in capsys.readouterr().err
    assert len(list(tmp_path.rglob("*.jpg"))) == 1
    (shot,) = make_stills(tmp_path / "still.mp4", None, tmp_path / "work").shots
    assert shot.dropped == {"frozen": 11}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.mp4", None, "no such video"),
        ("empty.mp4", b"", "empty.mp4"),
        ("text.mp4", b"this is no film" * 100, "text.mp4"),
    ],
)
def test_what_is_no_film_is_refused_and_leaves_nothing(
    name: str, content: bytes | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    code = main(["ingest", "video", str(tmp_path / "db"), str(tmp_path / name), "--quiet"])
    assert code not in (0, 1)
    assert message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.jpg"))


def test_a_folder_without_films_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"")
    assert main(["ingest", "video", str(tmp_path / "db"), str(tmp_path), "--quiet"]) not in (0, 1)
    said = capsys.readouterr().err
    assert "1 files are no films by their names" in said
    assert "featuredb ingest photos" in said
