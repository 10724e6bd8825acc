"""`featuredb live`: a film streamed at its own speed to a server, and what is written of it."""

import csv
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from featuredb.cli.main import main
from featuredb.errors import ServiceError, VideoError
from featuredb.geo.geopose import BODY_AXES
from featuredb.video.writer import VideoWriter
from reloc.client import Client
from reloc.client.film import point_of_message, stream_film
from reloc.service.live.frames import pose_message
from reloc.service.server import Server
from reloc.wire.track import TrackPose
from tests.support.live import LENS, SOON_S, error_m, frame, localiser
from tests.support.planar_map import CAMERA
from tests.support.service import running_server

_FRAMES, _RATES_HZ = 40, (15.0, 5.0, 1.5)
_LENS = f"{CAMERA.model},{CAMERA.width},{CAMERA.height},{','.join(map(str, CAMERA.params))}"


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server(localiser()) as running:
        yield running


@pytest.fixture(scope="module")
def streamed(server: Server, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[TrackPose]]:
    """A film over one place, as slow as this machine needs to find it in good time, and its poses."""
    for rate_hz in _RATES_HZ:
        path = tmp_path_factory.mktemp("film") / f"still-{rate_hz:g}.mp4"
        with VideoWriter(path, width=CAMERA.width, height=CAMERA.height, fps=rate_hz) as writer:
            for _ in range(_FRAMES):
                writer.write(frame(0))
        poses = _streamed(server, path)
        if sum(pose.state == "tracking" for pose in poses) > _FRAMES // 2:
            break
    return path, poses


@pytest.fixture(scope="module")
def film(streamed: tuple[Path, list[TrackPose]]) -> Path:
    return streamed[0]


def _streamed(server: Server, film: Path) -> list[TrackPose]:
    poses: list[TrackPose] = []
    with Client(server.endpoints[0]) as client:
        stream_film(client, film, camera=LENS, on_pose=lambda pose, _: poses.append(pose))
    return poses


def _rate_hz(film: Path) -> float:
    return float(film.stem.removeprefix("still-"))


def test_the_command_streams_a_film_and_writes_its_track(
    server: Server, film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outs = [tmp_path / f"out/track.{kind}" for kind in ("csv", "tum", "geojson", "kml", "json")]
    told = [text for file in outs for text in ("--out", str(file))]
    where = ["--connect", server.endpoints[0], "--camera", _LENS]
    assert main(["live", str(film), *where, *told, "--json"]) == 0
    said = capsys.readouterr()
    poses = [TrackPose.model_validate_json(line) for line in said.out.splitlines()]
    assert f"{_FRAMES} frames" in said.err
    numbers = [pose.sequence for pose in poses]
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == _FRAMES - 1
    rows = list(csv.DictReader(outs[0].read_text().splitlines()))
    assert [int(row["frame"]) for row in rows] == numbers
    for row, pose in zip(rows, poses, strict=True):
        assert row["state"] == pose.state
        assert float(row["time_s"]) == pytest.approx(pose.sequence / _rate_hz(film), abs=1e-4)
        if pose.utm is not None:
            assert error_m((pose.utm.easting, pose.utm.northing, pose.utm.height), 0) < 0.3
    assert {"relocalised", "tracking"} <= {pose.state for pose in poses}
    assert all(file.exists() for file in outs)
    assert json.loads(said.out.splitlines()[-1])["latency_ms"] > 0


class OneFrame:
    """A camera whose second frame comes when the first one's pose has been told, or after a while."""

    def __init__(self) -> None:
        self.info = SimpleNamespace(live=True, name="camera", creation_time=None)
        self.report = SimpleNamespace(complaints=lambda: ())
        self.told = threading.Event()
        self.in_time = False

    def __enter__(self) -> "OneFrame":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __iter__(self) -> Iterator[SimpleNamespace]:
        gray = frame(0)
        yield SimpleNamespace(time_s=0.0, index=0, gray=gray)
        self.in_time = self.told.wait(SOON_S)
        yield SimpleNamespace(time_s=SOON_S, index=1, gray=gray)


def test_a_pose_does_not_wait_for_the_camera_s_next_frame(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = OneFrame()
    monkeypatch.setattr("reloc.client.film.open_video", lambda *_: camera)
    with Client(server.endpoints[0]) as client:
        found = stream_film(client, "camera", camera=LENS, on_pose=lambda *_: camera.told.set())
    assert camera.in_time
    assert found.sent == 2


def test_a_session_that_ends_before_the_first_frame_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    class Ended:
        opened, refusals = SimpleNamespace(snapshot=1), ()

        def __enter__(self) -> "Ended":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def __iter__(self) -> Iterator[TrackPose]:
            raise ServiceError("IDLE", "no frame came for 5 s")

    monkeypatch.setattr("reloc.client.film.open_video", lambda *_: OneFrame())
    client = SimpleNamespace(database="town", track=lambda *_: Ended())
    monkeypatch.setattr("time.sleep", lambda _, wait=time.sleep: wait(0.1))  # the session's end comes first
    found = stream_film(client, "camera", camera=LENS)  # type: ignore[arg-type]
    assert found.sent == 0
    assert any("no frame came for 5 s" in what for what in [found.lost])


def test_what_the_receiver_of_poses_raises_ends_the_stream(server: Server, film: Path) -> None:
    def closed(*_: object) -> None:
        raise BrokenPipeError

    with Client(server.endpoints[0]) as client, pytest.raises(BrokenPipeError):
        stream_film(client, film, camera=LENS, on_pose=closed)


def test_without_json_it_speaks_to_people(
    server: Server, film: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["live", str(film), "--connect", server.endpoints[0], "--camera", _LENS]) == 0
    said = capsys.readouterr().out
    assert "EPSG:32632 E 4567" in said
    assert "median" in said
    assert len(said.splitlines()) < _FRAMES / _rate_hz(film) + 10  # about a line a second


def test_what_cannot_be_streamed_says_why(
    server: Server, film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--connect", server.endpoints[0]]
    assert main(["live", str(film), *where, "--out", str(tmp_path / "t.txt")]) == 2
    assert "expected a name that ends in .csv" in capsys.readouterr().err
    assert main(["live", str(tmp_path / "none.mp4"), *where]) == 2
    assert "none.mp4" in capsys.readouterr().err
    assert main(["live", str(film), *where, "--start", "60"]) == 2
    assert "no frames" in capsys.readouterr().err
    assert main(["live", str(film), *where, "--camera", "PINHOLE,100,100,90,90,50,50", "--end", "0.3"]) == 1
    assert "640x480" in capsys.readouterr().out


def test_a_film_that_cannot_be_read_opens_no_session(server: Server, tmp_path: Path) -> None:
    before = server.status().live
    (tmp_path / "broken.mp4").write_bytes(b"no film")
    with Client(server.endpoints[0]) as client, pytest.raises(VideoError):
        stream_film(client, tmp_path / "broken.mp4")
    after = server.status().live
    assert before is not None
    assert after is not None
    assert after.opened == before.opened


def test_a_pose_survives_the_wire(streamed: tuple[Path, list[TrackPose]]) -> None:
    known = next(pose for pose in streamed[1] if pose.state == "tracking")
    assert known.body_axes == BODY_AXES
    assert known.accuracy is not None
    point = point_of_message(TrackPose.model_validate_json(known.model_dump_json()))
    assert point.pose is not None
    again = pose_message(
        point,
        CAMERA,
        session=known.session,
        sequence=known.sequence,
        snapshot=known.snapshot,
        dropped=known.dropped,
        received_at=known.received_at,
        answered_at=known.answered_at,
        timings_ms=known.timings_ms,
    )
    assert again.utm == known.utm
    assert again.position == known.position
    assert np.allclose(again.covariance or (), known.covariance or ())
    # The radii are those of an independent draw from the covariance.
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(np.zeros(6), np.array(known.covariance), 20_000)
    inside = np.linalg.norm(drawn[:, 3:5], axis=1) < known.accuracy.horizontal_68_m
    assert inside.mean() == pytest.approx(0.68, abs=0.03)
