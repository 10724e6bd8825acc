"""What is at a pixel: its ray against a surface, with the covariance of the place.

A place X on the surface is seen at the pixel that camera and pose give it. The pose's error, the lens' and
that of the pixel itself are one error of the pixel, and move the ray along the surface; the surface's own
error moves the place along the ray.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.error_radius import error_radius
from featuredb.plain_json import plain
from reloc.answered_view import AnsweredView
from reloc.pixels.surfaces import Met, RaySurface

LocateReason = Literal["NO_SURFACE", "GRAZING", "OUTSIDE"]

_REACH_SIGMAS = 2.45  # of two dimensions: holds 95 %
_LARGEST_ALONG = 0.1  # of the distance: one deviation along the ray beyond which nothing is linear
_GRAZING_DEG = 80.0  # off the normal: a degree of the surface moves the place by a tenth of its distance
_LEAST_SHARE = 0.25  # of the other surfaces: twice 1 / 7.8, which reaches the bound of 95 %
_RINGS, _SPOKES = (0.4, 0.8, 1.2, 1.6, 2.0, _REACH_SIGMAS), 12


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelPlace:
    """What a pixel shows."""

    pixel: tuple[float, float]  # (u, v) of the photo's stored pixels
    reason: LocateReason | None  # why there is no place; None where there is one
    detail: str  # one sentence for people: the reason, or what makes the place doubtful
    epsg: int  # UTM zone
    height_datum: str  # of the height
    surface: str  # "scan" or "map"
    at_edge: bool = False  # another surface lies within the pixel's error; the covariance covers both
    grazing: bool = False  # the surface is seen at more than 80 degrees off its normal
    utm: FloatArray | None = None  # (3,) easting, northing, height, metres
    lat_lon_h: FloatArray | None = None  # (3,) degrees, metres
    covariance: FloatArray | None = None  # (3, 3) true east, north, up there, square metres
    distance_m: float | None = None  # from the camera
    incidence_deg: float | None = None  # between the ray and the surface's normal
    roughness_m: float | None = None  # one standard deviation of the surface along its normal

    @property
    def horizontal_68_m(self) -> float | None:
        return None if self.covariance is None else error_radius(self.covariance[:2, :2])

    @property
    def vertical_68_m(self) -> float | None:
        return None if self.covariance is None else error_radius(self.covariance[2:, 2:])


def locate(
    view: AnsweredView,
    surface: RaySurface,
    pixels: Sequence[tuple[float, float]] | FloatArray,
    sigma_px: float = 0.0,
) -> list[PixelPlace]:
    """The place of each pixel, or why it has none.

    Args:
        pixels: (n, 2), the centre of the photo's top-left pixel being (0.5, 0.5).
        sigma_px: one standard deviation of each coordinate of the pixels themselves.
    """
    return [_place(view, surface, np.array(pixel, dtype=np.float64), sigma_px) for pixel in pixels]


def _place(view: AnsweredView, surface: RaySurface, pixel: FloatArray, sigma_px: float) -> PixelPlace:
    answered = partial(
        PixelPlace,
        pixel=(float(pixel[0]), float(pixel[1])),
        epsg=view.epsg,
        height_datum=view.height_datum,
        surface=surface.kind,
    )
    ray, size = view.rays(pixel[None])[0], (view.camera.width, view.camera.height)
    if not ((pixel >= 0).all() and (pixel <= size).all() and np.isfinite(ray).all()):
        return answered(reason="OUTSIDE", detail=f"the photo has {size[0]} x {size[1]} pixels")
    # By the pose's turn alone, which is right for far things; nearer ones are asked for again.
    viewer = view.cam_from_local.center
    spread = _pixel_covariance(view, viewer + 1e4 * ray, sigma_px)
    met = surface.meet(view, pixel, _REACH_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(spread)[-1])))
    if isinstance(met, str):
        return answered(reason="NO_SURFACE", detail=met)
    toward = float(met.patch.normal @ ray)
    if toward > -1e-6:
        return answered(reason="GRAZING", detail="the ray runs along the surface")
    point = viewer + ray * float(met.patch.normal @ (met.patch.point - viewer)) / toward
    spread = _pixel_covariance(view, point, sigma_px)
    along = ray * met.sigma_m / toward
    on_surface = _by_pixel(view, point, met.patch.normal)
    covariance = on_surface @ spread @ on_surface.T + np.outer(along, along)
    direction = ray / np.linalg.norm(ray)
    distance = float(np.linalg.norm(point - viewer))
    if float(np.sqrt(direction @ covariance @ direction)) > _LARGEST_ALONG * distance:
        detail = f"the place is known to no better than a tenth of its {distance:.0f} m"
        return answered(reason="GRAZING", detail=detail)
    other = _other_surfaces(view, met, pixel, point, spread)
    incidence = float(np.degrees(np.arccos(min(1.0, -float(met.patch.normal @ direction)))))
    to_true = view.frame.true_enu_from_enu(point)
    if other is not None:
        covariance = covariance + other
    return answered(
        reason=None,
        detail=_doubts(other is not None, incidence, surface.doubt),
        at_edge=other is not None,
        grazing=incidence > _GRAZING_DEG,
        utm=view.frame.utm_from_enu(point, view.epsg),
        lat_lon_h=view.frame.geodetic_from_enu(point),
        covariance=np.asarray(to_true @ covariance @ to_true.T),
        distance_m=distance,
        incidence_deg=incidence,
        roughness_m=met.sigma_m,
    )


def _pixel_covariance(view: AnsweredView, point: FloatArray, sigma_px: float) -> FloatArray:
    """(2, 2): how far the pixel of a place may be off."""
    _, by_view = view.pixel_derivatives(point)
    # A floor far below what anybody sees keeps it regular.
    return np.asarray(by_view @ view.covariance @ by_view.T + (sigma_px**2 + 1e-6) * np.eye(2))


def _by_pixel(view: AnsweredView, point: FloatArray, normal: FloatArray) -> FloatArray:
    """(3, 2): how a place moves on its plane with its pixel."""
    by_point, _ = view.pixel_derivatives(point)
    _, _, axes = np.linalg.svd(normal[None])
    plane = axes[1:].T
    return np.asarray(plane @ np.linalg.inv(by_point @ plane))


def _other_surfaces(
    view: AnsweredView, met: Met, pixel: FloatArray, point: FloatArray, spread: FloatArray
) -> FloatArray | None:
    """(3, 3): what places beyond an edge add to the covariance; None where all around is one surface.

    The second moment of what the ray meets over the pixel's error, to which the scan's own adds: it knows
    its edges to half the distance between its points. Enough of it that the other surface lies within the
    bound of 95 %, too, however little of the error is beyond the edge.
    """
    depth = float(view.cam_from_local.act(point)[2])
    edge_px = 0.5 * met.spacing_m * view.camera.focal_px / depth
    root = np.linalg.cholesky(spread + (edge_px / _REACH_SIGMAS) ** 2 * np.eye(2))
    turns = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
    spokes = np.column_stack([np.cos(turns), np.sin(turns)])
    offsets = np.concatenate([ring * spokes for ring in _RINGS])
    weight = np.repeat([ring * np.exp(-0.5 * ring**2) for ring in _RINGS], _SPOKES)
    weight /= weight.sum()
    pixels = pixel + offsets @ root.T
    depths = met.around(pixels)
    rays = view.rays(pixels)
    with np.errstate(invalid="ignore"):
        toward = rays @ met.patch.normal
        on_plane = (
            rays * (met.patch.normal @ (met.patch.point - view.cam_from_local.center) / toward)[:, None]
        )
        places = rays * depths[:, None]
        off = np.abs((places - on_plane) @ met.patch.normal)
        limit = np.maximum(4.0 * met.patch.scatter_m, met.tolerance_m)
        beyond = (off > limit) & np.isfinite(off)
    if not beyond.any():
        return None
    away = (places - on_plane)[beyond]
    share = weight[beyond] * max(1.0, _LEAST_SHARE / weight[beyond].sum())
    return np.asarray((away * share[:, None]).T @ away)


def _doubts(at_edge: bool, incidence_deg: float, of_surface: str) -> str:
    doubts = [of_surface] if of_surface else []
    doubts += ["another surface lies within the pixel's error"] if at_edge else []
    if incidence_deg > _GRAZING_DEG:
        doubts.append(f"the surface is seen at {incidence_deg:.0f} degrees off its normal")
    return "; ".join(doubts)


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
