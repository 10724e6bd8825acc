"""Where films come from: files, pipes, addresses, playlists, and sources that fall silent."""

import functools
import http.server
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from featuredb.errors import VideoError
from featuredb.video import opening
from featuredb.video.film import VideoOptions
from featuredb.video.frames import open_video
from tests.support.films import (
    film,
    picture,
    read,
    shown,
    write_film,
    write_sound,
)


def _piped(folder: Path, data: bytes) -> Path:
    """A pipe that the bytes come out of."""
    fifo = folder / "live"
    os.mkfifo(fifo)
    threading.Thread(target=fifo.write_bytes, args=(data,), daemon=True).start()
    return fifo


@pytest.mark.parametrize("kind", ["mkv", "ts", "avi", "mp4"])
def test_a_source_that_cannot_be_sought_in(tmp_path: Path, kind: str) -> None:
    path = film(tmp_path, kind)
    if kind == "mp4":
        path = write_film(
            tmp_path / "front.mp4",
            [picture(i) for i in range(30)],
            container_options={"movflags": "faststart"},
        )
    expected = [frame.time_s for frame in read(path) if frame.time_s >= 0.5]
    with open_video(_piped(tmp_path, path.read_bytes()), VideoOptions(start_s=0.5)) as video:
        assert video.info.live
        assert video.info.duration_s is None
        frames = list(video)
    assert [frame.time_s for frame in frames] == expected
    assert shown(frames[-1].gray) == 29


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """An HTTP server of the folder that cannot serve ranges, so that nothing can be sought in."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_film_over_http(tmp_path: Path, server: str) -> None:
    film(tmp_path, "ts")
    with open_video(f"{server}/film.ts") as video:
        assert video.info.live
        assert [shown(frame.gray) for frame in video] == list(range(30))


def test_an_address_without_a_film(server: str) -> None:
    with pytest.raises(VideoError, match=r"none\.mp4.*404"):
        open_video(f"{server}/none.mp4")


def test_a_silent_source_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("featuredb.video.opening._TIMEOUT_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        for scheme in ("http", "tcp", "rtsp"):
            with pytest.raises(
                VideoError, match=r"@?127\.0\.0\.1.*(nothing came within 0\.5 s|not a film)"
            ) as caught:
                open_video(f"{scheme}://someone:secret@127.0.0.1:{port}/live")
            assert "secret" not in str(caught.value)


def test_a_source_that_falls_silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("featuredb.video.opening._TIMEOUT_S", 1.0)
    less = {"probesize": "4000", "analyzeduration": "100000"}
    monkeypatch.setattr("featuredb.video.opening._OF_NETWORK", opening._OF_NETWORK | less)
    data = film(tmp_path, "ts").read_bytes()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        done = threading.Event()

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.sendall(data[: len(data) * 2 // 3])
                done.wait(30.0)

        threading.Thread(target=serve, daemon=True).start()
        frames = []
        try:
            with open_video(f"tcp://127.0.0.1:{listening.getsockname()[1]}") as video:
                reading = iter(video)
                with pytest.raises(VideoError, match="nothing came within the timeout"):
                    frames.extend(iter(lambda: next(reading), None))
        finally:
            done.set()
    assert [shown(frame.gray) for frame in frames] == list(range(len(frames)))
    assert len(frames) > 8


@pytest.mark.parametrize("address", ["concat://a|b", "ftp://127.0.0.1/film.mp4"])
def test_unknown_addresses_are_refused(address: str) -> None:
    with pytest.raises(VideoError, match="expected a path, or an address of one of rtsp"):
        open_video(address)


def test_names_that_look_like_protocols(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("tcp:2.mp4", "concat:film.mp4", "100%.mp4", "über film.mp4"):
        path = write_film(tmp_path / "film.mp4").rename(tmp_path / name)
        assert len(read(path)) == 12
        assert len(read(name)) == 12


def test_a_playlist_is_no_film(tmp_path: Path) -> None:
    """Else a stranger's text file would make the server read other files and addresses."""
    film(tmp_path, "ts")
    for name in ("list.m3u8", "list.mp4"):
        playlist = tmp_path / name
        playlist.write_text("#EXTM3U\n#EXT-X-TARGETDURATION:2\n#EXTINF:1.2,\nfilm.ts\n#EXT-X-ENDLIST\n")
        with pytest.raises(VideoError, match=r"list\..*found a file that begins with b'#EXTM3U"):
            open_video(playlist)


def test_a_fifo(tmp_path: Path) -> None:
    with open_video(_piped(tmp_path, film(tmp_path, "mkv").read_bytes())) as video:
        assert video.info.live
        assert [shown(frame.gray) for frame in video] == list(range(30))


def test_sound_is_no_film(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"sound\.mp4: expected a film, found only audio"):
        open_video(write_sound(tmp_path / "sound.mp4"))
