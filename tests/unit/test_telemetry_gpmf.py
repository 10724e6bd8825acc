"""GPMF: entries byte by byte, GoPro's and Karma's GPS streams, and packets that are damaged on purpose."""

import struct
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.formats.gpmf import TimedPacket, has_positions, read_gpmf
from featuredb.video.telemetry.formats.klv import MAX_DEPTH, numbers, parse_klv
from featuredb.video.telemetry.read import read_telemetry, read_tracks
from tests.support.telemetry_files import device, gps5, gps9, klv, nest, write_mp4

LAWS = settings(deadline=None, max_examples=150, derandomize=True)
PLACES = [(47.0 + i * 1e-5, 8.00001 + i * 1e-5, 499.0 + i) for i in range(1, 5)]


def packet(data: bytes, start_s: float = 0.0, duration_s: float = 1.0) -> TimedPacket:
    return TimedPacket(start_s, duration_s, data)


def test_an_entry_is_key_type_size_count_and_padded_data() -> None:
    data = klv("ABCD", "s", 2, 3, struct.pack(">3h", -1, 2, 300)) + klv("TEXT", "c", 1, 5, b"a\xb0c\0\0")
    first, second = parse_klv(data)
    assert len(data) == 8 + 8 + 8 + 8  # six and five bytes are padded to eight
    assert numbers(first).tolist() == [[-1.0], [2.0], [300.0]]
    assert second.text() == "a°c"
    assert first.children == ()


@pytest.mark.parametrize(
    ("kind", "pack", "values"),
    [
        ("b", "b", [-128, 127]), ("B", "B", [0, 255]), ("s", "h", [-32768, 32767]), ("S", "H", [0, 65535]),
        ("l", "i", [-(2**31), 2**31 - 1]), ("L", "I", [0, 2**32 - 1]), ("j", "q", [-(2**53), 2**53]),
        ("J", "Q", [0, 2**53]), ("f", "f", [0.5, -1.25]), ("d", "d", [0.1, -1e300]),
    ],
)  # fmt: skip
def test_types_of_numbers(kind: str, pack: str, values: list[float]) -> None:
    data = struct.pack(f">2{pack}", *values)
    entry = parse_klv(klv("NUMS", kind, len(data), 1, data))[0]
    assert numbers(entry).tolist() == [[float(value) for value in values]]


def test_fixed_point_numbers() -> None:
    short = parse_klv(klv("FIXD", "q", 4, 1, struct.pack(">i", -(3 << 15))))[0]
    assert numbers(short).tolist() == [[-1.5]]
    long = parse_klv(klv("FIXD", "Q", 8, 1, struct.pack(">q", 5 << 30)))[0]
    assert numbers(long).tolist() == [[1.25]]


def test_complex_structures() -> None:
    data = struct.pack(">fff", 1.0, 2.0, 3.0) + struct.pack(">L", 7) + b"\x05"
    entry = parse_klv(klv("CPLX", "?", 17, 1, data))[0]
    assert numbers(entry, "f[3]LB").tolist() == [[1.0, 2.0, 3.0, 7.0, 5.0]]
    for structure in ("", "fffL", "f[3]LBB", "f[0]", "f[-1]", "f[²]", "f[3", "f[99999]", "x", "c[17]"):
        with pytest.raises(TelemetryError, match="GPMF"):
            numbers(entry, structure)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"DEVC\0", "truncated"),
        (b"DEVC\0\1\xff\xff", "announces 65535 bytes, 0 are left"),
        (nest("DEVC", b"STRM\0\1\0\x40abcd"), "STRM announces 64 bytes, 4 are left"),
        (b"\1\2\3\4\0\0\0\0", "key of four characters"),
        (b"GPS5l\x14\0\2" + b"\0" * 39, "announces 40 bytes, 39 are left"),
    ],
)
def test_lengths_beyond_what_is_there_are_refused(data: bytes, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        parse_klv(data)


def test_nesting_and_number_of_entries_are_bounded() -> None:
    deep = b""
    for _ in range(MAX_DEPTH + 2):
        deep = nest("DEVC", deep)
    with pytest.raises(TelemetryError, match="deep"):
        parse_klv(deep)
    empty = klv("EMPT", "L", 4, 0, b"")
    with pytest.raises(TelemetryError, match="entries in a packet"):
        parse_klv(empty * 60_000)
    # No length at all must not stop the loop from going on.
    assert len(parse_klv(empty * 100)) == 100


def test_zeros_end_a_packet() -> None:
    assert [entry.key for entry in parse_klv(klv("ABCD", "b", 1, 1, b"x") + b"\0" * 20)] == ["ABCD"]


def test_gps5() -> None:
    value = read_gpmf([packet(device(gps5(PLACES, fix=3, dop=1.5)), 10.0, 1.001)], "own.mp4")
    np.testing.assert_allclose(value.times_s, 10.0 + 1.001 * np.arange(4) / 4, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        value.latitude_deg, [47.00001, 47.00002, 47.00003, 47.00004], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(value.longitude_deg, [8.00002, 8.00003, 8.00004, 8.00005], rtol=0, atol=1e-9)
    np.testing.assert_allclose(value.height_m, [500.0, 501.0, 502.0, 503.0], rtol=0, atol=1e-9)
    assert value.height_datum == "ellipsoidal"
    assert value.clock == "utc"
    start = datetime(2024, 5, 31, 11, 59, 59, 500_000, tzinfo=UTC).timestamp()
    np.testing.assert_allclose(value.clock_s, start + 1.001 * np.arange(4) / 4, rtol=0, atol=1e-6)
    assert value.source == "GPMF GPS5"
    assert value.warnings == ()


def test_gps5_in_two_dimensions_has_no_height_and_without_a_fix_no_place() -> None:
    packets = [
        packet(device(gps5(PLACES, fix=0, dop=99.99, utc="000000000000.000")), 0.0),
        packet(device(gps5(PLACES, fix=2)), 1.0),
        packet(device(gps5(PLACES, fix=3)), 2.0),
    ]
    value = read_gpmf(packets)
    assert value.has_position.tolist() == [False] * 4 + [True] * 8
    assert np.isfinite(value.height_m).tolist() == [False] * 8 + [True] * 4
    assert np.isfinite(value.clock_s).tolist() == [False] * 4 + [True] * 8
    with pytest.raises(TelemetryError, match="none with a position"):
        read_gpmf(packets[:1])


def test_positions_of_unknown_freshness_are_told() -> None:
    value = read_gpmf([packet(device(gps5(PLACES).replace(b"GPSF", b"GPSX").replace(b"GPSP", b"GPSY")))])
    assert value.has_position.all()
    assert any("GPSF" in line for line in value.warnings)


def test_heights_above_some_sea_level_are_of_unknown_datum() -> None:
    value = read_gpmf([packet(device(gps5(PLACES, extra=[klv("GPSA", "F", 4, 1, b"MSLV")])))])
    assert value.height_datum == "unknown"
    assert any("MSLV" in line for line in value.warnings)


def test_the_last_packet_keeps_the_usual_distance() -> None:
    """It lasts a second like the others, and is filled for a part of it."""
    packets = [
        packet(device(gps5(PLACES)), 0.0),
        packet(device(gps5(PLACES)), 1.0),
        packet(device(gps5(PLACES[:2])), 2.0),
    ]
    value = read_gpmf(packets)
    np.testing.assert_allclose(np.diff(value.times_s), 0.25, rtol=0, atol=1e-12)


def test_gps9_has_its_own_clock_and_fix() -> None:
    begin = datetime(2024, 2, 29, 23, 59, 59, 900_000, tzinfo=UTC)
    rows = [
        (47.1, 8.2, 500.0, begin, 0.0, 0),
        (47.1, 8.2, 500.0, begin + timedelta(seconds=0.1), 2.0, 2),
        (-47.2, -8.3, 501.0, begin + timedelta(seconds=0.2), 1.25, 3),
    ]
    value = read_gpmf([packet(device(gps5(PLACES), gps9(rows)))])
    assert value.source == "GPMF GPS9"
    assert value.has_position.tolist() == [False, True, True]
    np.testing.assert_allclose(value.latitude_deg[1:], [47.1, -47.2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        value.clock_s[1:], [begin.timestamp() + 0.1, begin.timestamp() + 0.2], atol=1e-6
    )
    assert np.isnan(value.height_m[1])
    assert value.height_datum == "unknown"


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        (gps5(PLACES).replace(b"deg", b"m/s"), "in deg, found units"),
        (gps5(PLACES).replace(b"SCAL", b"SCAX"), "without its scale"),
        (gps5(PLACES).replace(struct.pack(">i", 10_000_000), b"\0\0\0\0"), "none 0"),
        (
            gps5(PLACES).replace(b"GPS5l\x14\0\4", b"GPS5l\x10\0\5"),
            "expected 5 values in a sample of GPS5, found 4",
        ),
        (
            gps9([(1.0, 2.0, 3.0, datetime(2024, 1, 1, tzinfo=UTC), 1.0, 3)]).replace(
                b"lllllllSS", b"lllllllSB"
            ),
            "structure",
        ),
    ],
)
def test_a_stream_that_is_not_what_it_says_is_refused(spoilt: bytes, said: str) -> None:
    with pytest.raises(TelemetryError, match="expected a stream"):
        read_gpmf([packet(device(spoilt))])
    # Beside a good packet the bad one is told and left out.
    value = read_gpmf([packet(device(spoilt)), packet(device(gps5(PLACES)), 1.0)])
    assert len(value) == 4
    if b"GPS5" in spoilt:
        assert any(said in line for line in value.warnings)


def test_damaged_packets_are_left_out_and_told() -> None:
    good = device(gps5(PLACES))
    value = read_gpmf([packet(good, 0.0), packet(good[:-30], 1.0), packet(b"DEVC", 2.0), packet(good, 3.0)])
    assert len(value) == 8
    assert any("2 of 4 packets are damaged" in line for line in value.warnings)
    with pytest.raises(TelemetryError, match=r"none of 1 packets can be read \(GPMF: .*truncated"):
        read_gpmf([packet(good[:-30])])


def test_a_camera_without_a_receiver_has_no_positions() -> None:
    assert not has_positions([packet(device())])
    assert has_positions([packet(device()), packet(device(gps5(PLACES)))])
    with pytest.raises(TelemetryError, match=r"found none \(entries: ACCL, SCAL, STNM\)"):
        read_gpmf([packet(device())])


def test_packets_out_of_an_mp4(tmp_path: Path) -> None:
    film = tmp_path / "own.mp4"
    write_mp4(film, [("gpmd", [(1001, device(gps5(PLACES))), (1001, device(gps5(PLACES)))])])
    tracks = read_tracks(film)
    assert [(p.start_s, p.duration_s) for p in tracks.gpmf[0]] == [(0.0, 1.001), (1.001, 1.001)]
    assert tracks.gpmf[0][1].data == device(gps5(PLACES))
    value = read_telemetry(film)
    np.testing.assert_allclose(value.times_s, 1.001 * np.arange(8) / 4, rtol=0, atol=1e-9)
    assert value.origin == "own.mp4, GPMF track 0"


@LAWS
@given(st.binary(max_size=200))
def test_any_bytes_are_entries_or_refused(data: bytes) -> None:
    try:
        entries = parse_klv(data)
    except TelemetryError:
        return
    assert sum(8 + len(entry.data) for entry in entries) <= len(data) + 3 * len(entries)


@LAWS
@given(
    st.integers(0, 700),
    st.binary(min_size=0, max_size=8),
    st.integers(0, 8),
    st.integers(0, 700),
    st.integers(0, 255),
)
def test_any_damage_is_read_or_refused(at: int, junk: bytes, cut: int, where: int, byte: int) -> None:
    data = bytearray(
        device(gps5(PLACES), gps9([(47.0, 8.0, 400.0, datetime(2024, 1, 1, tzinfo=UTC), 1.0, 3)] * 3))
    )
    data[at : at + cut] = junk
    if where < len(data):
        data[where] = byte
    try:
        value = read_gpmf([packet(bytes(data))])
    except TelemetryError:
        return
    assert value.has_position.any()


@pytest.mark.real_data
def test_karma(shared_data: Path) -> None:
    """Against the packets taken apart by hand, MAVLink's GLOBAL_POSITION_INT in GPMF."""
    film = shared_data / "video" / "karma.mp4"
    value = read_telemetry(film)
    rows = []
    for each in read_tracks(film).gpmf[3]:
        at = each.data.index(b"GLPI?\x1c")
        count = struct.unpack_from(">H", each.data, at + 6)[0]
        rows += [struct.unpack_from(">I4i3hH", each.data, at + 8 + 28 * row) for row in range(count)]
    expected = np.array(rows, dtype=float)
    assert len(value) == len(expected) == 47
    np.testing.assert_allclose(value.latitude_deg, expected[:, 1] * 1e-7, rtol=0, atol=1e-9)
    np.testing.assert_allclose(value.longitude_deg, expected[:, 2] * 1e-7, rtol=0, atol=1e-9)
    np.testing.assert_allclose(value.height_m, expected[:, 3] * 1e-3, rtol=0, atol=1e-9)
    np.testing.assert_allclose(value.relative_height_m, expected[:, 4] * 1e-3, rtol=0, atol=1e-9)
    # A beach of Carlsbad, California.
    np.testing.assert_allclose(
        [value.latitude_deg[0], value.longitude_deg[0]], [33.12537, -117.33107], atol=1e-5
    )
    # The container was made at 19:27:57 UTC, says its own tag.
    made = datetime(2017, 4, 17, 19, 27, 57, tzinfo=UTC).timestamp()
    assert 0.0 < value.clock_s[0] - made < 1.0
    assert value.clock == "utc"
    assert value.times_s[0] == 0.0
    assert 11.5 < value.times_s[-1] < 12.08  # the film has 12.078 s
    np.testing.assert_allclose(np.diff(value.clock_s), 0.25, atol=0.01)
    assert value.height_datum == "unknown"
    assert np.isnan(value.gimbal_ypr_deg).all()
