"""The coverage picture: points, cameras and areas of the maps, north up, a panel for each place."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from featuredb.export.dataset.contents import Contents, MapEntry
from featuredb.geometry.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Maps whose boxes are closer than this are one place and share a panel.
_SAME_PLACE_DEG = 0.02
_LARGEST_PANELS = 9  # the places with the most points; the datasheet says how many there are
_PANEL_INCHES = 5.0
_AREA, _POINT, _CAMERA = "#cde1eb", "#3c6e96", "#d22828"


def write_picture(contents: Contents, path: Path) -> None:
    """Write the PNG; axes are longitude and latitude in degrees."""
    from matplotlib.figure import Figure  # takes a second to load

    places = places_of(contents)[:_LARGEST_PANELS]
    columns = int(np.ceil(np.sqrt(len(places))))
    rows = -(-len(places) // columns)
    figure = Figure(figsize=(_PANEL_INCHES * columns, _PANEL_INCHES * rows), layout="constrained")
    for number, place in enumerate(places, start=1):
        _draw(figure.add_subplot(rows, columns, number), place)
    figure.savefig(path, format="png", metadata={"Software": None})


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


def _draw(axes: "Axes", place: list[MapEntry]) -> None:
    """One place, and how much lies there."""
    boxes = np.array([_plain_box(entry) for entry in place])
    middle = (boxes[:, :2].min(axis=0) + boxes[:, 2:].max(axis=0)) / 2.0

    def plain(lon_lat: FloatArray) -> FloatArray:
        """Across the antimeridian without a leap."""
        east = (lon_lat[:, 0] - middle[0] + 180.0) % 360.0 - 180.0
        return np.stack([middle[0] + east, lon_lat[:, 1]])

    for entry in place:
        for ring in _rings(entry):
            axes.fill(*plain(ring), color=_AREA)
    for entry in place:
        east, north = plain(entry.points_lon_lat)
        axes.scatter(east, north, s=1.0, color=_POINT, linewidths=0)
    for entry in place:
        east, north = plain(entry.cameras_lon_lat)
        axes.scatter(east, north, s=8.0, color=_CAMERA, linewidths=0)
    axes.set_aspect(1.0 / np.cos(np.radians(middle[1])), adjustable="datalim")
    axes.ticklabel_format(useOffset=False)
    axes.tick_params(labelsize=6)
    images, points = (sum(int(e.row[name]) for e in place) for name in ("images", "points"))
    maps = "1 map" if len(place) == 1 else f"{len(place)} maps"
    axes.set_title(f"{maps}, {images} images, {points:,} points", fontsize=9)


def _rings(entry: MapEntry) -> list[FloatArray]:
    geometry = entry.footprint.geometry
    if geometry["type"] == "Point":
        return []
    polygons = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    return [np.array(rings[0]) for rings in polygons]
