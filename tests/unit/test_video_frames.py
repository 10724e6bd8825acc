"""Films to frames: order, times, stretches, what is known of a film, options, memory."""

import subprocess
import sys
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from featuredb.errors import InvalidValueError, VideoError
from featuredb.video.film import VideoFrame, VideoOptions
from featuredb.video.frames import open_video
from tests.support.films import HEIGHT, KINDS, WIDTH, film, read, shown, write_film


@pytest.mark.parametrize("kind", KINDS)
def test_every_frame_comes_in_order_at_its_time(tmp_path: Path, kind: str) -> None:
    path = film(tmp_path, kind)
    with open_video(path) as video:
        frames = list(video)
        report = video.report
    assert [shown(frame.gray) for frame in frames] == list(range(30))
    assert [frame.index for frame in frames] == list(range(30))
    start_s = frames[0].time_s
    assert [frame.time_s - start_s for frame in frames] == pytest.approx(
        [i / 25 for i in range(30)], abs=1e-3
    )
    # A transport stream begins at any time of its clock, which is taken off but for the codec's delay.
    assert start_s == pytest.approx(0.0, abs=0.1 if kind == "ts" else 1e-9)
    assert (video.info.width, video.info.height, video.info.rotation_deg) == (WIDTH, HEIGHT, 0)
    assert (report.undecodable, report.damaged, report.missing) == (0, 0, 0)
    assert not report.complaints()
    assert report.at_end


@pytest.mark.parametrize("kind", ["mp4", "mkv", "avi", "ts", "old.avi", "b.avi", "webm"])
@pytest.mark.parametrize(
    ("start_s", "end_s"), [(0.0, 0.3), (0.48, None), (0.5, 1.0), (0.93, 1.3), (1.9, None)]
)
def test_a_stretch_has_the_frames_of_the_whole_film_in_it(
    tmp_path: Path, kind: str, start_s: float, end_s: float | None
) -> None:
    path = film(tmp_path, kind, 50)
    expected = [f for f in read(path) if start_s <= f.time_s and (end_s is None or f.time_s < end_s)]
    found = read(path, start_s=start_s, end_s=end_s)
    assert [frame.time_s for frame in found] == [frame.time_s for frame in expected]
    assert [frame.index for frame in found] == list(range(len(expected)))
    for frame, same in zip(found, expected, strict=True):
        np.testing.assert_array_equal(frame.gray, same.gray)


def test_an_index_that_leads_past_the_start_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of films whose key frames are decoded long before they are shown."""
    path = film(tmp_path, "mp4", 50)
    for margins_s in ((-0.8, 1.0), (-0.8, -0.5)):
        monkeypatch.setattr("featuredb.video.frames._SEEK_MARGINS_S", margins_s)
        assert [shown(frame.gray) for frame in read(path, start_s=0.6)] == list(range(15, 50))


def test_a_transport_stream_begins_anywhere(tmp_path: Path) -> None:
    times_s = [1000.0 + i / 25 for i in range(12)]
    frames = read(write_film(tmp_path / "film.ts", container="mpegts", times_s=times_s))
    assert frames[0].time_s == pytest.approx(0.0, abs=0.1)
    assert frames[-1].time_s - frames[0].time_s == pytest.approx(11 / 25)


def test_a_stretch_past_the_end_is_empty(tmp_path: Path) -> None:
    assert read(film(tmp_path, "mp4"), start_s=50.0) == []


def test_variable_rate_keeps_each_frames_own_time(tmp_path: Path) -> None:
    times_s = [0.0, 0.033, 0.1, 0.5, 0.51, 0.9, 1.7, 1.75, 1.8, 2.4, 2.5, 4.0]
    for name in ("film.mp4", "film.mkv", "film.mov"):
        frames = read(write_film(tmp_path / name, times_s=times_s))
        assert [frame.time_s for frame in frames] == pytest.approx(times_s, abs=1e-3)
        assert [shown(frame.gray) for frame in frames] == list(range(12))


def test_a_film_that_begins_late_keeps_its_time(tmp_path: Path) -> None:
    """Telemetry lies on the container's time line, where a camera's picture may begin after its sound."""
    times_s = [1.5 + i / 25 for i in range(12)]
    assert [f.time_s for f in read(write_film(tmp_path / "film.mp4", times_s=times_s))] == pytest.approx(
        times_s
    )


def test_tags_of_a_phone(tmp_path: Path) -> None:
    path = write_film(
        tmp_path / "IMG_0001.mov",
        container_options={"movflags": "use_metadata_tags"},
        tags={
            "com.apple.quicktime.make": "Apple",
            "com.apple.quicktime.model": "iPhone 12",
            "com.apple.quicktime.creationdate": "2024-05-06T09:08:09+0200",
            "creation_time": "2024-06-01T00:00:00Z",  # of the export
        },
    )
    with open_video(path) as video:
        info = video.info
    assert (info.name, info.make, info.model) == ("IMG_0001.mov", "Apple", "iPhone 12")
    assert info.creation_time == datetime(2024, 5, 6, 9, 8, 9, tzinfo=timezone(timedelta(hours=2)))
    assert info.frame_count == 12
    assert info.duration_s == pytest.approx(12 / 25)
    assert not info.live


def test_odd_tags_are_no_reason_to_refuse(tmp_path: Path) -> None:
    path = write_film(
        tmp_path / "film.mp4", tags={"comment": "QQQQ", "creation_time": "2024-06-01T00:00:00Z"}
    )
    path.write_bytes(path.read_bytes().replace(b"QQQQ", b"\xff\xfe\x80Q"))
    with open_video(path) as video:
        assert video.info.creation_time == datetime(2024, 6, 1, tzinfo=UTC)
        assert len(list(video)) == 12


@pytest.mark.real_data
def test_karma(shared_data: Path) -> None:
    """A GoPro on a drone, 29.97 Hz, full range; the camera names itself only in its stream's handler."""
    path = shared_data / "video" / "karma.mp4"
    if not path.is_file():
        pytest.skip(f"the film is not there: {path}")
    with open_video(path) as video:
        info, times, count = video.info, [], 0
        for frame in video:
            times.append(frame.time_s)
            count += 1
            assert frame.gray.shape == (480, 854)
        report = video.report
    assert (info.width, info.height, info.rotation_deg, info.frame_count) == (854, 480, 0, 362)
    assert info.make == "GoPro"
    assert info.creation_time == datetime(2017, 4, 17, 19, 27, 57, tzinfo=UTC)
    assert count == 362
    assert times == pytest.approx([i * 1001 / 30_000 for i in range(362)], abs=1e-4)
    assert not report.complaints()
    later = read(path, start_s=6.0, end_s=6.5, max_side_px=400)
    assert [f.time_s for f in later] == [t for t in times if 6.0 <= t < 6.5]
    assert later[0].gray.shape == (225, 400)


def test_a_film_is_read_once_and_while_it_is_open(tmp_path: Path) -> None:
    path = film(tmp_path, "mp4")
    with open_video(path) as video:
        frames = iter(video)
        next(frames)
        with pytest.raises(InvalidValueError, match=r"film\.mp4: a film is read once"):
            iter(video)
    with pytest.raises(VideoError, match="is closed"):
        list(frames)
    video.close()  # twice is no harm


@pytest.mark.parametrize("start_s", [None, 0.2])
@pytest.mark.parametrize("count", range(13))
def test_a_film_may_be_closed_at_any_frame(tmp_path: Path, count: int, start_s: float | None) -> None:
    """In PyAV, going on to read a closed container ends the process."""
    video = open_video(film(tmp_path, "mp4", 18), VideoOptions(start_s=start_s))
    frames = iter(video)
    kept = [next(frames) for _ in range(count)]
    video.close()
    with pytest.raises(VideoError, match="is closed"):
        next(frames)
    first = 0 if start_s is None else 5
    assert [shown(frame.rgb()[:, :, 0]) for frame in kept] == list(range(first, first + count))


def test_memory_stays_bounded(tmp_path: Path) -> None:
    """Reading 400 frames of 1.4 MB as 4:2:0 keeps no more than a few of them."""
    path = write_film(
        tmp_path / "film.mp4",
        [np.full((960, 960, 3), i % 250, np.uint8) for i in range(40)] * 10,
        options={"preset": "ultrafast"},
    )
    code = (
        "import resource, sys\n"
        "from pathlib import Path\n"
        "from featuredb.video.frames import open_video\n"
        "kib = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "with open_video(Path(sys.argv[1])) as video:\n"
        "    for frame in video:\n"
        "        frame.rgb()\n"
        "        if frame.index == 50: before = kib()\n"
        "print(frame.index, kib() - before)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True, timeout=300
    )
    last, grown_kib = (int(word) for word in done.stdout.split())
    assert last == 399
    assert grown_kib < 20_000


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_side_px": 1.5},
        {"max_side_px": 0},
        {"fps": 0.0},
        {"fps": float("nan")},
        {"start_s": 2.0, "end_s": 1.0},
        {"start_s": float("inf")},
    ],
)
def test_options_are_checked(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong)).removesuffix("_s")):
        VideoOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wrong",
    [
        {"gray": np.zeros((2, 2, 3), np.uint8)},
        {"gray": np.zeros((2, 2), np.float32)},
        {"index": -1},
        {"time_s": float("nan")},
    ],
)
def test_frames_check_themselves(wrong: dict[str, object]) -> None:
    right = {
        "index": 0,
        "time_s": 0.0,
        "gray": np.zeros((2, 2), np.uint8),
        "rgb": lambda: np.zeros((2, 2, 3), np.uint8),
    }
    VideoFrame(**right)  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="expected"):
        VideoFrame(**{**right, **wrong})  # type: ignore[arg-type]
