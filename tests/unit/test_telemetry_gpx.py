"""GPX: tracks with times, what is left out, and documents that mean harm."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.formats.gpx import read_gpx

LAWS = settings(deadline=None, max_examples=120, derandomize=True)

GPX = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1">
  <metadata><time>1999-01-01T00:00:00Z</time></metadata>
  <wpt lat="1.0" lon="2.0"><time>2024-05-31T12:00:00Z</time></wpt>
  <trk><trkseg>
    <trkpt lat="47.5" lon="8.25"><ele>430.5</ele><time>2024-05-31T12:00:00Z</time><hdop>1.5</hdop></trkpt>
    <trkpt lat="47.50001" lon="8.25"><ele>431</ele><time>2024-05-31T14:00:01.5+02:00</time>
      <extensions><x:speed xmlns:x="urn:x">3.5</x:speed><x:time xmlns:x="urn:x">1970-01-01T00:00:00Z</x:time>
      </extensions></trkpt>
    <trkpt lat="47.6" lon="8.3"></trkpt>
    <trkpt lat="47.7" lon="8.4"><time>2024-05-31T12:00:02Z</time><fix>none</fix></trkpt>
  </trkseg><trkseg>
    <trkpt lat="-0.0" lon="0.0"><time>2024-05-31T12:00:03Z</time></trkpt>
    <trkpt lat="95" lon="8.4"><time>2024-05-31T12:00:04Z</time></trkpt>
    <trkpt lat="47.50002" lon="8.25"><time>2024-05-31T12:00:05Z</time></trkpt>
  </trkseg></trk>
</gpx>
"""


def test_points_with_times_are_samples() -> None:
    value = read_gpx(GPX.encode(), "own.gpx")
    assert value.times_s.tolist() == [0.0, 1.5, 2.0, 3.0, 4.0, 5.0]
    assert value.has_position.tolist() == [True, True, False, False, False, True]
    assert value.latitude_deg[[0, 1, 5]].tolist() == [47.5, 47.50001, 47.50002]
    assert value.longitude_deg[0] == 8.25
    assert value.height_m[:2].tolist() == [430.5, 431.0]
    assert value.height_datum == "unknown"
    assert value.clock == "utc"
    # 2024-05-31T12:00:00Z, by `date -u +%s`.
    assert value.clock_s[0] == 1717156800.0
    assert not value.in_video_time
    told = " ".join(value.warnings)
    assert "1 of 7 track points have no time" in told
    assert "1 positions out of range" in told
    assert "1 positions at 0, 0" in told


def test_decimal_commas_are_read() -> None:
    assert read_gpx(GPX.replace('"47.5"', '"47,5"').encode()).latitude_deg[0] == 47.5


def test_gpx_1_0_and_utf_16_are_read_too() -> None:
    old = GPX.replace("GPX/1/1", "GPX/1/0").replace('encoding="UTF-8"', 'encoding="UTF-16"')
    assert read_gpx(old.encode("utf-16")).latitude_deg[0] == 47.5


def test_points_out_of_order_are_sorted_and_equal_times_told() -> None:
    text = GPX.replace("12:00:05Z", "11:59:59Z").replace("12:00:03Z", "12:00:02Z")
    value = read_gpx(text.encode())
    assert value.times_s.tolist() == [0.0, 1.0, 2.5, 3.0, 5.0]
    assert value.latitude_deg[0] == 47.50002
    assert any("sorted" in line for line in value.warnings)
    assert any("1 of 6 samples left out" in line for line in value.warnings)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_refused_before_they_expand(encoding: str) -> None:
    bomb = '<!DOCTYPE gpx [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    text = GPX.replace("<gpx ", bomb + "<gpx ", 1).replace("UTF-8", encoding).replace(">430.5<", ">&b;<")
    with pytest.raises(TelemetryError, match="DOCTYPE"):
        read_gpx(text.encode(encoding))
    outside = text.replace(bomb, '<!DOCTYPE gpx SYSTEM "file:///etc/passwd">').replace("&b;", "1")
    with pytest.raises(TelemetryError, match="DOCTYPE"):
        read_gpx(outside.encode(encoding))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no well-formed XML"),
        ("latitude,longitude\n1,2\n", "no well-formed XML"),
        (GPX[:900], "no well-formed XML"),
        (GPX.replace("UTF-8", "no-such-encoding"), "no well-formed XML"),
        ("<kml/>", "found <kml>"),
        ("<gpx><wpt lat='1' lon='2'/></gpx>", "without track points"),
        (
            "<gpx><trk><trkseg><trkpt lat='1' lon='2'/></trkseg></trk></gpx>",
            "none of 1 track points has a <time>",
        ),
        (re.sub('lat="[^"]*"', 'lat="x"', GPX), "none with a position"),
        ("<gpx>" + "<a>" * 200 + "</a>" * 200 + "</gpx>", "nested"),
    ],
)
def test_what_cannot_be_read_says_why(text: str, said: str) -> None:
    with pytest.raises(TelemetryError, match=said):
        read_gpx(text.encode())


@LAWS
@given(st.binary(max_size=40), st.integers(0, len(GPX)), st.integers(0, 60))
def test_any_damage_is_read_or_refused(junk: bytes, at: int, length: int) -> None:
    data = GPX.encode()
    try:
        value = read_gpx(data[:at] + junk + data[at + length :])
    except TelemetryError:
        return
    assert value.has_position.any()
