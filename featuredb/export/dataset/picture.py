"""The coverage picture: points, cameras and areas of the maps, north up, a panel for each place."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ExportError
from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.geometry.arrays import FloatArray

# Maps whose boxes are closer than this are one place and share a panel.
_SAME_PLACE_DEG = 0.02
_LARGEST_PANELS = 9  # the places with the most points; the datasheet says how many there are
_PANEL_PX, _MARGIN_PX, _FOOT_PX = 480, 16, 40
_M_PER_DEG = 111_320.0
# Blue, green, red, as OpenCV has them.
_INK, _AREA, _POINT, _CAMERA = (40, 40, 40), (235, 225, 205), (150, 110, 60), (40, 40, 210)


def write_picture(contents: Contents, path: Path) -> None:
    """Write the PNG.

    Raises:
        ExportError: it cannot be encoded.
    """
    places = places_of(contents)[:_LARGEST_PANELS]
    columns = int(np.ceil(np.sqrt(len(places))))
    rows = -(-len(places) // columns)
    side = _PANEL_PX + 2 * _MARGIN_PX
    picture = np.full((rows * (side + _FOOT_PX), columns * side, 3), 255, np.uint8)
    for number, place in enumerate(places):
        row, column = divmod(number, columns)
        top, left = row * (side + _FOOT_PX), column * side
        picture[top : top + side + _FOOT_PX, left : left + side] = _panel(place)
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise ExportError(f"cannot encode the coverage picture {path}")
    path.write_bytes(data.tobytes())


def places_of(contents: Contents) -> list[list[MapEntry]]:
    """The maps by place, those with the most points first."""
    places: list[tuple[FloatArray, list[MapEntry]]] = []
    for entry in contents.maps:
        box, group = _plain_box(entry), [entry]
        apart = []
        for other_box, other in places:
            if _near(box, other_box):
                box = np.concatenate([np.minimum(box[:2], other_box[:2]), np.maximum(box[2:], other_box[2:])])
                group = other + group
            else:
                apart.append((other_box, other))
        places = [*apart, (box, group)]
    groups = [group for _, group in places]
    return sorted(groups, key=lambda g: (-sum(int(e.row["points"]) for e in g), g[0].map_id))


def _plain_box(entry: MapEntry) -> FloatArray:
    """West, south, east, north with east beyond 180 across the antimeridian."""
    west, south, east, north = entry.footprint.bbox
    return np.array([west, south, east + 360.0 if east < west else east, north])


def _near(a: FloatArray, b: FloatArray) -> bool:
    return bool((a[:2] - _SAME_PLACE_DEG <= b[2:]).all() and (b[:2] - _SAME_PLACE_DEG <= a[2:]).all())


def _panel(place: list[MapEntry]) -> NDArray[np.uint8]:
    """One place in a square with its scale and what it is."""
    boxes = np.array([_plain_box(entry) for entry in place])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    middle = (low + high) / 2.0
    m_per_deg = np.array([_M_PER_DEG * np.cos(np.radians(middle[1])), _M_PER_DEG])
    pixel_m = max(float(((high - low) * m_per_deg).max()), 10.0) / _PANEL_PX
    side = _PANEL_PX + 2 * _MARGIN_PX

    def pixels(lon_lat: FloatArray) -> NDArray[np.int32]:
        turned = lon_lat - middle
        turned[:, 0] = (turned[:, 0] + 180.0) % 360.0 - 180.0
        plan = turned * m_per_deg / pixel_m * [1.0, -1.0] + side / 2.0
        rounded: NDArray[np.int32] = np.round(plan).astype(np.int32)
        return rounded

    image = np.full((side + _FOOT_PX, side, 3), 255, np.uint8)
    for entry in place:
        for ring in _rings(entry):
            cv2.fillPoly(image, [pixels(ring)], _AREA)
    for entry in place:
        for column, row in pixels(entry.points_lon_lat):
            cv2.circle(image, (int(column), int(row)), 1, _POINT, -1)
    for entry in place:
        for column, row in pixels(entry.cameras_lon_lat):
            cv2.circle(image, (int(column), int(row)), 2, _CAMERA, -1)
    _caption(image, place, middle, pixel_m)
    return image


def _rings(entry: MapEntry) -> list[FloatArray]:
    geometry = entry.footprint.geometry
    if geometry["type"] == "Point":
        return []
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    return [np.array(rings[0]) for rings in polygons]


def _caption(image: NDArray[np.uint8], place: list[MapEntry], middle: FloatArray, pixel_m: float) -> None:
    """A scale bar, and how much lies here."""
    longest = 0.3 * _PANEL_PX * pixel_m
    power = 10.0 ** np.floor(np.log10(longest))
    bar_m = power * max(f for f in (1, 2, 5) if f * power <= longest)
    y, end = _PANEL_PX + 2 * _MARGIN_PX, _MARGIN_PX + round(bar_m / pixel_m)
    cv2.rectangle(image, (_MARGIN_PX, y), (end, y + 4), _INK, -1)
    images, points = (sum(int(e.row[name]) for e in place) for name in ("images", "points"))
    longitude = (middle[0] + 180.0) % 360.0 - 180.0
    maps = "1 map" if len(place) == 1 else f"{len(place)} maps"
    text = f"{maps}, {images} images, {points:,} points at {middle[1]:.4f}, {longitude:.4f}"
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, f"{bar_m:g} m", (end + 8, y + 8), font, 0.42, _INK, 1, cv2.LINE_AA)
    cv2.putText(image, text, (_MARGIN_PX, y + 28), font, 0.42, _INK, 1, cv2.LINE_AA)
