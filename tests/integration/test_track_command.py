"""`featuredb track`: films tracked by maps, and what is said of those that cannot be."""

import csv
import json
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import VideoError
from featuredb.video.frames import open_video
from featuredb.video.writer import VideoWriter
from tests.support.hill_photos import CAMERA, FRAME, _render
from tests.support.hill_walk import anchored_database
from tests.support.made_once import made_once
from tests.support.planar_map import field_texture
from tests.support.tracked_film import FRAMES, film_frames, pose_at

Track = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def anchored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once("anchored-hills", anchored_database, tmp_path_factory) / "db"


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    return film_frames(tmp_path_factory)


@pytest.fixture(scope="module")
def folder(anchored: Path, film: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database, and the film as an mp4."""
    folder = tmp_path_factory.mktemp("film")
    with VideoWriter(folder / "film.mp4", width=CAMERA.width, height=CAMERA.height, fps=30.0) as writer:
        for gray in film:
            writer.write(gray)
    return folder


@pytest.fixture
def track(
    anchored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Track:
    """Tracks a film, by its path and options, from an empty folder; exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def run(film: Path, *words: str) -> tuple[int, str, str]:
        code = main(["track", str(anchored), str(film), *words])
        return code, *capsys.readouterr()

    return run


_LENS = f"{CAMERA.model},{CAMERA.width},{CAMERA.height},{','.join(map(str, CAMERA.params))}"


def test_the_command_tracks_a_film(folder: Path, tmp_path: Path, track: Track) -> None:
    files = [tmp_path / f"out/track.{kind}" for kind in ("csv", "tum", "geojson", "kml", "json")]
    outs = [text for file in files for text in ("--out", str(file))]
    overlay = tmp_path / "overlay.mp4"
    drawn_to = ["--overlay", str(overlay)]
    code, out, _ = track(folder / "film.mp4", *outs, "--camera", _LENS, "--json", *drawn_to)
    summary = json.loads(out)
    assert code == 0
    assert summary["frames"] == FRAMES
    assert summary["written"] == [*map(str, files), str(overlay)]
    rows = list(csv.DictReader(files[0].read_text().splitlines()))
    assert len(rows) == FRAMES
    states = [row["state"] for row in rows]
    # The default settings have a keyframe every twelfth frame: the film of elsewhere is lost, what is between
    # a localised frame and its answer is not.
    assert states[:20] == ["relocalised", *["tracking"] * 19]
    assert states[20:24] == ["lost"] * 4
    assert summary["lost"] == states.count("lost")
    for row in rows:
        if row["state"] == "lost":
            assert row["detail"]
            continue
        utm = [float(row[name]) for name in ("easting", "northing", "height")]
        true = FRAME.utm_from_enu(pose_at(int(row["frame"])).center, int(row["epsg"]))
        assert np.linalg.norm(np.array(utm) - true) < 0.3, row["frame"]
    with open_video(overlay) as drawn:
        assert sum(1 for _ in drawn) == FRAMES


def test_a_film_of_elsewhere_gives_a_table_of_reasons(tmp_path: Path, track: Track) -> None:
    other = field_texture(9)
    with VideoWriter(tmp_path / "film.mp4", width=CAMERA.width, height=CAMERA.height, fps=30.0) as writer:
        for i in range(10):
            writer.write(_render(other, pose_at(i), i))
    code, said, _ = track(tmp_path / "film.mp4", "--out", "t.csv", "--out", "t.kml")
    assert code == 1
    assert "10 frames, 0 tracked, 0 relocalised, 10 lost" in said
    assert {row["state"] for row in csv.DictReader((tmp_path / "t.csv").read_text().splitlines())} == {"lost"}
    assert not (tmp_path / "t.kml").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--out", "t.txt"], "expected a name that ends in .csv"),
        (["--out", "t.csv", "--camera", "PINHOLE,640"], "--camera: expected MODEL,WIDTH,HEIGHT"),
        (["--out", "t.csv", "--camera", "PINHOLE,640,640,600,600,320,320"], "differ in aspect ratio"),
        (["--out", "t.csv", "--prior", "north"], "--prior: expected LAT,LON,SIGMA_M"),
        (["--out", "t.csv", "--start", "60"], "the film is 1.5 s long"),
        (["--out", "t.csv", "--map", "nobody"], "nobody"),
    ],
)
def test_bad_requests_say_what_is_wrong_and_write_nothing(
    change: list[str], message: str, folder: Path, tmp_path: Path, track: Track
) -> None:
    code, _, said = track(folder / "film.mp4", *change, "--overlay", "o.mp4")
    assert code not in (0, 1)
    assert message in said
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_drawn_is_tracked(
    folder: Path, tmp_path: Path, track: Track, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full, and a hand that ends the film."""

    def full(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)
        raise VideoError("o.mp4: the film cannot be written: No space left on device")

    monkeypatch.setattr(VideoWriter, "write", full)
    code, _, said = track(folder / "film.mp4", "--out", "t.csv", "--overlay", "o.mp4")
    assert code == 2
    assert "o.mp4: the film cannot be written" in said
    assert "stopped by hand; what was written is a part" in said
    assert [file.name for file in tmp_path.iterdir()] == ["t.csv"]


def test_a_broken_film_says_so_and_writes_nothing(folder: Path, tmp_path: Path, track: Track) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes((folder / "film.mp4").read_bytes()[:2000])
    code, _, said = track(broken, "--out", "t.csv")
    assert code == 2
    assert "broken.mp4" in said
    assert [f.name for f in tmp_path.iterdir()] == ["broken.mp4"]
