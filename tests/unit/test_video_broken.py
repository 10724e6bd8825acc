"""Files that are no films, or not whole ones: each refusal says what was found and what to do."""

import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from featuredb.errors import VideoError
from featuredb.video import frames, opening
from featuredb.video.frames import open_video
from tests.support.films import (
    HEIGHT,
    WIDTH,
    film,
    overwritten,
    picture,
    read,
    shown,
    write_film,
    write_sound,
)


def _long(path: Path, **how: Any) -> Path:
    """48 frames with a key frame every 12."""
    return write_film(path, [picture(i) for i in range(48)], **how)


def _packets(path: Path) -> list[tuple[int, int]]:
    """(position, size) in the file of each packet, in decoding order."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


def _refused(path: Path) -> str:
    with pytest.raises(VideoError) as caught, open_video(path) as video:
        list(video)
    assert str(caught.value).startswith(path.name)
    return str(caught.value)


def test_files_that_are_no_films(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(b"")
    assert "the file is empty; copy it again" in _refused(path)
    path.write_bytes(b"<html>404</html>" * 100)
    assert "expected mp4, mov, mkv, webm, avi or ts, found a file that begins with b'<html>404" in _refused(
        path
    )
    path.write_bytes(np.random.default_rng(5).bytes(20_000))
    assert "found a file that begins with" in _refused(path)
    cv2.imwrite(str(tmp_path / "photo.jpg"), picture(0))
    assert "found a file that begins with" in _refused(tmp_path / "photo.jpg")


def test_places_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"none\.mp4: the film cannot be opened: No such file"):
        open_video(tmp_path / "none.mp4")
    with pytest.raises(VideoError, match="cannot be opened"):
        open_video("film\0.mp4")
    with pytest.raises(VideoError, match="cannot be opened"):
        open_video(Path("/dev/null"))


def test_an_mp4_without_its_index(tmp_path: Path) -> None:
    """What a camera leaves whose battery runs out, and what half a copy is."""
    data = _long(tmp_path / "film.mp4").read_bytes()
    path = tmp_path / "cut.mp4"
    path.write_bytes(data[: data.index(b"moov") - 4])
    assert (
        "without its index: found the boxes ftyp, free, mdat, no moov. The recording or the copy"
        in _refused(path)
    )
    path.write_bytes(data[: len(data) // 2])
    assert "without its index" in _refused(path)
    at = data.index(b"moov")
    path.write_bytes(overwritten(data, at + 4, len(data) - at - 4))
    assert "expected a film, found no stream in it; it has no frames, or its index is broken" in _refused(
        path
    )


def test_sound_alone_and_a_cover_picture(tmp_path: Path) -> None:
    assert "expected a film, found only audio" in _refused(write_sound(tmp_path / "sound.mp4"))
    assert "expected a film, found only audio" in _refused(write_sound(tmp_path / "sound.mkv"))
    song = tmp_path / "song.mp4"
    with av.open(str(write_sound(tmp_path / "plain.mp4"))) as sound, av.open(str(song), "w") as out:
        copied = out.add_stream_from_template(sound.streams.audio[0])
        cover: Any = out.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        frame = av.VideoFrame.from_ndarray(picture(0), "rgb24").reformat(format="yuvj420p")
        frame.pts = 0
        out.mux(cover.encode(frame))
        out.mux(cover.encode(None))
        for packet in sound.demux(audio=0):
            if packet.dts is not None:
                packet.stream = copied
                out.mux(packet)
    with av.open(str(song)) as container:
        assert container.streams.video[0].disposition & av.stream.Disposition.attached_pic
    assert "expected a film, found only audio, video" in _refused(song)


def test_the_film_beside_its_preview(tmp_path: Path) -> None:
    """Drones and action cameras store a small picture track first or last."""
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as out:
        streams: list[Any] = []
        for width, height in ((64, 48), (WIDTH, HEIGHT)):
            stream: Any = out.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            streams.append(stream)
        for index in range(6):
            for stream in streams:
                rgb = picture(index)[: stream.height, : stream.width]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), "rgb24")
                frame.pts, frame.time_base = index, Fraction(1, 25)
                out.mux(stream.encode(frame))
        for stream in streams:
            out.mux(stream.encode(None))
    assert [shown(frame.gray) for frame in read(path)] == list(range(6))


def test_no_frame_at_all(tmp_path: Path) -> None:
    path = _long(tmp_path / "film.mp4")
    start, _ = _packets(path)[0]
    last, size = _packets(path)[-1]
    path.write_bytes(overwritten(path.read_bytes(), start, last + size - start))
    assert "no frame of its h264 video can be decoded; 48 packets could not be decoded" in _refused(path)


def _limit(monkeypatch: pytest.MonkeyPatch, side_px: int, pixels: int) -> None:
    monkeypatch.setattr(opening, "MAX_FULL_SIDE_PX", side_px)
    monkeypatch.setattr(opening, "MAX_FULL_PIXELS", pixels)


def test_films_that_are_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_film(tmp_path / "film.mp4")
    _limit(monkeypatch, 150, 1 << 27)
    assert "160x120 pixels, the limit is 150 a side and 134 million" in _refused(path)
    _limit(monkeypatch, 16_384, 19_199)
    assert "160x120 pixels, the limit is 16384 a side and 0 million" in _refused(path)
    _limit(monkeypatch, 160, 19_200)
    assert len(read(path)) == 12


def _huge_header(folder: Path) -> bytes:
    """An AVI whose header asks for 40000x40000 pixels of RGB, 4.8 GB."""
    raw = write_film(folder / "raw.avi", codec="rawvideo", pixel_format="bgr24")
    data = bytearray(raw.read_bytes())
    at = data.index(b"strf") + 12
    assert int.from_bytes(data[at : at + 4], "little") == WIDTH
    data[at : at + 8] = (40_000).to_bytes(4, "little") * 2
    return bytes(data)


def _huge_pictures(folder: Path) -> bytes:
    """An AVI whose pictures ask for that, behind a header that asks for little."""
    data = bytearray(film(folder, "jpeg.avi").read_bytes())
    at = data.find(b"\xff\xc0")
    assert at > 0
    while at >= 0:
        data[at + 5 : at + 9] = (40_000).to_bytes(2, "big") * 2
        at = data.find(b"\xff\xc0", at + 2)
    return bytes(data)


@pytest.mark.parametrize("make", [_huge_header, _huge_pictures])
def test_nothing_is_allocated_for_an_absurd_size(tmp_path: Path, make: Callable[[Path], bytes]) -> None:
    path = tmp_path / "huge.avi"
    path.write_bytes(make(tmp_path))
    code = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from featuredb.errors import VideoError\n"
        "from featuredb.video.frames import open_video\n"
        "kib = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "before = kib()\n"
        "try: open_video(Path(sys.argv[1]))\n"
        "except VideoError as error: print(kib() - before, error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True, timeout=120
    )
    grown_kib, _, said = done.stdout.partition(" ")
    assert int(grown_kib) < 100_000
    assert "video can be decoded" in said


def test_pictures_larger_than_their_header_says_are_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = bytearray(film(tmp_path, "jpeg.avi").read_bytes())
    at = data.index(b"strf") + 12
    data[at : at + 8] = (8).to_bytes(4, "little") * 2
    path = tmp_path / "small.avi"
    path.write_bytes(bytes(data))
    assert len(read(path)) == 30  # a header that says less is no harm by itself
    _limit(monkeypatch, 8, 64)
    most = 64 + 2 * 128 * 8
    monkeypatch.setattr(opening, "MAX_CODED_PIXELS", most)
    monkeypatch.setattr(frames, "MAX_CODED_PIXELS", most)
    assert "no frame of its mjpeg video can be decoded" in _refused(path)


def test_a_film_that_changes_its_size(tmp_path: Path) -> None:
    """A transport stream of two cameras, one after the other."""
    first = film(tmp_path, "ts", 10).read_bytes()
    small = [np.ascontiguousarray(picture(i)[:96, :128]) for i in range(10)]
    times_s = [5.0 + i / 25 for i in range(10)]
    second = write_film(tmp_path / "b.ts", small, container="mpegts", times_s=times_s).read_bytes()
    path = tmp_path / "both.ts"
    path.write_bytes(first + second)
    with open_video(path) as video:
        frames = iter(video)
        assert [shown(next(frames).gray) for _ in range(10)] == list(range(10))
        with pytest.raises(
            VideoError, match=r"both\.ts: at .* s the pictures change from 160x120 to 128x96; split"
        ):
            next(frames)
