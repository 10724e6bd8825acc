"""OpenDroneMap's geo.txt as a table of photos."""

from pathlib import Path

import pytest
from pyproj import Transformer

from featuredb.errors import IngestError
from ingest.photos.table import is_table, read_table


def table(folder: Path, text: str) -> Path:
    path = folder / "geo.txt"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "system", ["EPSG:32632", "WGS84 UTM 32N", "+proj=utm +zone=32 +datum=WGS84 +units=m"]
)
def test_positions_in_any_system(tmp_path: Path, system: str) -> None:
    path = table(
        tmp_path, f"{system}\nDJI_1.JPG 456800 5429300 120.5 10 0 0 0.02 0.04\nDJI_2.JPG 456810 5429300\n"
    )
    assert is_table(path)
    first, second = read_table(path).rows
    assert first.path == tmp_path / "DJI_1.JPG"
    there = Transformer.from_crs(4326, 32632, always_xy=True).transform(
        first.longitude_deg, first.latitude_deg
    )
    assert there == pytest.approx((456800.0, 5429300.0), abs=1e-3)
    assert (first.height_m, first.accuracy_m, first.accuracy_height_m) == (120.5, 0.02, 0.04)
    assert (second.height_m, second.accuracy_m) == (None, None)


def test_feet_are_metres_afterwards(tmp_path: Path) -> None:
    """Oregon's Lambert zone in international feet."""
    (row,) = read_table(table(tmp_path, "EPSG:2992\na.jpg 636000 851000 400 0 0 0 0.1 0.2\n")).rows
    assert (row.height_m, row.accuracy_m) == pytest.approx((121.92, 0.03048))


def test_a_line_that_cannot_be_read_costs_that_photo(tmp_path: Path) -> None:
    text = "EPSG:4326\na.jpg 8.4 49.0 -9999\nb.jpg 8.4\nc.jpg east north\nd.jpg inf 49.0\n"
    found = read_table(table(tmp_path, text))
    (row,) = found.rows
    assert (row.name, row.latitude_deg, row.longitude_deg, row.height_m) == ("a.jpg", 49.0, 8.4, None)
    assert [number for number, _ in found.bad] == [2, 3, 4]
    assert "expected x and y" in found.bad[0][1]


def test_without_a_system_nothing_is_guessed(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="first line has to name a coordinate system"):
        read_table(table(tmp_path, "a.jpg 8.4 49.0 120\n"))


def test_angles_count_from_straight_down(tmp_path: Path) -> None:
    """Pitch 0 looks down, 90 ahead; all zero is how nobody's angles are written."""
    lines = ("a.jpg 8.4 49 120 30 0 0", "b.jpg 8.4 49 120 30 60 0", "c.jpg 8.4 49 120 0 0 0 0.02 0.04")
    text = "\n".join(("EPSG:4326", *lines))
    a, b, c = (row.angles for row in read_table(table(tmp_path, text)).rows)
    assert a is not None
    assert b is not None
    assert (a.yaw_deg, a.pitch_deg) == pytest.approx((30.0, -90.0))
    assert (b.yaw_deg, b.pitch_deg) == pytest.approx((30.0, -30.0))
    assert c is None
