"""Folders of pictures as films: natural order, times, and what is refused by name."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from featuredb.errors import VideoError
from featuredb.features.decode import DecodeLimits
from featuredb.video.film import VideoOptions
from featuredb.video.folder import natural_key
from featuredb.video.frames import open_video
from reloc.localise.result import LocaliseRequest
from reloc.tracking.ground import Unmatched
from reloc.tracking.options import TrackOptions
from reloc.tracking.track_video import _with_film
from reloc.tracking.tracker import Tracker
from tests.support.films import HEIGHT, WIDTH, overwritten, picture, read, shown


def _folder(folder: Path, names: list[str], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    folder.mkdir(exist_ok=True)
    for index, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(index, *size)[:, :, ::-1])
    return folder


NAMES = [f"Frame{i}.png" for i in (1, 2, 9, 10, 11, 100)]


def test_a_folder_in_natural_order_at_a_rate(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    (folder / "notes.txt").write_text("no picture")
    (folder / ".hidden.png").write_bytes(b"no picture")
    with open_video(str(folder), VideoOptions(fps=4.0)) as video:
        frames = list(video)
    assert [shown(frame.gray) for frame in frames] == list(range(6))
    assert [frame.time_s for frame in frames] == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25]
    np.testing.assert_array_equal(frames[4].rgb(), picture(4))
    info = video.info
    assert (info.width, info.height, info.frame_count) == (WIDTH, HEIGHT, 6)
    assert not video.report.complaints()


def test_natural_order() -> None:
    names = ["b1", "a10", "A2", "a1b20", "a1b3", "a", "10", "9", "a²", "a١"]
    assert sorted(names, key=natural_key) == ["9", "10", "a", "a1b3", "a1b20", "A2", "a10", "a²", "a١", "b1"]


def test_times_of_a_folder(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    times = [0.5, 0.6, 1.0, 1.5, 1.6, 2.5]
    # A table may order the pictures otherwise than their names do.
    backward = "".join(f"{name}, {t}, x\n" for name, t in zip(NAMES, reversed(times), strict=True))
    (folder / "timestamps.csv").write_text("\ufefffile, time_s, note\n" + backward)
    frames = read(folder, fps=99.0)
    assert [frame.time_s for frame in frames] == times
    assert [shown(frame.gray) for frame in frames] == [5, 4, 3, 2, 1, 0]
    assert [f.time_s for f in read(folder, start_s=0.6, end_s=2.0)] == [0.6, 1.0, 1.5, 1.6]


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        (
            "timestamps.csv",
            "file,time_s\n" + "".join(f"{n},{t}\n" for n, t in zip(NAMES, (1, 2, 3, 3, 5, 6), strict=True)),
            r"increase, found 3 s for Frame10\.png and 3 s for Frame9\.png",
        ),
        (
            "timestamps.csv",
            "file,time_s\nFrame1.png,four\n",
            "line 2: expected a time in seconds, found 'four'",
        ),
        ("timestamps.csv", "file,time_s\nFrame1.png,nan\n", "line 2"),
        ("timestamps.csv", "name,time\n", "expected a heading with the columns file and time_s"),
        ("timestamps.csv", "", "expected a heading"),
        ("timestamps.csv", "file,time_s\nFrame1.png,0\nFrame1.png,1\n", "line 3: Frame1.png is there twice"),
        ("timestamps.csv", "file,time_s\nFrame1.png\n", "line 2: expected a time"),
        (
            "timestamps.csv",
            "file,time_s\nother.png,0\nFrame1.png,1\n",
            r"without a time: Frame2\.png.*not in the folder: other\.png",
        ),
    ],
)
def test_times_that_do_not_fit_are_refused(tmp_path: Path, file: str, text: str, said: str) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    (folder / file).write_text(text)
    with pytest.raises(VideoError, match=said):
        open_video(folder)


def test_folders_that_are_refused(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    with pytest.raises(VideoError, match=r"times of its 6 pictures.*or give their rate by --fps"):
        open_video(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(VideoError, match="empty: expected pictures"):
        open_video(tmp_path / "empty", VideoOptions(fps=1.0))


def test_mixed_sizes_are_refused_by_name(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    cv2.imwrite(str(folder / "Frame10.png"), picture(0, 80, 60))
    with open_video(folder, VideoOptions(fps=1.0)) as video:
        frames = iter(video)
        assert [next(frames).index for _ in range(3)] == [0, 1, 2]
        with pytest.raises(VideoError, match=r"Frame10\.png has 80x60 pixels, but Frame1\.png has 160x120"):
            next(frames)


def test_a_broken_picture_is_refused_by_name(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    whole = (folder / "Frame9.png").read_bytes()
    (folder / "Frame9.png").write_bytes(whole[: len(whole) // 2])
    with open_video(folder, VideoOptions(fps=1.0)) as video:
        frames = iter(video)
        next(frames)
        next(frames)
        with pytest.raises(VideoError, match=r"frames: the picture Frame9\.png cannot be read: .*ends after"):
            next(frames)
    (folder / "Frame1.png").write_bytes(overwritten(whole, 0, 8))
    with pytest.raises(VideoError, match=r"Frame1\.png cannot be read"):
        open_video(folder, VideoOptions(fps=1.0))


def test_large_pictures_of_a_folder_are_made_smaller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _folder(tmp_path / "frames", NAMES)
    with open_video(folder, VideoOptions(fps=1.0, max_side_px=80)) as video:
        frame = next(iter(video))
    assert (video.info.frame_width, video.info.frame_height) == (80, 60)
    np.testing.assert_array_equal(
        frame.gray, cv2.resize(picture(0)[:, :, 0], (80, 60), interpolation=cv2.INTER_AREA)
    )
    assert frame.rgb().shape == (60, 80, 3)
    monkeypatch.setattr("featuredb.video.folder._LIMITS", DecodeLimits(max_side_px=100))
    with pytest.raises(VideoError, match="limit of a side is 100"):
        open_video(folder, VideoOptions(fps=1.0))


def test_a_folder_says_whose_lens_its_pictures_have(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()

    def write(index: int, model: str) -> None:
        exif = Image.Exif()
        exif[ExifTags.Base.Make.value], exif[ExifTags.Base.Model.value] = "Maker", model
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm.value] = 36
        Image.fromarray(picture(index)).save(folder / f"{index}.jpg", exif=exif)

    for index in range(3):
        write(index, "One")
    with open_video(folder, VideoOptions(fps=1.0, max_side_px=80)) as video:
        info = video.info
    assert (info.make, info.model) == ("Maker", "One")
    assert info.camera_key.startswith(f"maker|one|{WIDTH}x{HEIGHT}|f")
    assert info.focal_px == pytest.approx(np.hypot(WIDTH, HEIGHT) * 36 / 43.2666, rel=0.01)
    known = _with_film(LocaliseRequest(), info, folder)  # of the frames, which are smaller
    assert known.camera_key == info.camera_key
    assert known.exif_focal_px == pytest.approx(info.focal_px * 80 / WIDTH)
    assert _with_film(LocaliseRequest(exif_focal_px=7.0), info, folder) == LocaliseRequest(exif_focal_px=7.0)
    write(2, "Two")
    with open_video(folder, VideoOptions(fps=1.0)) as video:
        assert (video.info.camera_key, video.info.focal_px) == ("", None)
        assert _with_film(LocaliseRequest(), video.info, folder) == LocaliseRequest()
        one, _, two = (frame.camera_key for frame in video)
    assert one == info.camera_key
    assert two.startswith("maker|two|")


def test_a_frame_of_another_camera_is_looked_for_with_its_own_lens(tmp_path: Path) -> None:
    keys = ["maker|one", "maker|two", "maker|two"]
    asked: list[str | None] = []

    class Nowhere:
        def find(self, gray: np.ndarray, request: LocaliseRequest, options: TrackOptions) -> Unmatched:
            asked.append(request.camera_key)
            return Unmatched(reason="TOO_FEW_MATCHES", detail="")

    at_once = TrackOptions(lost_answer_after=1)
    with Tracker(Nowhere(), None, at_once, LocaliseRequest(camera_key="of the film")) as tracker:
        for k, key in enumerate([*keys, "", ""]):  # the last one waits for the answer
            tracker.track(picture(k)[:, :, 0], float(k), key)
    assert asked[:4] == [*keys, "of the film"]
