"""What is in the files of a scan: broken ones, systems that are missing, orthophotos, rasters of heights."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from numpy.testing import assert_allclose
from pyproj import Transformer

from featuredb.cli.main import main
from featuredb.errors import (
    FeatureDbError,
    GeodesyError,
    MissingExtraError,
    ScanError,
    ScanFileError,
)
from featuredb.lidar.add import AddOptions, add_scan
from featuredb.store import Database
from tests.support.geotiff import write_geotiff
from tests.support.las_files import SOUTH, WEST, grid_points, write_scan
from tests.support.stored_scans import sorted_rows, stored


@pytest.fixture
def database(tmp_path: Path) -> Database:
    return Database(str(tmp_path / "scans.db"))


def corrupt(data: bytes, at: int, value: bytes) -> bytes:
    return data[:at] + value + data[at + len(value) :]


BROKEN: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "empty": (lambda data: b"", "empty file"),
    "text": (lambda data: b"x,y,z\n1,2,3\n" * 40, "begins with 'LASF'"),
    "header only in part": (lambda data: data[:100], "header of at least 227 bytes"),
    "half": (lambda data: data[: len(data) // 2], "truncated"),
    "last bytes gone": (lambda data: data[:-40], "truncated"),
    "version 2.7": (lambda data: corrupt(data, 24, b"\x02\x07"), "truncated or broken|1.0 to 1.4"),
    "scale zero": (lambda data: corrupt(data, 131, b"\x00" * 8), "positive scales"),
    "offset NaN": (lambda data: corrupt(data, 155, np.float64(np.nan).tobytes()), "finite offsets"),
    "a million records": (lambda data: corrupt(data, 100, b"\x40\x42\x0f\x00"), "1000000 records"),
    "a million extended records": (
        lambda data: corrupt(data, 243, b"\x40\x42\x0f\x00"), "1000000 extended records"
    ),
    "no points": (lambda data: corrupt(corrupt(data, 247, b"\x00" * 8), 107, b"\x00" * 4), "empty"),
    "more points than there are": (
        lambda data: corrupt(data, 247, np.uint64(10**9).tobytes()), "truncated|expected"
    ),
    "scale of galaxies": (
        lambda data: corrupt(data, 131, np.float64(1e12).tobytes()), "broken|outside|none of"
    ),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("what", BROKEN)
def test_broken_files_are_named_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, suffix: str
) -> None:
    good = write_scan(tmp_path / f"good{suffix}", grid_points(), point_format=6)
    bad = tmp_path / f"bad{suffix}"
    spoil, message = BROKEN[what]
    bad.write_bytes(spoil(good.read_bytes()))
    folder = tmp_path / "scans.db"
    with pytest.raises((ScanError, GeodesyError), match=message) as caught:
        add_scan(Database(str(folder)), [good, bad])
    assert str(bad) in str(caught.value)
    assert not folder.exists()
    assert main(["lidar", "add", str(folder), str(bad), "--quiet"]) == 2
    assert str(bad) in capsys.readouterr().err
    assert not folder.exists()


def test_missing_files_and_missing_systems(database: Database, tmp_path: Path) -> None:
    with pytest.raises(ScanFileError, match="check the path"):
        add_scan(database, [tmp_path / "nothing.laz"])
    with pytest.raises(ScanError, match="at least one"):
        add_scan(database, [])
    nameless = write_scan(tmp_path / "nameless.laz", grid_points(), crs=None)
    with pytest.raises(GeodesyError, match=r"nameless\.laz: .*found none; .*--crs"):
        add_scan(database, [nameless])
    unnamed = write_scan(tmp_path / "unnamed.laz", grid_points(), crs='LOCAL_CS["unnamed",UNIT["metre",1]]')
    with pytest.raises(GeodesyError, match="--crs"):
        add_scan(database, [unnamed])
    assert not Path(database.url).exists()
    result = add_scan(database, [nameless], AddOptions(crs="EPSG:32632", height_datum="egm2008"))
    assert (result.scan.epsg, result.scan.height_datum) == (32632, "egm2008")


def test_bytes_changed_at_random_never_end_in_a_defect(tmp_path: Path) -> None:
    good = write_scan(tmp_path / "good.laz", grid_points(400), point_format=7).read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for trial in range(40):
        data = bytearray(good)
        for place in rng.integers(4, len(good) if trial % 2 else 500, rng.integers(1, 6)):
            data[place] = rng.integers(256)
        path = tmp_path / f"{trial}.laz"
        path.write_bytes(bytes(data))
        database = Database(str(tmp_path / f"{trial}.db"))
        try:
            add_scan(database, [path])
        except FeatureDbError:
            refused += 1
            assert not Path(database.url).exists()
    assert refused > 8


def test_header_boxes_that_lie_are_not_believed(database: Database, tmp_path: Path) -> None:
    path = write_scan(tmp_path / "a.las", grid_points(), point_format=6)
    data = bytearray(path.read_bytes())
    data[179:227] = np.array([1e7, 1e7, 1e7, 1e7, 0.0, 0.0]).tobytes()
    path.write_bytes(bytes(data))
    assert add_scan(database, [path]).scan.epsg == 32632


def test_ortho_colours_what_is_seen_from_above(database: Database, tmp_path: Path) -> None:
    ground = grid_points(10_000, 3, spacing=0.5)
    roof = ground[(np.abs(ground[:, :2] - [WEST + 25, SOUTH + 25]) < 5).all(axis=1)] + [0.0, 0.0, 6.0]
    path = write_scan(tmp_path / "a.laz", np.concatenate([ground, roof]))
    image = np.zeros((3, 60, 60), np.uint8)
    image[0] = 200
    tif = tmp_path / "ortho.tif"
    with rasterio.open(
        tif, "w", driver="GTiff", width=60, height=60, count=3, dtype="uint8", crs="EPSG:32632",
        transform=rasterio.Affine(1.0, 0.0, WEST - 5, 0.0, -1.0, SOUTH + 55),
    ) as file:  # fmt: skip
        file.write(image)
    plain = add_scan(database, [path]).scan
    scans = [
        add_scan(
            Database(str(tmp_path / f"{n}.db")),
            [path],
            AddOptions(block_points=n),
            ortho=tif,
        )
        for n in (1_000_000, 2500)
    ]
    assert scans[0].scan.scan_id == scans[1].scan.scan_id != plain.scan_id
    assert scans[0].scan.colour == "ortho"
    for result, name in zip(scans, ("1000000", "2500"), strict=True):
        found = stored(Database(str(tmp_path / f"{name}.db")))
        assert result.scan.points == len(ground) + len(roof)
        colour = found["red"] == 200
        high = found["height"] > 104.0
        inside = (found["easting"] < WEST + 48) & (found["northing"] < SOUTH + 48)
        below = (
            (np.abs(found["easting"] - WEST - 25) < 3) & (np.abs(found["northing"] - SOUTH - 25) < 3) & ~high
        )
        assert colour[high].mean() > 0.99
        assert colour[below].mean() < 0.01  # the lawn under the roof keeps its own: none
        assert colour[inside & ~below & ~high].mean() > 0.9


def test_an_image_of_another_place_is_refused_and_what_one_colours_is_told(
    database: Database, tmp_path: Path
) -> None:
    heights = np.full((30, 40, 1), 200.0, np.float32)
    place = {"epsg": 32632, "west": WEST, "north": SOUTH + 30.0, "pixel_m": 1.0}
    write_geotiff(tmp_path / "dsm.tif", heights, **place)
    grey = np.full((30, 40, 1), 90, np.uint8)
    west, north = Transformer.from_crs(32632, 32633, always_xy=True).transform(WEST + 5000, SOUTH)
    write_geotiff(tmp_path / "away.tif", grey, epsg=32633, west=west, north=north, pixel_m=1.0)
    write_geotiff(tmp_path / "half.tif", grey, **{**place, "west": WEST + 20.0})
    write_geotiff(tmp_path / "empty.tif", 0 * grey, **place, nodata=0)
    dsm = [tmp_path / "dsm.tif"]

    said = rf"away\.tif: expected an image of the scan's place, .*, found one of \[{west:.2f}.*--ortho-crs"
    with pytest.raises(ScanError, match=said):
        add_scan(database, dsm, ortho=tmp_path / "away.tif")
    assert not Path(database.url).exists()
    half = add_scan(database, dsm, ortho=tmp_path / "half.tif").scan
    assert (half.colour, half.row["notes"]) == ("ortho", ["the ortho image colours 50.0% of the points"])
    empty = add_scan(database, dsm, ortho=tmp_path / "empty.tif").scan
    assert (empty.colour, empty.row["notes"]) == ("", ["the ortho image colours 0.0% of the points"])


def test_heights_that_no_place_on_earth_has_are_in_another_unit(database: Database, tmp_path: Path) -> None:
    heights = np.linspace(11_000, 15_000, 1200, dtype=np.float32).reshape(30, 40, 1)  # centimetres
    dsm = tmp_path / "dsm.tif"
    write_geotiff(dsm, heights, epsg=32632, west=WEST, north=SOUTH + 30.0, pixel_m=1.0)
    said = (
        r"dsm\.tif: expected heights between -11000 and 9000 m, found 11000 to 15000 m by .*--height-unit.*"
    )
    with pytest.raises(GeodesyError, match=said + "-scale 0.01"):
        add_scan(database, [dsm])
    assert not Path(database.url).exists()
    add_scan(database, [dsm], AddOptions(height_unit="ft"))
    with rasterio.open(dsm, "r+") as file:
        file.scales = (0.01,)
    scan = add_scan(database, [dsm]).scan
    assert (scan.box.min_height, scan.box.max_height) == pytest.approx((110.0, 150.0))


def test_files_of_several_units_are_told_one_by_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metres = write_scan(tmp_path / "m.las", grid_points(400, spacing=1.0))
    xyz = grid_points(400, seed=1, spacing=1.0)
    feet = np.column_stack([xyz[:, :2], xyz[:, 2] / 0.3048])
    write_scan(tmp_path / "ft.las", feet, crs="EPSG:32632+8228")  # NAVD88 height (ft)
    db = str(tmp_path / "scans.db")
    files = [str(metres), str(tmp_path / "ft.las")]
    assert main(["lidar", "add", db, *files, "--height-datum", "navd88", "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "m.las has X, Y in metre, Z in metre (" in out
    assert "ft.las has X, Y in metre, Z in foot (unit of the vertical CRS " in out


@pytest.mark.parametrize("package", ["laspy", "lazrs"])
def test_a_missing_package_is_named(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    path = write_scan(tmp_path / "a.laz", grid_points())
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"{package}.*featuredb\[lidar\]"):
        add_scan(database, [path])
    assert not Path(database.url).exists()


@pytest.mark.parametrize("nodata", [-9999.0, None])
def test_a_raster_of_heights_is_a_scan_of_its_cells(
    database: Database, tmp_path: Path, nodata: float | None
) -> None:
    heights = np.add.outer(np.arange(30.0), np.arange(40.0))[:, :, None].astype(np.float32)
    heights[3:6, 7:9] = -9999.0
    place = {"epsg": 32632, "west": WEST, "north": SOUTH + 30.0, "pixel_m": 1.0}
    write_geotiff(tmp_path / "dsm.tif", heights, **place, nodata=nodata)
    grey = np.full((30, 40, 1), 90, np.uint8)
    write_geotiff(tmp_path / "ortho.tif", grey, **place)

    options = AddOptions(height_datum="ellipsoidal")
    ortho = tmp_path / "ortho.tif"
    scan = add_scan(database, [tmp_path / "dsm.tif"], options, ortho=ortho).scan

    rows, columns = np.nonzero(heights[:, :, 0] != -9999.0)
    expected = np.stack([WEST + columns + 0.5, SOUTH + 29.5 - rows, rows + columns], axis=1)
    found = stored(database)
    utm = np.stack([found[name] for name in ("easting", "northing", "height")], axis=1)
    assert_allclose(sorted_rows(utm), sorted_rows(expected), atol=1e-6)
    assert (scan.points, scan.colour, scan.has_intensity) == (len(expected), "ortho", False)


def test_a_picture_is_no_raster_of_heights(database: Database, tmp_path: Path) -> None:
    picture = np.zeros((9, 9, 3), np.uint8)
    write_geotiff(tmp_path / "ortho.tif", picture, epsg=32632, west=WEST, north=SOUTH, pixel_m=1.0)
    with pytest.raises(ScanFileError, match=r"one band of heights.*--ortho ortho\.tif"):
        add_scan(database, [tmp_path / "ortho.tif"])
