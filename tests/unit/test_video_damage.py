"""Films that break in the middle: what is whole is delivered, what is not is counted, nothing blocks."""

import base64
import functools
import logging
import subprocess
import sys
import tempfile
import zlib
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from featuredb.errors import VideoError
from featuredb.video.film import VideoOptions, VideoReport
from featuredb.video.frames import open_video
from featuredb.video.opening import Decoder
from tests.support.films import (
    CONTAINER,
    KINDS,
    film,
    overwritten,
    picture,
    shown,
    write_film,
)

FRONT = {"movflags": "faststart"}  # the index before the frames


def _long(path: Path, **how: Any) -> Path:
    """48 frames with a key frame every 12."""
    return write_film(path, [picture(i) for i in range(48)], **how)


def _packets(path: Path) -> list[tuple[int, int]]:
    """(position, size) in the file of each packet, in decoding order."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]


def test_a_broken_stretch_is_passed_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _long(tmp_path / "film.mp4", options={"bf": "0"})
    packets = _packets(path)
    start, end = packets[18][0], packets[23][0]  # five frames of the second group
    path.write_bytes(overwritten(path.read_bytes(), start, end - start))
    with caplog.at_level(logging.WARNING), open_video(path) as video:
        frames = list(video)
        report = video.report
    times = [round(frame.time_s * 25) for frame in frames]
    assert [n for n in times if n < 18 or n >= 24] == [*range(18), *range(24, 48)]  # all that are whole
    assert all(shown(f.gray) == n for f, n in zip(frames, times, strict=True) if n < 18 or n >= 24)
    assert report.undecodable == 48 - len(frames) >= 4
    assert max(np.diff([frame.time_s for frame in frames])) == pytest.approx(
        (report.undecodable + 1) / 25, abs=0.041
    )
    assert report.complaints()
    assert f"film.mp4: {report.undecodable} packets cannot be decoded" in caplog.text
    assert report.at_end
    assert report.missing == 0


def test_damaged_frames_are_counted(tmp_path: Path) -> None:
    path = _long(tmp_path / "film.mp4", options={"bf": "0"})
    data = bytearray(path.read_bytes())
    position, size = _packets(path)[12]  # a key frame: most of its pixels are its own
    data[position + size // 2] ^= 0x10
    path.write_bytes(bytes(data))
    with open_video(path) as video:
        damaged = []
        for frame in video:
            damaged += [frame.index] * (video.report.damaged - len(damaged))
        report = video.report
    assert damaged
    assert damaged[0] == 12
    assert damaged[-1] < 24
    assert len(set(damaged)) == report.damaged == len(damaged)
    assert f"{len(damaged)} frames are damaged" in report.complaints()


def test_a_film_that_is_cut_off(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = _long(tmp_path / "film.mp4", container_options=FRONT)
    position, size = _packets(path)[30]
    path.write_bytes(path.read_bytes()[: position + size // 2])
    with caplog.at_level(logging.WARNING), open_video(path) as video:
        frames = list(video)
        report = video.report
    assert video.info.frame_count == 48
    assert report.undecodable == 1  # the half one
    assert report.missing == 48 - 31
    assert [shown(frame.gray) for frame in frames] == [round(frame.time_s * 25) for frame in frames]
    assert len(frames) == 30
    assert "17 frames of the file's index are missing: it is cut off" in caplog.text
    # A stretch before the break is whole.
    with open_video(path, VideoOptions(end_s=0.5)) as video:
        assert len(list(video)) == 13
        assert not video.report.complaints()


def test_a_cut_off_mkv_ends_early(tmp_path: Path) -> None:
    """Its index does not list the frames, but its header says how long it is."""
    path = write_film(tmp_path / "film.mkv", [picture(i) for i in range(100)], container="matroska")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    with open_video(path) as video:
        frames = list(video)
        report = video.report
    assert [shown(f.gray, 100) for f in frames] == list(range(len(frames)))
    assert 20 < len(frames) < 60
    assert report.short_by_s == pytest.approx(4.0 - len(frames) / 25, abs=0.05)
    assert any("before the film's stated end" in said for said in report.complaints())


@pytest.mark.parametrize("kind", ["mkv", "avi", "old.avi", "ts", "jpeg.avi", "webm"])
def test_noise_in_the_middle_of_other_containers(tmp_path: Path, kind: str) -> None:
    path = film(tmp_path, kind, 60)
    packets = _packets(path)
    start, end = packets[30][0], packets[34][0]
    path.write_bytes(overwritten(path.read_bytes(), start, end - start))
    with open_video(path) as video:
        frames = list(video)
        report = video.report
    assert [shown(frame.gray, 64) for frame in frames[:20]] == list(range(20))
    assert shown(frames[-1].gray, 64) == 59
    assert 40 <= len(frames) <= 60
    gaps_s = np.diff([frame.time_s for frame in frames])
    assert np.all(gaps_s > 0)
    # A broken place may also swallow frames without a trace but the gap that they leave.
    assert report.undecodable or report.damaged or gaps_s.max() > 0.05 or report.short_by_s > 0.05


def test_libav_does_not_write_to_the_terminal(tmp_path: Path) -> None:
    path = _long(tmp_path / "film.mp4")
    data = path.read_bytes()
    path.write_bytes(overwritten(data, len(data) // 3, 1000))
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from featuredb.video.frames import open_video\n"
        "with open_video(Path(sys.argv[1])) as video:\n"
        "    count = sum(1 for _ in video)\n"
        "print(count, not video.report.complaints())\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    # The one line is our own warning, by Python's handler of last resort.
    assert done.stdout.endswith("False\n")
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("film.mp4: ")


# An H.265 mp4 with flipped bits, found by trying many: a second thread of libav 8.1 waits for ever in it.
_STUCK = (
    "c-muNV30{GsVvAW&d+6FU}6B#Kx~v-U}DI?z`&7Kl$r_@H_1&&ECKQ>H5k{+HvDE||EGKP)+*5(M|hbgUw^{1Rz8ZSz9*jTm$O=8"
    "nu4=U>WP?)b=s#wL+`g(t6eaPlw@V)X}%?~tDs`{3?|e46Q%Zl`0(@4>a@gLu5({?3JP8>UYK{kkJn+5@t5+di}UubU8SCFCtG?^"
    "|BlAiO+St`ZSWEYTCU2(ctJ3{#jwxek3nRTtD>*?>HL$6+56|6mbK8C&U~;=HSWE915hC!1LFgg{cR!#3}SLl#%~0QNCUMhUafU8"
    "NZ#<bacxdtA-B%%?e`m+&OLf`5vn0=>t8n!2dz2ZyKR6X6SWxENO&m~&RBQMDgR%px8bf`;^Bdrr&ouVR(I8NgnU^0?)XFR2T4Me"
    "g=bDB6+bO4l{$6*S5kn@nQp_i`NnrH>vzpq;>Y*sob=q;w}0+BvtyZn&;EdkCt1%ZeO_O*J95_MGe-N4O}w7g$(M92>@BZBZgXAx"
    "ws{TJOiMMSZ!i9~`Qp*am{YxMxh;+ED+PBv2m|>`P=N8lBHi%s5`k(v^?0Alvep0v6@gxJM1;z@7uuz~QqQlsDc;}~&bpv|>_rXK"
    "gHM1V;s6SfC~lyL2~b<)U2uqe{U=^f_V)SLT_&==*3*OkF~~DK%#Zp1vygp7)1{(QYp2w-yI$>Fy4q<CP@f1B<3qQp^?@xD)`ZLU"
    "P0_3{W#jt|vEiZG*Z&?H6tw1YW-n)8;5E$6&o2YY<m8rRq%fcW<`)b=2Qe@*fDi&OqN+mYJ22n{ObiS>(IrKR*+6zoNjBI{W=zw7"
    "_A=nN2dljx!T`)wNlhs!2GTOAImIOi9UyaApnAD4=cZ&P0vQUqDd>JT0%9qK&?8`uZbnK@5lp5mGbI&SWf+j3?~$07l9LKj!(Eq~"
    "nU@BNg0ft&p~%iuNrA}8q!gv5A$fzRv?xab!sfOsE=kH^VBq2^E-6kysNwvTky>VmBPc)~H(>Ap(jGWfpaY5j|AD4X$S6y8W@JnN"
    "3QPbC%Y9(@^Y_OO1_pi>1)wPs4vajE|Nny&FoRSugOJ?R8JvnhNew4PMl_iP3e94Xk?VZcWpIG_VB&;>5>PRl3**7!3v1LF7&*oL"
    "7+L?rfRN6jdz@Rv-EZ#>UGlH~&>z2wQ7{Td!6+C7qhJ(_f{_A1od=Pmk|JnxRmBL_QY$V2H)Y|iMQ|$`EM8oUXjX&e*udf`B?TZs"
    "1px^G2?Zb)5Rd?J3z8A$@IchFK+R->(oAIXIT%pQ0|ObL`;w8|&4{p<!38K+h141aiPr+LCJ+k&u{@NX3dEwIUL}-o0rDS|EmB;P"
    "oR4I_4iG1mrj&r1^ijE~U>XDzk(=+pCVx?4K|v03Q&=|>(nnBTS&|PjP!`yYPK0^HC$TKe%t+4=hzyJXyWg>v"
)


def test_a_damaged_film_does_not_block_its_decoder(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(zlib.decompress(base64.b85decode(_STUCK)))
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from featuredb.video.frames import open_video\n"
        "with open_video(Path(sys.argv[1])) as video:\n"
        "    print(sum(1 for _ in video))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert int(done.stdout) == 5


# Time stamps. Files with wrong ones are hard to make, so the decoder gets a container that says them.


class _Picture:
    def __init__(self, pts: int | None) -> None:
        self.pts, self.dts = pts, pts


class _Packet:
    is_corrupt, dts = False, 0

    def __init__(self, pts: int | None, size: int = 1) -> None:
        self._pts, self.size = pts, size

    def decode(self) -> list[_Picture]:
        assert self.size  # else libav would take it for the end
        return [_Picture(self._pts)]


class _Container:
    """Of packets with these time stamps; "empty" is one without data, "broken" an unreadable place."""

    format = type("Format", (), {"name": "mov"})

    def __init__(self, stamps: list[Any]) -> None:
        self._left = list(stamps)

    def demux(self, _: object) -> Any:
        while self._left:
            stamp = self._left.pop(0)
            if stamp == "broken":
                raise av.InvalidDataError(av.error.tag_to_code(b"INDA"), "Invalid data")
            yield _Packet(0, 0) if stamp == "empty" else _Packet(stamp)


def _times(stamps: list[Any], interval_s: float | None = 0.04) -> tuple[list[float], VideoReport]:
    rate = None if interval_s is None else 1 / Fraction(str(interval_s))
    stream = SimpleNamespace(time_base=Fraction(1, 100), average_rate=rate, guessed_rate=None)
    tally = VideoReport()
    decoder = Decoder(_Container(stamps), stream, tally, "film.mp4")  # type: ignore[arg-type]
    return [time_s for time_s, _ in decoder.pictures()], tally


def test_frames_that_go_back_in_time_are_dropped() -> None:
    times, report = _times([0, 4, 4, 3, 8, 12])
    assert times == pytest.approx([0.0, 0.04, 0.08, 0.12])
    assert report.out_of_order == 2
    assert report.complaints() == ("2 frames go back in time and were dropped",)


def test_frames_without_times_are_given_the_next() -> None:
    times, report = _times([None, 4, None, 12, None, None])
    assert times == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16, 0.20])
    assert report.times_guessed == 4
    times, report = _times([0, None, 8], interval_s=None)
    assert times == pytest.approx([0.0, 0.08])
    assert report.out_of_order == 1


def test_a_clock_that_was_set_back_is_refused() -> None:
    with pytest.raises(VideoError, match=r"film\.mp4: the times of 251 frames stay at or behind 5\.000 s"):
        _times([0, 500, *range(1, 400)])


def test_empty_packets_do_not_end_the_film() -> None:
    assert _times([0, "empty", 4, "empty", "empty", 8])[0] == pytest.approx([0.0, 0.04, 0.08])


def test_places_that_cannot_be_read_are_passed() -> None:
    times, report = _times([0, *["broken"] * 20, 4, *["broken"] * 20, 8])
    assert times == pytest.approx([0.0, 0.04, 0.08])
    assert report.at_end
    with pytest.raises(VideoError, match=r"film\.mp4: the container is broken after the frame at 0\.040 s"):
        _times([0, 4, *["broken"] * 21, 8])


# Anything at all.


@functools.cache
def _small(kind: str) -> bytes:
    """12 frames of 64x48 with a key frame in the middle."""
    pictures = [np.ascontiguousarray(picture(i)[:48, :64]) for i in range(12)]
    suffix = kind.rpartition(".")[2]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film.{suffix}"
        return write_film(
            path, pictures, container=CONTAINER.get(suffix, suffix), group=6, **KINDS[kind]
        ).read_bytes()


@settings(
    deadline=None,
    max_examples=400,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    kind=st.sampled_from(sorted(KINDS)),
    flips=st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 255)), max_size=12),
    keep=st.one_of(st.just(1.0), st.floats(0.0, 1.0)),
    start_s=st.sampled_from([None, 0.2]),
)
def test_flipped_and_truncated_films_are_read_or_refused(
    tmp_path: Path,
    kind: str,
    flips: list[tuple[float, int]],
    keep: float,
    start_s: float | None,
) -> None:
    data = bytearray(_small(kind))
    for where, mask in flips:
        data[min(int(where * len(data)), len(data) - 1)] ^= mask
    path = tmp_path / f"{zlib.crc32(data):08x}.{kind}"
    path.write_bytes(data[: int(keep * len(data))])
    frames = []
    try:
        with open_video(path, VideoOptions(start_s=start_s, max_side_px=48)) as video:
            for frame in video:
                assert max(frame.gray.shape) <= 48
                assert frame.rgb().shape == (*frame.gray.shape, 3)
                frames.append(frame.time_s)
    except VideoError as error:
        said = str(error)
        assert said.startswith(path.name) and len(said) > len(path.name) + 15  # noqa: PT018
    finally:
        path.unlink()
    assert np.all(np.diff(frames) > 0)
