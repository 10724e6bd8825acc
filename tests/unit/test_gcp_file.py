"""OpenDroneMap's control point files: what is read, what is taken for granted, what is refused and how."""

import numpy as np
import pytest
from pyproj import CRS, Transformer

from featuredb.errors import ControlFileError, GeodesyError
from featuredb.geo.crs.survey import geodetic_from_survey, survey_crs
from ingest.register.control.control_file import parse_control_file, read_control_file

_MARK = "456800.5 5429300.25 {z} 100.5 200.25 a.jpg gcp1"


def test_names_tabs_comments_and_extra_columns() -> None:
    text = (
        "# survey of May\n\nWGS84 UTM 32N\n"
        "456800.5\t5429300.25\t120.5\t100.5\t200.25\tDCIM 1/my photo.jpg\tgcp 1\textra\n"
        "456800.5 5429300.25 120.5 10 20 b.jpg\n"
        "   456900 5429300.25 nan 10 20 b.jpg   \n"
        "456800.5 5429300.25 120.5 10 20 b.jpg\n"
    )
    file = parse_control_file(text, "gcp_list.txt")
    assert file.names == ("gcp 1", "point 2")
    assert [(m.point, m.photo, m.x, m.line) for m in file.marks] == [
        ("gcp 1", "DCIM 1/my photo.jpg", 100.5, 4),
        ("gcp 1", "b.jpg", 10.0, 5),
        ("point 2", "b.jpg", 10.0, 6),
    ]
    assert np.isnan(file.lat_lon_h[1, 2])
    assert np.isfinite(file.lat_lon_h[:, 2]).sum() == 1
    assert "line 7 repeats line 5" in file.notes
    assert "without a height: point 2" in file.notes
    expected = Transformer.from_crs(32632, 4326).transform(456800.5, 5429300.25)
    np.testing.assert_allclose(file.lat_lon_h[0], [*expected, 120.5], rtol=0, atol=1e-9)


def test_heights_of_zero_are_unknown_only_where_all_are() -> None:
    zero = parse_control_file("EPSG:32632\n" + _MARK.format(z="0.0"), "f")
    assert np.isnan(zero.lat_lon_h[:, 2]).all()
    assert any("exactly zero" in note for note in zero.notes)
    some = parse_control_file(
        "EPSG:32632\n" + _MARK.format(z="0") + "\n456810 5429300 3 1 2 a.jpg gcp2\n", "f"
    )
    assert some.lat_lon_h[:, 2].tolist() == [0.0, 3.0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty file"),
        ("EPSG:32632\n", "only a header"),
        (_MARK.format(z=1), "line 1: expected the reference system"),
        ("EPSG:1\n" + _MARK.format(z=1), "line 1: expected a coordinate reference system"),
        ("EPSG:32632\n1,2,3,4,5,a.jpg", "line 2: expected at least 6 columns .* not commas"),
        ("EPSG:32632\n1,5;2;3;4;5;a.jpg", "line 2: expected at least 6 columns .* not semicolons"),
        ("EPSG:32632\n\n1 2 3 4 5", "line 3: expected at least 6 columns .* found 5"),
        ("EPSG:32632\n" + _MARK.format(z="high"), "line 2: expected a number as geo_z, found 'high'"),
        ("EPSG:32632\n456800 5429300 0 -4 20 a.jpg", "line 2: expected pixels >= 0"),
        ("EPSG:4326\n456800 5429300 0 4 20 a.jpg", "line 2: expected longitude and latitude in degrees"),
        (
            "EPSG:32632\n" + _MARK.format(z=1) + "\n456801 5429300.25 1 3 4 b.jpg gcp1",
            "line 3: gcp1 is at 456801 .* line 2 says",
        ),
        (
            "EPSG:32632\n" + _MARK.format(z=1) + "\n456800.5 5429300.25 1 3 4 a.jpg gcp1",
            "line 3: gcp1 is marked in a.jpg a second time",
        ),
    ],
)
def test_faults_name_their_lines(text: str, words: str) -> None:
    with pytest.raises(ControlFileError, match=words):
        parse_control_file(text, "gcp_list.txt")


def test_all_faults_are_told_at_once_but_not_hundreds() -> None:
    text = "EPSG:32632\n" + "1 2 3\n" * 20
    with pytest.raises(ControlFileError) as caught:
        parse_control_file(text, "f")
    assert "line 2:" in str(caught.value)
    assert "line 9:" in str(caught.value)
    assert "and 12 more" in str(caught.value)


def test_a_given_system_replaces_the_first_line() -> None:
    without = parse_control_file(_MARK.format(z=1), "f", "EPSG:32632")
    instead = parse_control_file("EPSG:32633\n" + _MARK.format(z=1), "f", "EPSG:32632")
    np.testing.assert_array_equal(without.lat_lon_h, instead.lat_lon_h)


def test_feet_and_compound_systems() -> None:
    crs = survey_crs("EPSG:2994+6360")  # Oregon Lambert in feet, heights in US survey feet
    assert (crs.height_datum, crs.geographic) == ("navd88", False)
    (place,) = geodetic_from_survey(crs, [[636000.0, 849000.0, 100.0]])
    assert place[2] == pytest.approx(100 * 1200 / 3937)
    assert 43.9 < place[0] < 44.2
    assert -123.3 < place[1] < -122.9
    file = parse_control_file("EPSG:2994\n636000 849000 400 1 2 a.jpg", "f")
    assert file.lat_lon_h[0, 2] == pytest.approx(400 * 0.3048)
    assert any("unit of 0.3048 m" in note for note in file.notes)


def test_a_third_axis_says_what_heights_count_from_only_beside_degrees() -> None:
    plane = survey_crs(CRS("EPSG:2263").to_3d().to_wkt())  # New York in US survey feet
    assert (plane.height_datum, plane.geographic) == ("unknown", False)
    assert survey_crs("EPSG:4979").height_datum == "ellipsoidal"


@pytest.mark.parametrize("text", ["EPSG:5703", "EPSG:4978", "WGS84 UTM 61N", "here"])
def test_systems_that_are_no_plane_are_refused(text: str) -> None:
    with pytest.raises(GeodesyError, match="expected a"):
        survey_crs(text)


def test_unreadable_files(tmp_path: pytest.TempPathFactory) -> None:
    from pathlib import Path

    folder = Path(str(tmp_path))
    with pytest.raises(ControlFileError, match="cannot read"):
        read_control_file(folder / "none.txt")
    (folder / "photo.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(ControlFileError, match="plain text"):
        read_control_file(folder / "photo.jpg")
