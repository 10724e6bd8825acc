"""Boxes of detectors: COCO's JSON in, GeoJSON out."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.plain_json import plain
from reloc.pixels.locate import PixelPlace

Foot = Literal["bottom", "centre"]
_TOLD = (
    *("pixel", "reason", "detail", "surface", "epsg", "utm", "height_datum", "covariance"),
    *("horizontal_68_m", "vertical_68_m", "at_edge", "grazing"),
    *("distance_m", "incidence_deg", "roughness_m"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class MarkedPixel:
    """A pixel to locate and what is said of it: `pixel` (u, v), `properties` for GeoJSON."""

    pixel: tuple[float, float]
    properties: dict[str, Any] = field(default_factory=dict)


def read_coco(path: Path, image: str, foot: Foot, size: tuple[int, int]) -> tuple[list[MarkedPixel], bool]:
    """The foot point of each box of a photo.

    Args:
        path: COCO's annotations (an object with `images` and `annotations`) or results (a list of boxes).
        image: the photo's file name, by which its annotations are found. Results are those whose `image_id`
            is the name, with or without suffix; where all have one number, they are the photo's.
        foot: bottom: the middle of a box's lower side, where what stands upright in the picture meets the
            ground; centre: of the box, for photos straight down.
        size: width and height of the photo's stored picture.

    Returns:
        The foot points, and whether the file says that its boxes are of a picture of this size.

    Raises:
        InvalidValueError: the file cannot be read or is neither, has no box of the photo, or says that the
            picture has another size.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        whole = document if isinstance(document, dict) else {}
        images = [i for i in whole.get("images", []) if Path(i["file_name"]).name == Path(image).name]
        names = {c["id"]: c["name"] for c in whole.get("categories", [])}
        marks = [_mark(box, foot, names) for box in _boxes_of(document, Path(image), images)]
        told = {(int(i["width"]), int(i["height"])) for i in images if i.get("width") and i.get("height")}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InvalidValueError(
            f"{path}: expected boxes in COCO's JSON (annotations, or a list of results), found {error!r}"
        ) from error
    if not marks:
        raise InvalidValueError(f"{path}: expected boxes of {Path(image).name}, found none")
    for width, height in told - {size}:
        raise InvalidValueError(
            f"{path}: expected boxes of a picture of {size[0]}x{size[1]} pixels, as {Path(image).name} is "
            f"stored, found those of {width}x{height}; a reduced or turned picture has other pixels"
        )
    return marks, bool(told)


def geojson(places: Sequence[PixelPlace], marks: Sequence[MarkedPixel], photo: str) -> dict[str, Any]:
    """A FeatureCollection of points, longitude and latitude of WGS84 and height in the answer's datum.

    A pixel without a place has no geometry, and its reason among its properties.
    """
    features = []
    for place, mark in zip(places, marks, strict=True):
        geometry = None
        if place.lat_lon_h is not None:
            latitude, longitude, height = place.lat_lon_h.tolist()
            geometry = {
                "type": "Point",
                "coordinates": [round(longitude, 9), round(latitude, 9), round(height, 4)],
            }
        properties = {**mark.properties, **as_json(place)}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "photo": photo, "features": features}


def as_json(place: PixelPlace) -> dict[str, Any]:
    """All of a place but its geodetic coordinates, as JSON has it."""
    told = {name: getattr(place, name) for name in _TOLD}
    utm = None if place.utm is None else np.round(place.utm, 4)
    return {name: plain(value) for name, value in (told | {"utm": utm}).items()}


def _boxes_of(document: Any, image: Path, images: list[dict[str, Any]]) -> list[dict[str, Any]]:
    if isinstance(document, dict):
        ids = {i["id"] for i in images}
        return [a for a in document["annotations"] if a["image_id"] in ids]
    named = [box for box in document if str(box["image_id"]) in (image.name, image.stem)]
    numbers = {box["image_id"] if isinstance(box["image_id"], int) else None for box in document}
    return named or (list(document) if len(numbers) == 1 and None not in numbers else [])


def _mark(box: dict[str, Any], foot: Foot, names: dict[Any, str]) -> MarkedPixel:
    x, y, width, height = (float(v) for v in box["bbox"])
    category = box.get("category_id")
    said: dict[str, Any] = {key: box[key] for key in ("id", "category_id", "score") if key in box}
    if category in names:
        said["category"] = names[category]
    down = height if foot == "bottom" else 0.5 * height
    return MarkedPixel(pixel=(x + 0.5 * width, y + down), properties={**said, "bbox": [x, y, width, height]})
