"""Scan and ortho image of a world as files, and the ortho image against the painted ground."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from featuredb.cli import simworld as command
from featuredb.errors import GeodesyError, MissingExtraError
from featuredb.geo.crs.scan import scan_crs
from featuredb.geo.crs.wkt import utm_wkt
from featuredb.simworld import scan_world
from featuredb.simworld.flight import FlightOptions
from featuredb.simworld.laser.airborne import AirborneScanOptions, scan_town
from featuredb.simworld.ortho import Ortho, OrthoOptions, make_ortho
from featuredb.simworld.scan_world import (
    ORTHO_FILE,
    OTHER_ORTHO_FILE,
    OTHER_SCAN_FILE,
    SCAN_FILE,
    other_town_here,
    write_lidar,
    write_scan,
)
from featuredb.simworld.town.ground import paint_ground
from featuredb.simworld.town.scene import DayOptions, Scene
from featuredb.simworld.town.town import make_town
from featuredb.simworld.world import WorldOptions, town_of

WORLD = WorldOptions(
    seed=3,  # of `town`, too: what walls look like is painted once for each seed
    town_size_m=(155.0, 150.0),
    flight=FlightOptions(lines=1, per_line=1, oblique=0, width=160),
    queries=1,
    query_width=160,
    street=0,
    negatives_per_kind=0,
    workers=1,
)
SCAN = AirborneScanOptions(density_per_m2=0.5, margin_m=5.0)
ORTHO = OrthoOptions(pixel_m=1.0, margin_m=5.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("world")
    write_lidar(folder, WORLD, scan=SCAN, ortho=ORTHO)
    return folder


def test_the_scan_reads_back(folder: Path) -> None:
    scene = town_of(WORLD)
    scan = scan_town(scene, SCAN)
    las = laspy.read(folder / SCAN_FILE)
    assert las.header.version == "1.4"
    assert las.header.point_format.id == 6
    np.testing.assert_allclose(las.xyz, scan.utm(), atol=0.00051)
    for name in ("intensity", "classification", "return_number", "number_of_returns"):
        np.testing.assert_array_equal(np.asarray(las[name]), getattr(scan, name))
    np.testing.assert_allclose(las.scan_angle * 0.006, scan.scan_angle_deg, atol=0.0031)
    np.testing.assert_array_equal(las.gps_time, scan.gps_time_s)
    np.testing.assert_array_equal(las.point_source_id, scan.strip)
    # UTM back into the local frame: where the beams met the town.
    back = scene.frame.enu_from_utm(np.asarray(las.xyz)[::997], scene.epsg)
    np.testing.assert_allclose(back, scan.xyz[::997], atol=0.001)


def test_the_scan_says_where_it_is(folder: Path) -> None:
    """As the store reads it: UTM, ellipsoidal heights, metres."""
    with laspy.open(folder / SCAN_FILE) as file:
        wkt = next(v.string for v in file.header.vlrs if type(v).__name__ == "WktCoordinateSystemVlr")
        assert file.header.global_encoding.wkt
        parsed = file.header.parse_crs()
    assert parsed is not None
    assert parsed.to_2d().equals("EPSG:32632", ignore_axis_order=True)
    crs = scan_crs(wkt=wkt)
    assert (crs.height_datum, crs.height_unit_m, crs.horizontal_unit) == ("ellipsoidal", 1.0, "metre")
    for datum in ("egm96", "egm2008", "navd88", "unknown"):
        assert scan_crs(wkt=utm_wkt(32719, datum)).height_datum == datum
    with pytest.raises(GeodesyError, match="UTM"):
        utm_wkt(25832, "egm96")


def test_another_town_stands_at_the_same_place(folder: Path) -> None:
    here, there = laspy.read(folder / SCAN_FILE), laspy.read(folder / OTHER_SCAN_FILE)
    np.testing.assert_allclose(here.header.mins[:2], there.header.mins[:2], atol=60)
    np.testing.assert_allclose(here.header.maxs[:2], there.header.maxs[:2], atol=60)
    town, other = town_of(WORLD), other_town_here(WORLD)
    assert other.frame == town.frame
    places = [np.array([[b.x, b.y] for b in s.plan.buildings]) for s in (town, other)]
    nearest = np.linalg.norm(places[0][:, None] - places[1][None], axis=2).min(axis=1)
    assert np.median(nearest) > 1.0
    with rasterio.open(folder / ORTHO_FILE) as a, rasterio.open(folder / OTHER_ORTHO_FILE) as b:
        assert a.crs.to_epsg() == b.crs.to_epsg() == 32632


@pytest.fixture(scope="module")
def town() -> Scene:
    return make_town(3, size_m=(160.0, 150.0))


@pytest.fixture(scope="module")
def today() -> OrthoOptions:
    """The scene's own day, and colours as they are."""
    still = DayOptions(cars_gone=1.0)
    return OrthoOptions(
        pixel_m=0.25, margin_m=0.0, season=(1.0, 1.0, 1.0), contrast=1.0, gamma=1.0, day=still, spacing_m=90.0
    )


def ground_as_painted(town: Scene, ortho: Ortho) -> NDArray[np.uint8]:
    """Grey values (h, w) of the painted ground at the ortho image's pixels, each taken through geodesy."""
    h, w = ortho.rgb.shape[:2]
    x, y = np.meshgrid(
        ortho.west + (np.arange(w) + 0.5) * ortho.pixel_m, ortho.north - (np.arange(h) + 0.5) * ortho.pixel_m
    )
    utm = np.stack([x.ravel(), y.ravel(), np.full(x.size, town.frame.height_m)], axis=1)
    in_town = (town.frame.enu_from_utm(utm, ortho.epsg) @ town.enu_from_town)[:, :2]
    texture = paint_ground(town.plan, town.texel_m)
    u, v = (in_town + 0.5 * np.asarray(town.plan.size)).T.astype(np.float32)
    inside = (u > 0) & (v > 0) & (u < town.plan.size[0]) & (v < town.plan.size[1])
    u, v = (np.where(inside, c, 1.0).astype(np.float32).reshape(h, w) for c in (u, v))
    grey = cv2.cvtColor(texture.sample(u, v, 2), cv2.COLOR_RGB2GRAY)
    return np.where(inside.reshape(h, w), grey, 0).astype(np.uint8)


def test_the_ground_lies_where_it_is(town: Scene, today: OrthoOptions) -> None:
    """With and without leaning roofs the streets are at their coordinates, or off by what was asked."""
    for lean, shift in ((True, (0.0, 0.0)), (False, (0.6, -0.4))):
        ortho = make_ortho(town, replace(today, lean=lean, shift_m=shift))
        grey = cv2.cvtColor(ortho.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        painted = ground_as_painted(town, ortho).astype(np.float32)
        (dx, dy), response = cv2.phaseCorrelate(
            painted, grey, cv2.createHanningWindow(grey.shape[::-1], cv2.CV_32F)
        )
        assert response > 0.1
        assert dx == pytest.approx(shift[0] / 0.25, abs=0.08)
        assert dy == pytest.approx(-shift[1] / 0.25, abs=0.08)
        inside = painted > 0
        assert np.corrcoef(painted[inside], grey[inside])[0, 1] > (0.3 if any(shift) else 0.5)


def test_roofs_lean_by_height_over_flying_height(town: Scene, today: OrthoOptions) -> None:
    """The tallest flat roof is found shifted away from below the camera by h / (H - h) times its distance."""
    tower = max((b for b in town.plan.buildings if b.ridge == 0), key=lambda b: b.eaves)
    one = replace(today, spacing_m=300.0, flight_height_m=300.0, pixel_m=0.15)
    leaning, upright = make_ortho(town, one), make_ortho(town, replace(one, lean=False))
    corner = np.array([*tower.footprint().mean(axis=0), tower.eaves])
    utm = town.frame.utm_from_enu(town.enu_from_town @ corner, town.epsg)
    column = round((utm[0] - upright.west) / 0.15)
    row = round((upright.north - utm[1]) / 0.15)
    patch = cv2.cvtColor(upright.rgb[row - 20 : row + 20, column - 40 : column + 40], cv2.COLOR_RGB2GRAY)
    around = cv2.cvtColor(leaning.rgb[row - 80 : row + 80, column - 100 : column + 100], cv2.COLOR_RGB2GRAY)
    score = cv2.matchTemplate(around, patch, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(score.argmax()), score.shape)
    shift = np.array([x - 60, 60 - y]) * 0.15  # east, north
    assert score.max() > 0.6
    rng = np.random.default_rng((town.seed, one.seed, 71))
    station = rng.uniform(-0.35, 0.35, 2) * one.spacing_m
    ground = float(town.plan.height(tower.y))
    # What stands out on the roof are machines, up to 1.6 m higher.
    low, high = (
        np.linalg.norm(corner[:2] - station) * (z - ground) / (one.flight_height_m - z)
        for z in (tower.eaves, tower.eaves + 1.6)
    )
    away = town.enu_from_town[:2, :2] @ (corner[:2] - station)
    away /= np.linalg.norm(away)
    assert low > 2.0
    assert low - 0.2 < shift @ away < high + 0.2
    assert abs(shift @ [-away[1], away[0]]) < 0.3


def test_another_day_looks_different(town: Scene) -> None:
    options = OrthoOptions(pixel_m=0.5, margin_m=0.0, lean=False)
    image = make_ortho(town, options)
    np.testing.assert_array_equal(image.rgb, make_ortho(town, options).rgb)
    later = make_ortho(town, replace(options, seed=2, day=DayOptions(seed=8)))
    # Shadows, cars and waves; what is left is noise of some grey values.
    assert 0.02 < (np.abs(image.rgb.astype(int) - later.rgb).max(axis=2) > 30).mean() < 0.5


def test_a_scan_with_colours_is_written(tmp_path: Path, town: Scene) -> None:
    scan = scan_town(town, replace(SCAN, density_per_m2=0.3))
    rgb = np.random.default_rng(0).integers(0, 256, (len(scan), 3), dtype=np.uint8)
    write_scan(tmp_path / "c.las", scan, rgb)
    las = laspy.read(tmp_path / "c.las")
    assert las.header.point_format.id == 7
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], axis=1) >> 8, rgb)


@pytest.mark.parametrize("package", ["laspy", "lazrs", "rasterio"])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=rf"{package}.*featuredb\[lidar\]"):
        write_lidar(tmp_path / "w", WORLD)
    assert not (tmp_path / "w").exists()


def test_the_command_writes_scan_and_ortho(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parser = argparse.ArgumentParser()
    command.register(parser.add_subparsers())
    args = parser.parse_args(["simworld", str(tmp_path / "w"), "--lidar", "--workers", "1", "--seed", "3"])
    monkeypatch.setattr(WorldOptions, "short", classmethod(lambda cls, seed: replace(WORLD, seed=seed)))
    monkeypatch.setattr(
        scan_world,
        "write_lidar",
        lambda folder, world, note: write_lidar(
            folder, world, note, scan=replace(SCAN, density_per_m2=0.2), ortho=replace(ORTHO, pixel_m=2.0)
        ),
    )
    args.run(args)
    said = capsys.readouterr()
    for name in ("scan.laz", "ortho.tif", "other_town_scan.laz", "other_town_ortho.tif", "truth.json"):
        assert (tmp_path / "w" / name).stat().st_size > 0
        assert name in " ".join(said.out.split())
    with rasterio.open(tmp_path / "w" / "ortho.tif") as ortho:
        assert ortho.res == (2.0, 2.0)
