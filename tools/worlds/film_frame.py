"""One frame of a film of a scene: cars drive, water glitters, and the camera moves while it is exposed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import SensorOptions, expose, moving_cars, scene_look
from featuredb.simworld.camera.raster import render
from featuredb.simworld.town.scene import Faces, Scene
from featuredb.simworld.town.texture import Image8
from featuredb.simworld.world import in_order
from featuredb.video.writer import VideoWriter, VideoWriterOptions

_GLITTER_HZ = 5.0  # how often the water looks new
_SHUTTER_S = 1 / 100
_SENSOR = SensorOptions(exposure_sigma_ev=0.0, white_balance_sigma=0.0)
_BANDS = 12  # of rows, where they are not exposed at once
_CHUNK = 4  # frames that travel to a process at a time


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """How a frame is exposed.

    Attributes:
        samples: pictures of its time, in which what moves is blurred, that are averaged; each looks through
            other parts of the pixels.
        readout_s: rolling shutter, from the first row to the last; the frame's time is its middle row's.
        ev: stops brighter than the scene is.
    """

    samples: int = 4
    readout_s: float = 0.0
    ev: float = 0.0


def draw_frame(
    scene: Scene,
    camera: Camera,
    pose_at: Callable[[float], Rigid3],
    time_s: float,
    exposure: Exposure,
    seeds: tuple[int, int],
) -> Image8:
    """A frame (h, w, 3) uint8 RGB as the camera's sensor gives it.

    Args:
        pose_at: cam_from_local at a time, seconds. time_s: of the frame's middle.
        seeds: of the cars, which is the film's, and the frame's number, which its noise depends on.
    """
    look = scene_look(scene, water_seed=int(time_s * _GLITTER_HZ))
    faces = Faces.concatenate([scene.faces, moving_cars(scene, seeds[0], time_s=time_s)])
    light: NDArray[np.float32] = np.zeros((camera.height, camera.width, 3), np.float32)
    n = exposure.samples
    for k in range(n):
        moment_s = time_s + _SHUTTER_S * ((k + 0.5) / n - 0.5)
        shifted = _shifted(camera, k, n)
        for top, bottom, later_s in _bands(camera.height, exposure.readout_s):
            part = _rows(shifted, top, bottom)
            pose = pose_at(moment_s + later_s)
            rendered = render(faces, scene.ellipsoids, part, pose, look=look, supersample=1)
            assert rendered.rgb is not None
            light[top:bottom] += rendered.rgb
    light *= 2.0**exposure.ev / n
    rng = np.random.default_rng((seeds[0], 72, seeds[1]))
    return expose(np.clip(light, 0, 255).astype(np.uint8), rng, _SENSOR)


def write_frames(
    file: Path,
    draw: Callable[[int], Image8],
    count: int,
    rate_hz: float,
    options: VideoWriterOptions,
    mark: Path,
    stamp: str,
    workers: int = 0,
) -> None:
    """A film of the pictures `draw(i)`; it is left as it is where the file `mark` has the stamp."""
    if mark.is_file() and mark.read_text(encoding="utf-8") == stamp:
        return
    mark.unlink(missing_ok=True)
    pictures = in_order(draw, count, workers, _CHUNK)
    first = next(pictures)
    height, width = first.shape[:2]
    with VideoWriter(file, width=width, height=height, fps=rate_hz, options=options) as writer:
        for picture in chain([first], pictures):
            writer.write(picture)
    mark.write_text(stamp, encoding="utf-8")


def _shifted(camera: Camera, k: int, n: int) -> Camera:
    """The camera whose rays go through another part of each pixel: a rank-1 lattice over its square."""
    shift = np.array([(k + 0.5) / n, ((k * 0.618034) + 0.5 / n) % 1.0]) - 0.5
    f, cx, cy, *rest = camera.params
    return replace(camera, params=(f, cx - float(shift[0]), cy - float(shift[1]), *rest))


def _bands(height: int, readout_s: float) -> list[tuple[int, int, float]]:
    """Rows (first, last + 1) that are exposed together, and how much later than the frame's middle."""
    if readout_s == 0:
        return [(0, height, 0.0)]
    edges = np.linspace(0, height, _BANDS + 1).round().astype(int).tolist()
    return [
        (top, bottom, readout_s * (0.5 * (top + bottom) / height - 0.5)) for top, bottom in pairwise(edges)
    ]


def _rows(camera: Camera, top: int, bottom: int) -> Camera:
    """The camera of some rows of the picture."""
    f, cx, cy, *rest = camera.params
    return replace(camera, height=bottom - top, params=(f, cx, cy - top, *rest))
