"""A server that follows films of a flat field live: a map with exact truth, and no database."""

import time
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from featuredb.features.extractor import ExtractorOptions
from featuredb.geometry.rigid3 import Rigid3
from featuredb.index.area import build_area
from reloc.localise.candidates import IndexedArea, indexed_together
from reloc.wire.query import CameraRequest
from tests.support.planar_map import CAMERA, field_texture, planar_map, render, view
from tests.support.service import ScriptedLocaliser

LENS = CameraRequest(model=CAMERA.model, width=CAMERA.width, height=CAMERA.height, params=CAMERA.params)
SOON_S = 30.0  # the longest wait for anything, on a busy machine
FIELD = 1  # the texture that the map knows


def pose_at(frame: int) -> Rigid3:
    """A quarter of a metre and half a degree a frame, forth and back over two seconds."""
    k = abs((frame + 30) % 60 - 30)
    return view(-4.0 + 0.25 * k, -3.0 + 0.1 * k, 45.0, tilt_deg=8.0, heading_deg=10.0 + 0.5 * k)


@cache
def field_area() -> IndexedArea:
    """The field's map, indexed."""
    area = build_area([planar_map(FIELD, fingerprint=ExtractorOptions().fingerprint)])
    return indexed_together([area])[0]


@cache
def frame(number: int, texture: int = FIELD) -> np.ndarray:
    """Frame (480, 640) uint8 of the flight over a field; they repeat after 60."""
    return render(_texture(texture), pose_at(number), seed=number)


@cache
def jpeg(number: int, texture: int = FIELD) -> bytes:
    """The frame's bytes as a client sends them."""
    _, data = cv2.imencode(".jpg", frame(number % 60, texture), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return bytes(data)


def localiser(snapshot: int = 1, *areas: IndexedArea) -> ScriptedLocaliser:
    """What a server answers from: the field's map where no areas are given."""
    found = ScriptedLocaliser(snapshot)
    found.areas = areas or (field_area(),)
    return found


def error_m(utm: tuple[float, float, float], number: int) -> float:
    """How far a position is from the truth of a frame."""
    area = field_area().area
    true = area.frame.utm_from_enu(pose_at(number).center, area.maps[0].epsg)
    return float(np.linalg.norm(np.array(utm) - true))


def wait_until(true: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + SOON_S
    while not true():
        assert time.monotonic() < end, f"{what}: not within {SOON_S:g} s"
        time.sleep(0.01)


@cache
def _texture(seed: int) -> np.ndarray:
    return field_texture(seed)
