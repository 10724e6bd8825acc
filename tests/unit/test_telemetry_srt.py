"""Drones' subtitles: each dialect by a text of our own, the order of coordinates, damage, and any bytes."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.formats.srt import read_srt
from featuredb.video.telemetry.formats.text import parse_wall_clock

LAWS = settings(deadline=None, max_examples=150, derandomize=True)

BRACKETED = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2023-04-05 06:07:08.250
[iso: 100] [focal_len: 24.00] [latitude: 47.5] [longitude: 8.25] [rel_alt: 12.300 abs_alt: 460.5] \
[gb_yaw: -170.5 gb_pitch: -45.0 gb_roll: 0.5] </font>

2
00:00:00,033 --> 00:00:00,066
<font size="28">FrameCnt: 2, DiffTime: 33ms
2023-04-05 06:07:08.283
[iso: 100] [focal_len: 24.00] [latitude: 47.6] [longitude: 8.35] [rel_alt: 12.400 abs_alt: 460.6] \
[gb_yaw: 170.5 gb_pitch: -44.0 gb_roll: 0.5] </font>
"""


def positional(fixes: list[str], before: str = "", after: str = " BAROMETER:5.5") -> bytes:
    """Subtitles of one unnamed tuple a block."""
    blocks = [
        f"{row + 1}\n00:00:{row:02d},000 --> 00:00:{row + 1:02d},000\n{before}GPS({fix}){after}\n"
        for row, fix in enumerate(fixes)
    ]
    return "\n".join(blocks).encode()


def test_the_bracketed_dialect() -> None:
    value = read_srt(BRACKETED.encode(), "own.srt")
    assert value.times_s.tolist() == [0.0, 0.033]
    assert value.latitude_deg.tolist() == [47.5, 47.6]
    assert value.longitude_deg.tolist() == [8.25, 8.35]
    assert value.height_m.tolist() == [460.5, 460.6]
    assert value.height_datum == "unknown"
    assert value.relative_height_m.tolist() == [12.3, 12.4]
    assert value.gimbal_ypr_deg.tolist() == [[-170.5, -45.0, 0.5], [170.5, -44.0, 0.5]]
    assert value.clock == "local"
    # 2023-04-05 06:07:08.25 read as UTC, by `date -u -d`.
    assert value.clock_s[0] == 1680674828.25
    assert value.source == "SRT, bracketed"
    assert value.origin == "own.srt"


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_line_ends_and_encodings_change_nothing(ends: str, encoding: str) -> None:
    value = read_srt(BRACKETED.replace("\n", ends).encode(encoding))
    assert value.latitude_deg.tolist() == [47.5, 47.6]
    assert value.clock_s[0] == 1680674828.25


def test_old_spellings_of_the_bracketed_dialect() -> None:
    text = (
        "1\n00:00:01,500 --> 00:00:02,000\nSrtCnt : 1\n2019-09-27 10:28:08,438,904\n"
        "[focal_len : 280] [latitude : -35.080155] [longtitude : -60.286702] [altitude: 74.7]\n"
    )
    value = read_srt(text.encode())
    assert (value.times_s[0], value.latitude_deg[0], value.longitude_deg[0]) == (1.5, -35.080155, -60.286702)
    assert value.height_m[0] == 74.7
    assert value.clock_s[0] % 1.0 == pytest.approx(0.438904, abs=1e-6)
    assert any("altitude" in line for line in value.warnings)


def test_an_enterprise_drone_tells_its_body_not_its_camera() -> None:
    text = (
        "1\n00:00:00,341 --> 00:00:00,455\n"
        "[latitude: -36.8] [longtitude: 174.6] [Drone: Yaw:-146.0, Pitch:-0.6, Roll:1.3]\n"
    )
    value = read_srt(text.encode())
    assert value.latitude_deg[0] == -36.8
    assert np.isnan(value.gimbal_ypr_deg).all()


def test_the_line_of_a_phantom() -> None:
    text = (
        "1\n00:00:03,000 --> 00:00:04,000\nF/5.6, SS 400, ISO 100, EV 0, GPS (-118.851745, 34.237922, 15), "
        "HOME (-118.847509, 34.232707, -57.98m), D 698.70m, H 85.80m, H.S 0.00m/s, V.S 0.00m/s, "
        "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)\n"
    )
    value = read_srt(text.encode())
    assert (value.latitude_deg[0], value.longitude_deg[0]) == (34.237922, -118.851745)
    assert value.relative_height_m[0] == 85.8
    assert np.isnan(value.height_m[0])  # the 15 counts satellites
    assert value.gimbal_ypr_deg[0].tolist() == [110.4, -24.4, 0.0]
    assert value.clock == "none"


def test_compass_letters_need_no_guess() -> None:
    data = positional(
        ["W: 109.339287, S: 40.768574, 2371.76m"], before="HOME(W: 109.3, S: 40.7) 2020-11-15 18:40:51\n"
    )
    value = read_srt(data)
    assert (value.latitude_deg[0], value.longitude_deg[0]) == (-40.768574, -109.339287)
    assert value.height_m[0] == 2371.76
    assert value.warnings == ()


# The same two places in both orders, each with what tells them apart.
def test_order_by_magnitude() -> None:
    for first, second in (
        ("149.0251,-20.2533", "149.0251,-20.2534"),
        ("-20.2533,149.0251", "-20.2534,149.0251"),
    ):
        value = read_srt(positional([f"{first},16", f"{second},16"]))
        assert value.latitude_deg.tolist() == [-20.2533, -20.2534]
        assert value.longitude_deg.tolist() == [149.0251, 149.0251]
        assert not any("confirms" in line for line in value.warnings)


def test_order_by_the_magnitude_of_home_alone() -> None:
    value = read_srt(
        positional(["N/A,N/A,3", "89.9990,20.1,9"], before="HOME(90.0005,20.1) 2018.08.19 08:00:50\n")
    )
    assert value.has_position.tolist() == [False, True]
    assert (value.latitude_deg[1], value.longitude_deg[1]) == (20.1, 89.999)
    assert not any("confirms" in line for line in value.warnings)


@pytest.mark.parametrize("swapped", [False, True])
def test_order_by_distance_from_take_off(swapped: bool) -> None:
    """0.005 degrees east of take-off at 60 degrees north are 278 m, and 556 m if that were north."""
    home, places = (10.0, 60.0), [(10.005, 60.0), (10.0055, 60.0), (10.006, 60.0)]
    told = [278.0, 305.8, 333.6]

    def pair(place: tuple[float, float]) -> str:
        return ", ".join(f"{value:.6f}" for value in (place[::-1] if swapped else place))

    lines = [
        f"{row + 1}\n00:00:0{row},000 --> 00:00:0{row + 1},000\n"
        f"F/2.8, SS 100, GPS ({pair(place)}, 14), HOME ({pair(home)}, 5.00m), D {distance:.2f}m, H 20.00m\n"
        for row, (place, distance) in enumerate(zip(places, told, strict=True))
    ]
    value = read_srt("\n".join(lines).encode())
    assert value.latitude_deg.tolist() == [60.0, 60.0, 60.0]
    assert value.longitude_deg.tolist() == [10.005, 10.0055, 10.006]
    assert value.warnings == ()


def test_order_by_spelling_is_told_as_such() -> None:
    satellites = read_srt(positional(["-1.2218,42.4668,11", "-1.2219,42.4668,12"]))
    assert (satellites.latitude_deg[0], satellites.longitude_deg[0]) == (42.4668, -1.2218)
    assert any("nothing else in the file confirms it" in line for line in satellites.warnings)
    metres = read_srt(positional(["36.6146,-6.1120,0.0M", "36.6147,-6.1120,0.0M"], after=" BAROMETER:0.3M"))
    assert (metres.latitude_deg[0], metres.longitude_deg[0]) == (36.6146, -6.112)
    assert metres.relative_height_m.tolist() == [0.3, 0.3]
    assert np.isnan(metres.height_m).all()
    assert any("nothing else in the file confirms it" in line for line in metres.warnings)


def test_magnitude_stands_against_spelling() -> None:
    value = read_srt(positional(["174.0177,-41.3899,0.0M", "174.0178,-41.3899,0.0M"]))
    assert (value.latitude_deg[0], value.longitude_deg[0]) == (-41.3899, 174.0177)


def test_an_order_that_nothing_tells_is_refused() -> None:
    with pytest.raises(TelemetryError, match=r"cannot be told.*CSV"):
        read_srt(positional(["39.906217,16.391305,69.800"]), "unclear.srt")


def test_contradictory_orders_are_refused() -> None:
    with pytest.raises(TelemetryError, match="neither can be the latitude"):
        read_srt(positional(["149.0251,120.2533,16", "149.0251,120.2534,16"]))


def test_one_garbled_value_does_not_turn_a_file_around() -> None:
    value = read_srt(positional(["-1.2218,42.4668,11", "-1.2218,142.4668,11", "-1.2219,42.4668,11"]))
    assert value.longitude_deg[[0, 2]].tolist() == [-1.2218, -1.2219]
    assert value.has_position.tolist() == [True, False, True]
    assert any("out of range" in line for line in value.warnings)


@pytest.mark.parametrize("fix", ["N/A,N/A,3", "0.0000,0.0000,0", "n/a, n/a, 0", ",,"])
def test_samples_without_a_fix_are_kept_without_a_place(fix: str) -> None:
    value = read_srt(positional(["149.0251,-20.2533,16", fix, "149.0251,-20.2533,16"]))
    assert value.has_position.tolist() == [True, False, True]
    assert value.relative_height_m.tolist() == [5.5, 5.5, 5.5]


@pytest.mark.parametrize(
    "place",
    ["[latitude: 47,5,8] [longitude: 8,25]", "GPS(47,5,8,25,16)", "GPS(47,5, 8,25)", "GPS(47.5N,8.25E,16)"],
)
def test_what_may_be_another_number_is_no_number(place: str) -> None:
    """A decimal comma must not cost the decimals."""
    with pytest.raises(TelemetryError, match="none with a position"):
        read_srt(f"1\n00:00:00,000 --> 00:00:01,000\nBAROMETER:1.5\n{place}\n".encode())


def test_decimal_commas_of_named_values_are_read() -> None:
    names, values = BRACKETED.split("[iso", 1)
    value = read_srt((names + "[iso" + re.sub(r"(?<=\d)\.(?=\d)", ",", values)).encode())
    assert value.latitude_deg[0] == 47.5
    assert value.relative_height_m[0] == 12.3
    assert value.gimbal_ypr_deg[0].tolist() == [-170.5, -45.0, 0.5]


def test_names_stand_above_the_order_of_a_tuple() -> None:
    value = read_srt(b"1\n00:00:00,000 --> 00:00:01,000\n[latitude: 47.5] [longitude: 8.25] GPS(8.3,47.6)\n")
    assert (value.latitude_deg[0], value.longitude_deg[0]) == (47.5, 8.25)


def test_equal_places_are_all_kept() -> None:
    assert len(read_srt(positional(["149.0251,-20.2533,16"] * 9))) == 9


def test_a_block_that_is_cut_off_is_dropped_wherever_the_cut_is() -> None:
    """No prefix of the last block gives another number than the whole one."""
    whole = positional(
        ["149.0251,-20.2533,16"] * 3,
        before="HOME(149.0251,-20.2532) 2017.08.05 14:11:51\n",
        after=" BAROMETER:12.5\nISO:100 Fnum:2.2",
    )
    third = whole.index(b"3\n00:00:02")
    for end in range(third + len(b"3\n00:00:02,000 --> 00:00:03,000\n"), len(whole) - 8):
        value = read_srt(whole[:end])
        assert len(value) == 2, whole[third:end]
        assert any("cut off" in line for line in value.warnings)
    assert len(read_srt(whole)) == 3


def test_a_damaged_block_within_loses_only_itself() -> None:
    damaged = BRACKETED.replace(
        "[longitude: 8.25] [rel_alt: 12.300 abs_alt: 460.5]", "[longitude: 8."
    ).replace("[gb_yaw: -170.5 gb_pitch: -45.0 gb_roll: 0.5] </font>", "")
    value = read_srt(damaged.encode())
    assert value.has_position.tolist() == [False, True]
    assert any("1 of 2 blocks are damaged" in line for line in value.warnings)


def test_without_times_the_clock_counts() -> None:
    text = "".join(
        f"{row}\n2017.08.05 14:11:5{row},393,525\n[latitude : -20.2533] [longtitude : 149.0251]\n\n"
        for row in (1, 2, 4)
    )
    value = read_srt(text.encode())
    np.testing.assert_allclose(value.times_s, [0.0, 1.0, 3.0], atol=1e-6)
    assert not value.in_video_time
    with pytest.raises(TelemetryError, match="neither times of the video nor a clock"):
        read_srt(b"1\n[latitude : -20.2533] [longtitude : 149.0251]\n")


def test_times_that_go_back_are_left_out() -> None:
    data = positional(["149.0251,-20.2533,16"] * 4).replace(b"00:00:02,000 -->", b"00:00:00,000 -->")
    value = read_srt(data)
    assert value.times_s.tolist() == [0.0, 1.0, 3.0]
    assert any("1 of 4 samples left out" in line for line in value.warnings)


def test_joined_recordings_are_told() -> None:
    clocks = [f"2019-09-27 10:28:{second},000,000" for second in ("08", "09", "40")]
    text = "".join(
        f"{row + 1}\n00:00:0{row},000 --> 00:00:0{row + 1},000\n{clock}\n"
        f"[latitude: {47 + row * row / 100}] [longitude: 8.0]\n\n"
        for row, clock in enumerate(clocks)
    )
    value = read_srt(text.encode())
    assert any("+30.0 s ahead of the video at 2.00 s" in line for line in value.warnings)
    assert any("the place leaps by 3336 m in 1.00 s" in line for line in value.warnings)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "empty"),
        (b" \r\n\n", "empty"),
        (b"1\n", "none with a drone's telemetry"),
        (
            b"1\n00:00:01,000 --> 00:00:04,000\n- Where are you?\n- In the latitude of Rome.\n",
            "Where are you",
        ),
        (
            b"1\n00:00:00,000 --> 00:00:00,039\nFrameCnt : 1\n[iso : 100] [ct : 5627]\n",
            "none with a position",
        ),
        (b"1\n00:00:00,000 --> 00:00:00,039\n[latitude: 47.5] [longitude: 8.", "only subtitle is cut off"),
        (positional(["N/A,N/A,3", "N/A,N/A,4"]), "none with a position"),
        (b"1\n00:00:00,000 --> 00:00:00,039\nFrameCnt : 1\n", r"some\.srt \(SRT\): 1 samples"),
        (positional(["0.0,0.0,3"]), "0, 0 are a receiver without a fix"),
        (b"\x00\x01\x02\xff" * 100, "0 subtitles"),
    ],
)
def test_what_cannot_be_read_says_why(data: bytes, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        read_srt(data, "some.srt")


@pytest.mark.parametrize(
    ("text", "seconds", "is_utc"),
    [
        ("2022-08-07 13:40:40,774,808", 1659879640.774808, False),
        ("2017.8.5 14:11:51", 1501942311.0, False),
        ("2017.08.05 14:11:51,393,525,393,525", 1501942311.393525, False),
        ("2021-12-25 12:27:52.373", 1640435272.373, False),
        ("2024-05-31T12:00:00Z", 1717156800.0, True),
        ("2024-05-31T14:00:00.5+02:00", 1717156800.5, True),
        ("2024-05-31T06:30:00-0530", 1717156800.0, True),
        ("2016-12-31T23:59:60Z", 1483228800.0, True),
    ],
)
def test_clocks(text: str, seconds: float, is_utc: bool) -> None:
    """Seconds by `date -u +%s`."""
    clock = parse_wall_clock(text)
    assert clock is not None
    assert clock.seconds == pytest.approx(seconds, abs=1e-6)
    assert clock.is_utc is is_utc


@pytest.mark.parametrize(
    "text", ["", "00:00:00,000 --> 00:00:01,000", "2024-13-01 00:00:00", "31.05.2024 12:00:00", "12024-05-31"]
)
def test_what_is_no_clock(text: str) -> None:
    assert parse_wall_clock(text) is None


pieces = st.sampled_from(
    ["1", "\n", "\r\n", "00:00:01,000 --> 00:00:02,000", "00:00:00,500 --> 0:0:0", "GPS(", ")",
     "GPS (1.5, 2.5, 7)", "[", "]", "[latitude: 47.5]", "[longtitude : -8.5]", "[altitude: 1e9]", "HOME(1,2)",
     "N/A", "D 5m",
     "F.PRY (1, 2, 3)", "H 999999m", "BAROMETER:-1.5", "2020-01-01 00:00:00,123,456", "<font>", "\x00", "°",
     "[focal_len : 0]", "99999999999", "GPS(999,999,1)", "GPS(W: 1, N: 2, 3m)", "GPS(N: 1, S: 2)"]
)  # fmt: skip


@LAWS
@given(st.lists(st.one_of(pieces, st.text(max_size=6)), max_size=60).map("".join))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        value = read_srt(text.encode("utf-8", errors="surrogatepass"))
    except TelemetryError:
        return
    assert value.has_position.any()


@LAWS
@given(st.binary(max_size=300), st.integers(0, len(BRACKETED)), st.integers(0, 80))
def test_any_damage_is_read_or_refused(junk: bytes, at: int, length: int) -> None:
    """Bytes put in and cut out of a good file: what is read are places of that file."""
    data = BRACKETED.encode()
    data = data[:at] + junk + data[at + length :]
    try:
        value = read_srt(data)
    except TelemetryError:
        return
    assert len(value) >= 1
    assert value.has_position.any()
