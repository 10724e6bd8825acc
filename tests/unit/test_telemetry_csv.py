"""Tables of flight logs: names, units, clocks, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.formats.csv_table import read_csv
from featuredb.video.telemetry.formats.text import column_name, number

LAWS = settings(deadline=None, max_examples=150, derandomize=True)
NOON = 1717156800.0  # 2024-05-31T12:00:00Z, by `date -u +%s`

# The columns of Airdata's export, with numbers of our own; a row every 200 ms, the clock in whole seconds.
AIRDATA_NAMES = (
    "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),"
    "height_above_ground_at_drone_location(feet),altitude_above_seaLevel(feet),height_sonar(feet),speed(mph),"
    "satellites, compass_heading(degrees), pitch(degrees), roll(degrees),isPhoto,isVideo,"
    "gimbal_heading(degrees),gimbal_pitch(degrees),gimbal_roll(degrees),max_altitude(feet),altitude(feet)"
)


def airdata(rows: int = 12) -> bytes:
    lines = [AIRDATA_NAMES]
    for row in range(rows):
        ms = 5000 + 200 * row
        clock = f"2024-05-31 12:00:{(700 + 200 * row) // 1000:02d}"
        place = f"{47.5 + row * 1e-5:.9f},8.250000000"
        lines.append(f"{ms},{clock},{place},100,90,1500,0,3.5,14,350,1.5,-2.5,0,1,10,-90,0,400,100")
    return "\n".join(lines).encode()


def test_airdata() -> None:
    value = read_csv(airdata(), "flight.csv")
    np.testing.assert_allclose(value.times_s, 5.0 + 0.2 * np.arange(12), rtol=0, atol=1e-9)
    np.testing.assert_allclose(value.latitude_deg, 47.5 + 1e-5 * np.arange(12), rtol=0, atol=1e-12)
    np.testing.assert_allclose(value.relative_height_m, 30.48, rtol=0, atol=1e-9)  # 100 feet
    # 1500 feet above the sea, not the 100 of the column altitude(feet).
    np.testing.assert_allclose(value.height_m, 457.2, rtol=0, atol=1e-9)
    assert value.height_datum == "unknown"
    assert value.gimbal_ypr_deg[0].tolist() == [10.0, -90.0, 0.0]
    assert value.clock == "utc"
    # The truth at the first row was NOON + 0.7 s; whole seconds and rows of 0.2 s tell it within 0.1 s.
    np.testing.assert_allclose(value.clock_s, NOON + 0.7 + 0.2 * np.arange(12), rtol=0, atol=0.11)
    assert not value.in_video_time


@pytest.mark.parametrize(
    ("text", "name", "unit"),
    [
        ("height_above_takeoff(feet)", "height_above_takeoff", "feet"),
        (" altitude_above_seaLevel(feet)", "altitude_above_sea_level", "feet"),
        ("OSD.flyTime [s]", "osd_fly_time", "s"),
        ("OSD.yaw [360]", "osd_yaw", "360"),
        ("rel_alt_m", "rel_alt", "m"),
        ("Latitude", "latitude", ""),
        ("time_ms", "time", "ms"),
        ("datetime(utc)", "datetime", "utc"),
        ("m", "m", ""),
    ],
)
def test_names_and_units(text: str, name: str, unit: str) -> None:
    assert column_name(text) == (name, unit)


@pytest.mark.parametrize(
    ("text", "value"),
    [("1", 1.0), (" -2.50 ", -2.5), ("+.5", 0.5), ("3.", 3.0), ("1e-5", 1e-5), ("1E2", 100.0), ("1,5", 1.5)],
)
def test_numbers(text: str, value: float) -> None:
    assert number(text) == value


@pytest.mark.parametrize(
    "text", ["", "n/a", "nan", "inf", "0x10", "1_000", "٣", "1e999", "--1", "1,5,2", "1 2"]
)
def test_what_is_no_number(text: str) -> None:
    assert np.isnan(number(text))


@pytest.mark.parametrize(
    ("names", "rows", "times", "clock", "first"),
    [
        ("time_s,lat,lon", ["10.5,1,2", "11,1,2"], [10.5, 11.0], "none", np.nan),
        ("time(millisecond),lat,lon", ["500,1,2", "1500,1,2"], [0.5, 1.5], "none", np.nan),
        ("timestamp,lat,lon", [f"{NOON},1,2", f"{NOON + 2},1,2"], [0.0, 2.0], "utc", NOON),
        ("timestamp_ms,lat,lon", [f"{NOON:.0f}000,1,2", f"{NOON:.0f}250,1,2"], [0.0, 0.25], "utc", NOON),
        ("time,lat,lon", [f"{NOON * 1e6:.0f},1,2", f"{NOON * 1e6 + 5e5:.0f},1,2"], [0.0, 0.5], "utc", NOON),
        # More than 1e9 microseconds since take-off are no date.
        ("elapsed(us),lat,lon", ["1500000000,1,2", "1501000000,1,2"], [1500.0, 1501.0], "none", np.nan),
        ("time,lat,lon", ["2024-05-31T12:00:00Z,1,2", "2024-05-31T12:00:01.5Z,1,2"], [0.0, 1.5], "utc", NOON),
        ("UTC,lat,lon", ["2024-05-31 12:00:00,1,2", "2024-05-31 12:00:01,1,2"], [0.0, 1.0], "utc", NOON),
        ("time,lat,lon", ["2024-05-31 12:00:00,1,2", "2024-05-31 12:00:01,1,2"], [0.0, 1.0], "local", NOON),
        ("date_time(local),lat,lon", ["2024/05/31 12:00:00,1,2", "2024/05/31 12:00:01,1,2"], [0.0, 1.0],
         "local", NOON),
    ],
)  # fmt: skip
def test_times(names: str, rows: list[str], times: list[float], clock: str, first: float) -> None:
    value = read_csv("\n".join([names, *rows]).encode())
    np.testing.assert_allclose(value.times_s, times, rtol=0, atol=1e-6)
    assert value.clock == clock
    np.testing.assert_allclose(value.clock_s[0], first, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "time_s;latitude;longitude;altitude\n0,000;47,5;8,25;430,5\n1,000;47,50001;8,25;431\n",
        "time_s\tlatitude\tlongitude\taltitude\n0\t47.5\t8.25\t430.5\n\n1\t47.50001\t8.25\t431\n",
        'sep=,\r\n"Time_s","Latitude","Longitude","Altitude [m]"\r\n"0","47.5","8.25","430.5"\r\n'
        "1,47.50001,8.25,431\r\n",
    ],
)
def test_separators_commas_and_quotes(text: str) -> None:
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        value = read_csv(text.encode(encoding))
        assert value.times_s.tolist() == [0.0, 1.0]
        assert value.latitude_deg.tolist() == [47.5, 47.50001]
        assert value.longitude_deg.tolist() == [8.25, 8.25]
        assert value.height_m.tolist() == [430.5, 431.0]


def test_only_a_name_says_that_times_are_the_films() -> None:
    for name, factor in (("film_time_s", 1.0), ("video_time(ms)", 1e-3), ("Film time", 1.0)):
        value = read_csv(
            f"{name},utc,lat,lon\n10,2024-05-31 12:00:00,1,2\n11,2024-05-31 12:00:01,1,2\n".encode()
        )
        assert value.in_video_time
        np.testing.assert_allclose(value.times_s, [10.0 * factor, 11.0 * factor], rtol=0, atol=1e-12)
        assert value.clock == "utc"
    both = read_csv(b"elapsed_s,film_time_s,lat,lon\n100,0,1,2\n101,1,1,2\n")
    assert both.times_s.tolist() == [0.0, 1.0]
    assert both.in_video_time
    assert not read_csv(b"time_s,lat,lon\n0,1,2\n").in_video_time


def test_order_of_columns_is_that_of_the_names() -> None:
    value = read_csv(b"lon,time_s,lat\n-8.5,0,47.25\n")
    assert (value.latitude_deg[0], value.longitude_deg[0]) == (47.25, -8.5)


def test_ellipsoidal_heights_are_taken_first() -> None:
    value = read_csv(b"time_s,lat,lon,altitude,ellipsoidal_height_m\n0,1,2,10,60\n")
    assert (value.height_m[0], value.height_datum) == (60.0, "ellipsoidal")


def test_gaps_and_words_in_a_column() -> None:
    value = read_csv(b"time_s,lat,lon,alt\n0,1,2,5\n1,n/a,n/a,\n2,1,oops,6\n3,1,2,7\n\n4,1\n")
    assert value.has_position.tolist() == [True, False, False, True, False]
    assert any("1 values of longitude_deg are no numbers" in line for line in value.warnings)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a first line with columns"),
        ("a,b\n1,2\n", "found 'a, b'"),
        ("lat,lon\n1,2\n", "time, timestamp"),
        ("time,lat\n1,2\n", "longitude, lon or lng"),
        ("time,lat,lon\n", "no rows"),
        ("time_s,lat,lon,altitude(mph)\n0,1,2,3\n", "unit 'mph'; expected one of cm, feet"),
        ("time(feet),lat,lon\n0,1,2\n", "no time"),
        (
            "time,lat,lon\n31.05.2024 12:00,1,2\n",
            "year first like 2024-05-31T12:00:00Z, found '31.05.2024 12:00'",
        ),
        ("time,lat,lon\n6/1/2024 4:06:17 PM,1,2\n", "year first"),
        (
            "time_s,lat,lon\n0,N 47 30,E 8 15\n1,N 47 31,E 8 15\n",
            "expected numbers in the column of latitude_deg",
        ),
        ("time_s,lat,lon\n0,5262000,465000\n", "none with a position"),
        ('time_s,lat,lon\n0,"1,2\n' + "x" * 200_000, "cannot be read as a table"),
        ("time_s,lat,lon\n" + "," * 5000, "5001 columns"),
        (
            "time,lat,lon\n0,1,2\n200,1,2\n400,1,2\n",
            "200 apart: seconds or thousandths. Write time_s or time_ms",
        ),
        ("time_s,lat,lon,lat\n0,1,2,3\n", "2 columns are the latitude_deg by their names, 'lat', 'lat'"),
        # Read cell by cell these would be a place 5 degrees east.
        ("time_s,lat,lon\n0,47,5,8,25\n1,47,6,8,26\n", "semicolons between its cells"),
    ],
)
def test_what_cannot_be_read_says_why(text: str, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        read_csv(text.encode(), "some.csv")


@LAWS
@given(st.binary(max_size=60), st.integers(0, 700), st.integers(0, 60))
def test_any_damage_is_read_or_refused(junk: bytes, at: int, length: int) -> None:
    data = airdata(4)
    try:
        value = read_csv(data[:at] + junk + data[at + length :])
    except TelemetryError:
        return
    assert value.has_position.any()


cells = st.one_of(
    st.text(alphabet="0123456789.,-+eE:TZ \"';", max_size=12),
    st.floats().map(repr),
    st.integers(-(10**20), 10**20).map(str),
)


@LAWS
@given(st.lists(st.tuples(cells, cells, cells, cells), min_size=1, max_size=6))
def test_any_cells_are_read_or_refused(rows: list[tuple[str, str, str, str]]) -> None:
    text = "time,lat,lon,altitude(feet)\n" + "\n".join(",".join(row) for row in rows)
    try:
        value = read_csv(text.encode())
    except TelemetryError:
        return
    assert np.isfinite(value.times_s).all()
