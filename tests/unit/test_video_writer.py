"""Written films: they show what was given at its times, appear whole or not at all, and come out the same."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from featuredb.atomic import atomic_file
from featuredb.errors import InvalidValueError, VideoError
from featuredb.video.frames import open_video
from featuredb.video.writer import VideoWriter, VideoWriterOptions
from tests.support.films import HEIGHT, WIDTH, picture, read, shown

COLOURS = np.array([[220, 40, 30], [30, 200, 60], [20, 60, 210], [128, 128, 128], [255, 255, 255], [0, 0, 0]])

# Without looking ahead, so that packets are written from the first frame on.
QUICK = VideoWriterOptions(preset="ultrafast")


def _write(path: Path, count: int = 12, fps: float | None = 25.0, **options: object) -> Path:
    with VideoWriter(
        path,
        width=WIDTH,
        height=HEIGHT,
        fps=fps,
        options=VideoWriterOptions(**options),  # type: ignore[arg-type]
    ) as writer:
        for index in range(count):
            writer.write(picture(index), None if fps is not None else index * 0.1)
    return path


def test_a_film_shows_what_was_written(tmp_path: Path) -> None:
    path = _write(tmp_path / "new" / "film.mp4")
    frames = read(path)
    assert [shown(frame.gray) for frame in frames] == list(range(12))
    assert [frame.time_s for frame in frames] == pytest.approx([i / 25 for i in range(12)], abs=1e-6)
    for index, frame in enumerate(frames):
        assert np.abs(frame.gray.astype(int) - picture(index)[:, :, 0]).mean() < 3.0
    with av.open(str(path)) as container:  # by libav alone
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 25
        times = [frame.pts * stream.time_base for frame in container.decode(stream)]
        assert times == [Fraction(i, 25) for i in range(12)]
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # so that browsers begin before all has come
    assert [found.name for found in path.parent.iterdir()] == ["film.mp4"]


@pytest.mark.parametrize(
    ("fps", "exact"), [(29.97, 30_000 / 1001), (23.976, 24_000 / 1001), (30.0, 30.0), (0.5, 0.5)]
)
def test_rates_mean_what_they_round(tmp_path: Path, fps: float, exact: float) -> None:
    path = _write(tmp_path / "film.mp4", fps=fps)
    with av.open(str(path)) as container:
        rate = container.streams.video[0].average_rate
        assert rate is not None
        assert float(rate) == pytest.approx(exact, rel=1e-9)
    frames = read(path)
    assert frames[-1].time_s == pytest.approx(11 / exact, rel=1e-5)


def test_frames_with_times_of_their_own(tmp_path: Path) -> None:
    times_s = [0.25, 0.26, 0.5, 0.9, 1.0, 2.5, 2.6]
    path = tmp_path / "film.mp4"
    with VideoWriter(path, width=WIDTH, height=HEIGHT, fps=None) as writer:
        for index, time_s in enumerate(times_s):
            writer.write(picture(index), time_s)
    with open_video(path) as video:
        frames = list(video)
    assert [frame.time_s for frame in frames] == pytest.approx(times_s, abs=1e-5)
    assert [shown(frame.gray) for frame in frames] == list(range(7))
    # With reordered frames it would be that of their decoding times, most of a second less.
    assert video.info.duration_s == pytest.approx(2.6 - 0.25, abs=0.05)
    assert not video.report.complaints()


def test_colours_and_greys(tmp_path: Path) -> None:
    patches = np.ascontiguousarray(COLOURS.astype(np.uint8).reshape(2, 3, 3).repeat(40, 0).repeat(40, 1))
    path = tmp_path / "film.mp4"
    with VideoWriter(path, width=120, height=80, fps=10.0, options=VideoWriterOptions(crf=4)) as writer:
        writer.write(patches)
        writer.write(patches[:, :, 1])
        writer.write(patches[:, ::-1].transpose(0, 1, 2)[:, ::-1])  # not contiguous
    frames = read(path)
    for frame, expected in ((frames[0], COLOURS), (frames[1], COLOURS[:, [1, 1, 1]]), (frames[2], COLOURS)):
        np.testing.assert_allclose(frame.rgb()[20::40, 20::40].reshape(6, 3), expected, atol=5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        # BT.709 of limited range, by name: players guess otherwise, and guess differently.
        assert (stream.colorspace, stream.color_range, stream.color_primaries, stream.color_trc) == (
            1,
            1,
            1,
            1,
        )


def test_quality_and_size(tmp_path: Path) -> None:
    """The better the quality that is asked for, the larger the film, and the nearer to what was written."""
    noise = np.random.default_rng(3).integers(0, 256, (HEIGHT // 2, WIDTH // 2), dtype=np.uint8)
    noise = np.ascontiguousarray(noise.repeat(2, 0).repeat(2, 1))
    sizes, errors = [], []
    for crf in (5, 20, 40):
        path = tmp_path / f"{crf}.mp4"
        with VideoWriter(
            path, width=WIDTH, height=HEIGHT, fps=25.0, options=VideoWriterOptions(crf=crf)
        ) as writer:
            writer.write(noise)
        sizes.append(path.stat().st_size)
        errors.append(np.abs(read(path)[0].gray.astype(int) - noise).mean())
    assert sizes[0] > 1.3 * sizes[1] > 1.3**2 * sizes[2]
    assert errors[0] < errors[1] < errors[2]


def test_the_same_frames_give_the_same_bytes_whatever_memory_holds(tmp_path: Path) -> None:
    """With x264's macroblock tree, a third to two thirds of these films differ."""
    rng = np.random.default_rng(1)
    films = set()
    for _ in range(40):
        # Freed memory with other content each time, for the encoder to find.
        _ = [np.full(size, size % 256, np.uint8) for size in rng.integers(1_000, 400_000, 20)]
        films.add(_write(tmp_path / "film.mp4").read_bytes())
    assert len(films) == 1


def test_tags(tmp_path: Path) -> None:
    path = _write(
        tmp_path / "film.mp4",
        tags={"creation_time": "2024-05-06T07:08:09Z", "com.apple.quicktime.model": "iPhone 12"},
    )
    with open_video(path) as video:
        assert video.info.model == "iPhone 12"
    assert video.info.creation_time == datetime(2024, 5, 6, 7, 8, 9, tzinfo=UTC)


def _fail_midway(writer: VideoWriter, folder: Path) -> None:
    for index in range(5):
        writer.write(picture(index))
    assert len(list(folder.iterdir())) == 2  # the part is there already
    raise RuntimeError("of the caller")


def test_an_error_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    path = _write(tmp_path / "film.mp4", 3)
    before = path.read_bytes()
    with (
        pytest.raises(RuntimeError, match="of the caller"),
        VideoWriter(path, width=WIDTH, height=HEIGHT, fps=25.0, options=QUICK) as writer,
    ):
        _fail_midway(writer, tmp_path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    _write(path, 5)
    assert len(read(path)) == 5


def test_a_film_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match=r"film\.mp4: expected at least one frame"):
        _write(tmp_path / "film.mp4", 0)
    assert list(tmp_path.iterdir()) == []


def test_places_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(VideoError, match=r"film\.mp4: the film cannot be written: "):
        _write(tmp_path / "file" / "film.mp4")
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(VideoError, match=r"folder\.mp4: the film cannot be written: Is a directory"):
        _write(tmp_path / "folder.mp4")
    assert sorted(found.name for found in tmp_path.iterdir()) == ["file", "folder.mp4"]


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """/dev/full takes every open and refuses every byte."""

    @contextmanager
    def full(path: Path) -> Iterator[Path]:
        with atomic_file(path) as temporary:
            temporary.symlink_to("/dev/full")
            yield temporary

    monkeypatch.setattr("featuredb.video.writer.atomic_file", full)
    writer = VideoWriter(tmp_path / "film.mp4", width=WIDTH, height=HEIGHT, fps=25.0)
    with pytest.raises(VideoError, match="No space left on device"), writer:
        writer.write(picture(0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"path": Path("film.mov")}, "ends in .mp4"),
        ({"width": 161}, "even sides of at least 2 pixels, found 161x120"),
        ({"height": 0}, "found 160x0"),
        ({"fps": 0.0}, "positive rate"),
        ({"fps": float("nan")}, "positive rate"),
    ],
)
def test_wrong_films_are_refused(wrong: dict[str, object], said: str) -> None:
    right: dict[str, object] = {"path": Path("film.mp4"), "width": WIDTH, "height": HEIGHT, "fps": 25.0}
    with pytest.raises(InvalidValueError, match=said):
        VideoWriter(**{**right, **wrong})  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [{"crf": -1}, {"crf": 52}])
def test_wrong_options_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InvalidValueError, match=next(iter(wrong))):
        VideoWriterOptions(**wrong)  # type: ignore[arg-type]


def test_wrong_frames_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with VideoWriter(path, width=WIDTH, height=HEIGHT, fps=25.0) as writer:
        writer.write(picture(0))
        for wrong in (
            picture(0).transpose(1, 0, 2),
            picture(0).astype(np.float32),
            np.zeros((HEIGHT, WIDTH, 4), np.uint8),
        ):
            with pytest.raises(InvalidValueError, match=r"expected pictures \(120, 160\) or \(120, 160, 3\)"):
                writer.write(wrong)
        with pytest.raises(InvalidValueError, match="expected no times"):
            writer.write(picture(1), 1.0)
    assert len(read(path)) == 1
    with VideoWriter(path, width=WIDTH, height=HEIGHT, fps=None) as writer:
        writer.write(picture(0), 1.0)
        for time_s, said in ((None, "a time for each"), (1.0, "after 1.0"), (0.5, "after"), (-1.0, "from 0")):
            with pytest.raises(InvalidValueError, match=said):
                writer.write(picture(1), time_s)
        with pytest.raises(InvalidValueError, match="from 0"):
            writer.write(picture(1), float("nan"))
    assert [frame.time_s for frame in read(path)] == [1.0]
    with pytest.raises(VideoError, match="not open"):
        writer.write(picture(0), 2.0)
