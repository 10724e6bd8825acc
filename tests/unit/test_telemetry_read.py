"""Which reader reads a file, and which of several telemetries belongs to a video."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.formats import text as telemetry_text
from featuredb.video.telemetry.read import read_telemetry, telemetry_of_video
from featuredb.video.telemetry.values import MAX_SAMPLES, assemble, check_count
from tests.support.telemetry_files import device, gps5, mov_text, write_mp4

SRT = "1\n00:00:00,000 --> 00:00:01,000\n2023-04-05 06:07:08.250\n[latitude: 47.500000] [longitude: 8.25]\n"
DIALOGUE = "1\n00:00:00,000 --> 00:00:01,000\nWhere did you put it?\n"
GPX = (
    '<?xml version="1.0"?><gpx><trk><trkseg><trkpt lat="46.5" lon="7.25">'
    "<time>2024-05-31T12:00:00Z</time></trkpt></trkseg></trk></gpx>"
)
CSV = "time_s,lat,lon\n0,45.5,6.25\n"
GPMF = device(gps5([(44.5, 5.25, 100.0)] * 3))
LINE = "F/2.8, SS 30.15, ISO 260, EV 0, GPS (-121.745800, 43.5, 17), D 221.21m, H 200.70m"


def put(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def subtitles(*texts: str) -> list[tuple[int, bytes]]:
    return [(1000, mov_text(text)) for text in texts]


@pytest.mark.parametrize(
    ("name", "text", "source", "latitude"),
    [
        ("a.srt", SRT, "SRT, bracketed", 47.5),
        ("a.SRT", SRT, "SRT, bracketed", 47.5),
        ("a.gpx", GPX, "GPX", 46.5),
        ("a.CSV", CSV, "CSV", 45.5),
        ("a.txt", CSV, "CSV", 45.5),
        # The contents count where they tell.
        ("a.txt", SRT, "SRT, bracketed", 47.5),
        ("a.csv", GPX, "GPX", 46.5),
        ("noname", GPX, "GPX", 46.5),
    ],
)
def test_a_file_is_what_it_contains(
    tmp_path: Path, name: str, text: str, source: str, latitude: float
) -> None:
    value = read_telemetry(put(tmp_path, name, text))
    assert value.source == source
    assert value.latitude_deg[0] == latitude
    assert value.origin == name


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.srt", "", "a.srt: the file is empty"),
        ("a.gpx", "no xml", "no well-formed XML"),
        ("a.csv", "\x00\x01", "first line with columns"),
        ("a.pdf", "%PDF-1.7 ...", "found a file that begins with b'%PDF-1.7"),
        ("a.mp4", "not a film at all", "a.mp4: expected mp4, mov"),
        ("a.mp4", "", "a.mp4: the file is empty"),
    ],
)
def test_what_is_none_of_them_says_so(tmp_path: Path, name: str, text: str, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        read_telemetry(put(tmp_path, name, text))


def test_files_that_are_missing_or_folders(tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="No such file"):
        read_telemetry(tmp_path / "missing.srt")
    with pytest.raises(TelemetryError, match="cannot be read"):
        read_telemetry(tmp_path)
    with pytest.raises(TelemetryError, match="no such video"):
        telemetry_of_video(tmp_path / "missing.mp4")


def test_absurd_sizes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = put(tmp_path, "a.srt", SRT)
    monkeypatch.setattr(telemetry_text, "MAX_TEXT_BYTES", len(SRT) - 1)
    with pytest.raises(TelemetryError, match="found more"):
        telemetry_text.read_bytes(path)
    monkeypatch.setattr(telemetry_text, "MAX_TEXT_BYTES", len(SRT))
    assert telemetry_text.read_bytes(path) == SRT.encode()
    check_count(MAX_SAMPLES, "a")
    with pytest.raises(TelemetryError, match="more than 2000000 samples"):
        check_count(MAX_SAMPLES + 1, "a")


def test_a_video_says_where_it_was(tmp_path: Path) -> None:
    film = tmp_path / "own.mp4"
    write_mp4(film, [("gpmd", [(1000, GPMF)])])
    value = telemetry_of_video(film)
    assert value is not None
    assert (value.source, value.origin) == ("GPMF GPS5", "own.mp4, GPMF track 0")
    assert value.warnings == ()


def test_subtitles_in_a_video(tmp_path: Path) -> None:
    film = tmp_path / "own.mov"
    write_mp4(
        film,
        [("tx3g", subtitles(LINE, LINE.replace("43.5", "43.50001"), "", LINE.replace("43.5", "43.50002")))],
    )
    value = telemetry_of_video(film)
    assert value is not None
    assert (value.source, value.origin) == ("SRT, F/SS line", "own.mov, subtitle track 0")
    assert value.times_s.tolist() == [0.0, 1.0, 3.0]
    assert value.latitude_deg.tolist() == [43.5, 43.50001, 43.50002]
    assert value.longitude_deg[0] == -121.7458
    assert value.in_video_time
    assert read_telemetry(film).latitude_deg[0] == 43.5


def test_the_best_of_several_is_taken_and_the_others_told(tmp_path: Path) -> None:
    film = tmp_path / "DJI_0001.MP4"
    everything = [("gpmd", [(1000, GPMF)]), ("tx3g", subtitles(LINE))]
    write_mp4(film, everything)
    put(tmp_path, "dji_0001.Srt", SRT)
    put(tmp_path, "DJI_0001.gpx", GPX)
    put(tmp_path, "DJI_0001.csv", CSV)
    put(tmp_path, "DJI_0002.srt", "another video's")
    found = []
    for tracks, gone in ((everything, ""), (everything[1:], ""), ([("tx3g", subtitles("- Hello?"))], ""),
                         ([], "dji_0001.Srt"), ([], "DJI_0001.gpx"), ([], "DJI_0001.csv")):  # fmt: skip
        write_mp4(film, tracks or [("gpmd", [(1000, device())])])
        if gone:
            (tmp_path / gone).unlink()
        value = telemetry_of_video(film)
        found.append((value.latitude_deg[0], len(value.warnings)) if value else None)
    # Three files and a track are told as not used, then fewer; what is no telemetry is not.
    assert found == [(44.5, 4), (43.5, 3), (47.5, 2), (46.5, 1), (45.5, 0), None]


def test_what_cannot_be_read_gives_way_and_is_told(tmp_path: Path) -> None:
    film = tmp_path / "a.mp4"
    write_mp4(film, [("gpmd", [(1000, device(gps5([(1.0, 2.0, 3.0)], fix=0)))])])
    with pytest.raises(TelemetryError, match=r"a\.mp4: no telemetry can be read: .*none with a position"):
        telemetry_of_video(film)
    put(tmp_path, "a.gpx", GPX)
    value = telemetry_of_video(film)
    assert value is not None
    assert value.source == "GPX"
    assert "none with a position" in value.warnings[0]
    # The same with a film that cannot be opened at all.
    film.write_bytes(b"no film")
    again = telemetry_of_video(film)
    assert again is not None
    assert "not used: a.mp4: expected mp4" in again.warnings[0]


def test_other_peoples_subtitles_are_no_telemetry(tmp_path: Path) -> None:
    film = tmp_path / "a.mp4"
    write_mp4(film, [("tx3g", subtitles("Where did you put it?"))])
    put(tmp_path, "a.srt", DIALOGUE)
    assert telemetry_of_video(film) is None
    with pytest.raises(TelemetryError, match="expected a GPMF track or a drone's subtitles"):
        read_telemetry(film)
    with pytest.raises(TelemetryError, match="Where did you put it"):
        read_telemetry(tmp_path / "a.srt")


def test_a_folder_of_frames_has_its_telemetry_beside_it(tmp_path: Path) -> None:
    frames = tmp_path / "flight.2"
    frames.mkdir()
    assert telemetry_of_video(frames) is None
    put(tmp_path, "flight.2.srt", SRT)
    value = telemetry_of_video(frames)
    assert value is not None
    assert value.latitude_deg[0] == 47.5


def test_a_cut_film_gives_what_is_left(tmp_path: Path) -> None:
    film = tmp_path / "a.mp4"
    write_mp4(film, [("gpmd", [(1000, GPMF)] * 3)])
    whole = film.read_bytes()
    film.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(TelemetryError, match=r"a\.mp4: an mp4 or mov"):
        read_telemetry(film)


def _columns(row: dict[str, float]) -> dict[str, FloatArray]:
    return {name: np.array([value]) for name, value in row.items()}


def test_nothing_but_unknown_places_is_refused() -> None:
    table = _columns({"times_s": 0.0, "latitude_deg": 91.0, "longitude_deg": 0.0})
    with pytest.raises(TelemetryError, match=r"none with a position \(1 positions out of range"):
        assemble(table, source="test", origin="a", warnings=[])
    with pytest.raises(TelemetryError, match="no samples"):
        assemble({"times_s": np.empty(0)}, source="test", origin="a", warnings=[])


def test_absurd_values_become_unknown() -> None:
    table = _columns(
        {
            "times_s": 0.0, "latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 1e6,
            "relative_height_m": -1e5, "clock_s": 0.0,
            "gimbal_yaw": 350.0, "gimbal_pitch": 1e9,
        }
    )  # fmt: skip
    value = assemble(table, source="test", origin="a", warnings=[], clock="utc")
    assert value.gimbal_ypr_deg[0, 0] == -10.0
    for column in (value.height_m, value.relative_height_m, value.clock_s):
        assert column[0] != column[0]
    assert value.gimbal_ypr_deg[0, 1] != value.gimbal_ypr_deg[0, 1]
    assert value.clock == "none"
    assert len(value.warnings) == 4


@settings(deadline=None, max_examples=100, derandomize=True)
@given(
    data=st.one_of(
        st.binary(max_size=200),
        st.sampled_from([SRT, GPX, CSV]).flatmap(
            lambda text: st.tuples(st.integers(0, len(text)), st.binary(max_size=20)).map(
                lambda cut: text.encode()[: cut[0]] + cut[1]
            )
        ),
    ),
    suffix=st.sampled_from([".srt", ".gpx", ".csv", ".txt", ".mp4", ""]),
)
def test_any_file_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, suffix: str
) -> None:
    path = put(tmp_path_factory.getbasetemp(), f"any{suffix}", data)
    try:
        value = read_telemetry(path)
    except TelemetryError:
        return
    assert value.has_position.any()


@settings(deadline=None, max_examples=60, derandomize=True)
@given(at=st.integers(0, 2000), byte=st.integers(0, 255), end=st.integers(0, 2000))
def test_any_damage_to_a_film_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, at: int, byte: int, end: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.mp4"
    write_mp4(path, [("gpmd", [(1000, GPMF)] * 2), ("tx3g", subtitles(LINE))])
    data = bytearray(path.read_bytes())
    if at < len(data):
        data[at] = byte
    path.write_bytes(data[: max(len(data) - end // 10, 0)] if end % 3 == 0 else data)
    try:
        value = read_telemetry(path)
    except TelemetryError:
        return
    assert value.has_position.any()
