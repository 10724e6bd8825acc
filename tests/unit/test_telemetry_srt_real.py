"""Subtitles of real drones, 19 files: first and last places read off them by eye, and what is refused."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from featuredb.errors import TelemetryError
from featuredb.video.telemetry.read import read_telemetry
from featuredb.video.telemetry.values import Telemetry

pytestmark = pytest.mark.real_data


class Expected(NamedTuple):
    """Dialect, samples, samples with a fix, first and last (time, latitude, longitude)."""

    source: str
    samples: int
    fixes: int
    first: tuple[float, float, float]
    last: tuple[float, float, float]


# Longitudes beyond 90 degrees, "latitude:" beside the number, or the place itself (Zurich's airport lies at
# 47.46 N 8.55 E, Pamplona at 42.8 N 1.6 W, Cadiz at 36.5 N 6.3 W, Buenos Aires at 34.6 S 58.4 W).
FILES = {
    "air2s.srt": Expected("bracketed", 17, 17, (0.0, 41.424724, 2.234156), (0.533, 41.42473, 2.234102)),
    "broken_incomplete.SRT": Expected(
        "HOME/GPS BAROMETER", 19, 19, (1.0, -34.7383, -58.4563), (19.0, -34.7383, -58.4563)
    ),
    "broken_incomplete2.SRT": Expected(
        "bracketed", 5, 4, (0.0, -34.86995, -57.823395), (0.16, -34.869945, -57.823383)
    ),
    "m2zoom.SRT": Expected("bracketed", 600, 600, (0.0, 31.452012, 74.398751), (9.993, 31.452012, 74.398748)),
    "matrice_300.srt": Expected("GPS metres", 381, 381, (0.0, 36.6146, -6.112), (380.0, 36.6146, -6.112)),
    "MAVIC3.srt": Expected("bracketed", 600, 600, (0.0, 3.41531, -3.3744), (11.98, 3.41531, -3.3744)),
    "mavic_2_style.SRT": Expected(
        "bracketed", 463, 463, (0.0, -20.2533, 149.0251), (468.0, -20.2532, 149.0251)
    ),
    "mavic_2pro_new.SRT": Expected(
        "bracketed", 600, 600, (0.0, -35.080155, -60.286702), (26.8, -35.08136, -60.286324)
    ),
    "mavic_air2.srt": Expected("bracketed", 25, 25, (0.0, 41.420684, 2.162162), (0.4, 41.420686, 2.162162)),
    "mavic_mini.SRT": Expected("F/SS line", 117, 117, (0.0, 48.0771, -121.7458), (116.0, 48.0775, -121.7476)),
    "mavic_pro.SRT": Expected(
        "HOME/GPS BAROMETER", 468, 468, (1.0, -20.2533, 149.0251), (468.0, -20.2532, 149.0251)
    ),
    "mavic_pro_buggy.SRT": Expected(
        "HOME/GPS BAROMETER", 546, 530, (1.0, 42.4668, -1.2218), (546.0, 42.4668, -1.2217)
    ),
    "mix_p4rtk_mavic2pro.srt": Expected(
        "F/SS line + bracketed", 12, 12, (904.904, -34.6502, -59.409424), (910.242, -34.65118, -59.409483)
    ),
    "old_format.SRT": Expected(
        "HOME/GPS Hb Hs", 468, 468, (1.0, -20.2533, 149.0251), (468.0, -20.2532, 149.0251)
    ),
    "p4_rtk.SRT": Expected(
        "F/SS line", 55, 55, (0.0, -34.237922, -58.851745), (54.0, -34.232349, -58.849196)
    ),
    "p4p_sample.SRT": Expected("F/SS line", 5, 5, (0.0, 47.4692, 8.209), (4.0, 47.4692, 8.209)),
}
REFUSED = {
    "broken_empty.SRT": "the file is empty",
    "broken_empty2.SRT": "none with a drone's telemetry",
    "mavic_air.SRT": "2 samples, none with a position",
}


def read(shared_data: Path, name: str) -> Telemetry:
    return read_telemetry(shared_data / "video" / "dji_srt" / name)


def warns(value: Telemetry, part: str) -> bool:
    return any(part in line for line in value.warnings)


def test_every_file_is_accounted_for(shared_data: Path) -> None:
    names = {path.name for path in (shared_data / "video" / "dji_srt").iterdir()} - {"LICENSE"}
    assert names == FILES.keys() | REFUSED.keys()
    assert len(names) == 19


@pytest.mark.parametrize("name", sorted(FILES))
def test_read(shared_data: Path, name: str) -> None:
    value, expected = read(shared_data, name), FILES[name]
    assert value.source == f"SRT, {expected.source}"
    assert (len(value), int(value.has_position.sum())) == (expected.samples, expected.fixes)
    for row, (time_s, latitude, longitude) in ((0, expected.first), (-1, expected.last)):
        assert value.times_s[row] == pytest.approx(time_s, abs=1e-6)
        assert (value.latitude_deg[row], value.longitude_deg[row]) == (latitude, longitude)
    assert value.height_datum == "unknown"


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_refused(shared_data: Path, name: str) -> None:
    with pytest.raises(TelemetryError, match=REFUSED[name]):
        read(shared_data, name)


def test_one_flight_in_three_dialects_is_one_flight(shared_data: Path) -> None:
    """Longitude first twice, and once by name: the same places at the same seconds."""
    barometer, sonar = read(shared_data, "mavic_pro.SRT"), read(shared_data, "old_format.SRT")
    np.testing.assert_array_equal(barometer.latitude_deg, sonar.latitude_deg)
    np.testing.assert_array_equal(barometer.longitude_deg, sonar.longitude_deg)
    # Somebody changed one height by hand: BAROMETER:66.0 in block 331 of one file, Hb:63.0 in the other.
    np.testing.assert_array_equal(
        np.flatnonzero(barometer.relative_height_m != sonar.relative_height_m), [330]
    )
    np.testing.assert_array_equal(barometer.clock_s, sonar.clock_s)
    named = read(shared_data, "mavic_2_style.SRT")
    shared = np.flatnonzero(np.isin(np.floor(named.clock_s), barometer.clock_s))
    rows = np.searchsorted(barometer.clock_s, np.floor(named.clock_s[shared]))
    assert len(shared) == len(named)
    np.testing.assert_array_equal(named.latitude_deg[shared], barometer.latitude_deg[rows])
    np.testing.assert_array_equal(named.longitude_deg[shared], barometer.longitude_deg[rows])


def test_the_distance_from_take_off_confirms_the_order(shared_data: Path) -> None:
    """Nothing in this file is beyond 90 degrees; 699 m to 160 m fit one order within half a metre."""
    value = read(shared_data, "p4_rtk.SRT")
    home_latitude, home_longitude = -34.232707, -58.847509
    north = (value.latitude_deg - home_latitude) * 111_195.0
    east = (value.longitude_deg - home_longitude) * 111_195.0 * np.cos(np.radians(home_latitude))
    distance = np.hypot(north, east)
    assert distance[0] == pytest.approx(698.70, abs=0.5)
    assert distance[-1] == pytest.approx(159.98, abs=0.5)
    assert not warns(value, "order of coordinates")


def test_what_only_spelling_tells_is_said(shared_data: Path) -> None:
    unconfirmed = {
        name for name in FILES if warns(read(shared_data, name), "nothing else in the file confirms it")
    }
    assert unconfirmed == {
        "broken_incomplete.SRT", "matrice_300.srt", "mavic_pro_buggy.SRT", "p4p_sample.SRT"
    }  # fmt: skip


def test_other_values(shared_data: Path) -> None:
    rtk = read(shared_data, "p4_rtk.SRT")
    assert rtk.relative_height_m[[0, -1]].tolist() == [85.8, 85.8]
    assert rtk.gimbal_ypr_deg[0].tolist() == [110.4, -24.4, 0.0]
    mavic3 = read(shared_data, "MAVIC3.srt")
    assert mavic3.relative_height_m[[0, -1]].tolist() == [-2.4, -2.5]
    assert mavic3.height_m[[0, -1]].tolist() == [0.401, 0.301]
    assert mavic3.clock == "local"
    # `date -u -d "2021-12-25 12:27:52.373" +%s.%N`
    assert mavic3.clock_s[0] == pytest.approx(1640435272.373, abs=1e-6)
    matrice = read(shared_data, "matrice_300.srt")
    assert matrice.relative_height_m[:3].tolist() == [0.3, 0.3, 0.8]
    assert np.isnan(matrice.height_m).all()
    assert read(shared_data, "m2zoom.SRT").height_m[0] == pytest.approx(213.983002)


def test_damage_and_joins_are_told(shared_data: Path) -> None:
    assert warns(read(shared_data, "broken_incomplete.SRT"), "last block is cut off")
    second = read(shared_data, "broken_incomplete2.SRT")
    assert warns(second, "last block is cut off")
    assert warns(second, "1 of 6 blocks are damaged")
    assert second.has_position.tolist() == [True, True, False, True, True]
    assert warns(read(shared_data, "mavic_2pro_new.SRT"), "+14.2 s ahead of the video at 24.16 s")
    mix = read(shared_data, "mix_p4rtk_mavic2pro.srt")
    assert warns(mix, "2 dialects in one file")
    assert warns(mix, "the place leaps by 112 m in 0.03 s")
    buggy = read(shared_data, "mavic_pro_buggy.SRT")
    assert np.flatnonzero(~buggy.has_position)[:2].tolist() == [14, 15]
    assert not read(shared_data, "mavic_2_style.SRT").in_video_time


def test_between_the_seconds_of_a_real_flight(shared_data: Path) -> None:
    value = read(shared_data, "p4_rtk.SRT")
    there = value.at([0.5, 54.4, 55.0])
    assert there.latitude_deg[0] == pytest.approx((-34.237922 - 34.237911) / 2, abs=1e-9)
    assert there.longitude_deg[0] == pytest.approx((-58.851745 - 58.851740) / 2, abs=1e-9)
    assert there.has_position.tolist() == [True, True, False]
