"""GIS layers over photos: where they are drawn, what the scan hides, heights and reference systems."""

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from reloc.pixels.layer import Shape, draw_layer, laid_on, read_layer
from tests.support.scanned_map import EPSG, FRAME
from tests.unit.test_locate_pixels import LENS, POSE, step, true_place, view_of

CLOUD = step()


def layer_file(folder: Path, geometry: dict[str, object], **more: object) -> Path:
    feature = {"type": "Feature", "properties": {"name": "here"}, "geometry": geometry}
    path = folder / "layer.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature], **more}))
    return path


def lon_lat(points: FloatArray) -> list[list[float]]:
    return [[float(lon), float(lat)] for lat, lon, _ in FRAME.geodetic_from_enu(points)]


def drawn(shapes: list, cloud: object = CLOUD) -> FloatArray:
    """Pixels (n, 2), x and y, that the layer has changed in a black photo."""
    black = np.zeros((LENS.height, LENS.width, 3), np.uint8)
    picture = draw_layer(black, view_of(POSE), shapes, cloud)  # type: ignore[arg-type]
    rows, columns = np.nonzero(picture.max(axis=2) > 100)
    return np.column_stack([columns, rows]) + 0.5


def test_a_line_without_heights_lies_on_the_scan_and_shows_where_the_camera_sees_it(tmp_path: Path) -> None:
    ends = np.array([[-12.0, -4.0, 0.0], [0.0, 2.0, 0.0]])
    shapes = laid_on(
        read_layer(layer_file(tmp_path, {"type": "LineString", "coordinates": lon_lat(ends)})), FRAME, CLOUD
    )
    assert np.abs(shapes[0].points[:, 2]).max() < 0.1
    expected = LENS.project(POSE.act(np.linspace(*ends, 200)))
    found = drawn(shapes)
    apart = np.linalg.norm(found[:, None] - expected, axis=2)
    assert apart.min(axis=1).max() < 2.0
    assert apart.min(axis=0).max() < 2.0  # from end to end


def test_marks_and_lines_lie_on_their_pixels_by_a_fraction_of_one() -> None:
    """The centre of the top-left pixel is (0.5, 0.5); OpenCV draws as if it were (0, 0)."""
    black = np.zeros((LENS.height, LENS.width, 3), np.uint8)
    pixels = np.random.default_rng(2).uniform([50.0, 50.0], [750.0, 550.0], (30, 2))
    places = np.array([true_place(view_of(POSE), pixel, 0.0) for pixel in pixels])
    columns, rows = np.meshgrid(*(np.arange(n) + 0.5 for n in (LENS.width, LENS.height)))
    centres = []
    for place in places:
        bright = draw_layer(black, view_of(POSE), [Shape(points=place[None], name="")], None).max(axis=2)
        centres.append([np.average(columns, weights=bright), np.average(rows, weights=bright)])
    assert np.abs(np.array(centres) - pixels).max() < 0.1
    ends = np.array([[-15.0, 1.3, 0.0], [-2.0, 1.3, 0.0]])  # level in the picture
    bright = draw_layer(black, view_of(POSE), [Shape(points=ends, name="")], None).max(axis=2)
    here = bright.max(axis=0) > 0
    along = LENS.project(POSE.act(np.linspace(*ends, 2000)))
    expected = np.interp(columns[0, here], along[:, 0], along[:, 1])
    found = (bright * rows).sum(axis=0)[here] / bright.sum(axis=0)[here]
    assert abs(np.median(found - expected)) < 0.1


def test_what_stands_before_a_line_hides_it(tmp_path: Path) -> None:
    under = np.array([[9.0, -2.0], [9.0, 6.0]])  # beneath the slab
    coordinates = [
        [*place, h] for place, h in zip(lon_lat(np.column_stack([under, [0, 0]])), [520.0] * 2, strict=True)
    ]
    layer = read_layer(layer_file(tmp_path, {"type": "LineString", "coordinates": coordinates}))
    shapes = laid_on(layer, FRAME, CLOUD)
    assert abs(shapes[0].points[:, 2]).max() < 0.01  # its own heights, not the slab's
    assert len(drawn(shapes)) == 0
    assert len(drawn(shapes, None)) > 50


def test_only_what_has_no_height_is_laid_on_the_scan(tmp_path: Path) -> None:
    """Two vertices ten metres up, joined by a straight line, and one without a height."""
    places = lon_lat(np.array([[-20.0, 0.0, 0.0], [-12.0, 0.0, 0.0], [-4.0, 0.0, 0.0]]))
    up = FRAME.height_m + 10.0
    coordinates = [[*places[0], up], [*places[1], up], places[2]]
    layer = read_layer(layer_file(tmp_path, {"type": "LineString", "coordinates": coordinates}))
    (shape,) = laid_on(layer, FRAME, CLOUD)
    in_air = shape.points[:, 0] < -12.0 + 1e-3
    assert 10 < in_air.sum() < len(in_air) - 10
    np.testing.assert_allclose(shape.points[in_air, 2], 10.0, atol=1e-3)
    np.testing.assert_allclose(shape.points[~in_air, 2], 0.0, atol=0.1)


def test_a_file_may_name_its_reference_system(tmp_path: Path) -> None:
    place = np.array([-6.0, 1.5, 0.0])
    lat, lon, _ = FRAME.geodetic_from_enu(place)
    easting, northing = pyproj.Transformer.from_crs(4326, 25832, always_xy=True).transform(lon, lat)
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    file = layer_file(tmp_path, {"type": "Point", "coordinates": [easting, northing]}, crs=crs)
    (shape,) = laid_on(read_layer(file), FRAME, CLOUD)
    assert len(shape.points) == 1
    assert shape.name == "here"
    np.testing.assert_allclose(shape.points[0, :2], place[:2], atol=1e-3)
    assert EPSG == 32632


def test_layers_that_cannot_be_drawn_are_refused(tmp_path: Path) -> None:
    flat = read_layer(layer_file(tmp_path, {"type": "Point", "coordinates": [11.5, 48.1]}))
    with pytest.raises(InvalidValueError, match="expected heights, or a scan"):
        laid_on(flat, FRAME, None)
    with pytest.raises(InvalidValueError, match="Blob"):
        read_layer(layer_file(tmp_path, {"type": "Blob", "coordinates": [11.5, 48.1]}))
