"""Heights through geoid grids that PROJ itself reads, in its own file format, with values known here."""

import struct
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from featuredb.geo.datum import ellipsoidal_height, find_geoid_grid


def write_gtx(path: Path, south: float, west: float, undulation: np.ndarray, spacing: float = 1.0) -> None:
    """A geoid grid (rows from south to north, metres) in NOAA's GTX format."""
    rows, columns = undulation.shape
    header = struct.pack(">4d2i", south, west, spacing, spacing, rows, columns)
    path.write_bytes(header + undulation.astype(">f4").tobytes())


@pytest.fixture
def grids(tmp_path: Path) -> Path:
    """A folder, with a blank in its name, of one grid for EGM96 around Karlsruhe and one for NAVD88."""
    folder = tmp_path / "proj grids"
    folder.mkdir()
    write_gtx(folder / "egm96_15.gtx", 48.0, 8.0, np.array([[48.0, 47.0], [46.0, 45.0]]))
    write_gtx(folder / "g2018u0.gtx", 39.0, -106.0, np.full((3, 3), -16.0))
    return folder


def test_undulation_is_added_by_bilinear_interpolation(grids: Path) -> None:
    answer = ellipsoidal_height(48.25, 8.5, 100.0, "egm96", grid_directories=[grids])
    # Rows run north: 0.75 of (48 + 47) / 2 and 0.25 of (46 + 45) / 2.
    assert answer.height_m == pytest.approx(100.0 + 0.75 * 47.5 + 0.25 * 45.5, abs=1e-4)


def test_place_outside_the_grid_is_a_reason(grids: Path) -> None:
    answer = ellipsoidal_height(10.0, 10.0, 100.0, "egm96", grid_directories=[grids])
    assert answer.height_m is None
    assert "outside" in answer.reason


def test_navd88_leads_through_nad83_to_wgs84(grids: Path) -> None:
    answer = ellipsoidal_height(40.0, -105.0, 1600.0, "navd88", grid_directories=[grids])
    # Independent: PROJ's database takes NAD83(2011) to ITRF2014, at the reference epoch of EPSG:8970.
    nad83_to_itrf = Transformer.from_crs("EPSG:6319", "EPSG:7912")
    expected = nad83_to_itrf.transform(40.0, -105.0, 1600.0 - 16.0, 2010.0)[2]
    assert answer.height_m == pytest.approx(expected, abs=2e-3)
    assert abs(expected - 1584.0) > 0.5  # the step that is so often left out


def test_present_names_come_before_former_ones(grids: Path) -> None:
    assert find_geoid_grid("egm96", [grids]) == (grids / "egm96_15.gtx").resolve()
    (grids / "us_nga_egm96_15.tif").write_bytes(b"")
    assert find_geoid_grid("egm96", [grids]) == (grids / "us_nga_egm96_15.tif").resolve()
    assert find_geoid_grid("egm2008", [grids]) is None
    assert find_geoid_grid("ellipsoidal", [grids]) is None


def test_broken_grid_is_a_reason_and_no_crash(grids: Path) -> None:
    (grids / "us_nga_egm96_15.tif").write_bytes(b"not a grid")
    answer = ellipsoidal_height(48.25, 8.5, 100.0, "egm96", grid_directories=[grids])
    assert answer.height_m is None
    assert "us_nga_egm96_15.tif" in answer.reason
