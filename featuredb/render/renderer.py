"""Draws a point cloud as a camera with distortion sees it."""

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.compiled import compiled_module
from featuredb.render.culling import visible_nodes
from featuredb.render.rendering import Rendering
from featuredb.render.splats import SplatOptions, Splats, draw_splats
from featuredb.render.surfaces import SurfaceOptions, Surfaces, apart_px, block_planes, surfaces_of
from featuredb.render.threads import over_rows, thread_count

# Splats wider than this show which way they lie; then there are few, and drawing them again is cheap.
_WORTH_REDRAWING_PX = 2.5


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderOptions:
    """How a cloud is drawn. For a cheaper picture ask for fewer pixels: `camera.scaled_to`.

    Attributes:
        attributes: colour and intensity too; False draws depth and index only.
        threads: 0 takes as many as the process may use, up to four.
    """

    attributes: bool = True
    threads: int = 0
    splats: SplatOptions = field(default_factory=SplatOptions)
    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)


@dataclass(slots=True, kw_only=True)
class RenderClock:
    """Where the time of one picture went: `seconds` by stage, in order."""

    seconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Book the time since the last lap."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def render(
    cloud: PointCloud,
    camera: Camera,
    cam_from_local: Rigid3,
    options: RenderOptions | None = None,
    clock: RenderClock | None = None,
) -> Rendering:
    """What the camera sees of the cloud, in colour, intensity, depth and by index.

    The same picture whatever the number of threads; safe to call from several threads at once.

    Args:
        clock: is told how long each stage took.

    Raises:
        MissingExtraError: numba is not installed.
    """
    options, clock = options or RenderOptions(), clock or RenderClock()
    threads = thread_count(options.threads)
    near_m, finest_px = options.splats.near_m, options.splats.finest_px
    rows = visible_nodes(cloud.nodes, camera, cam_from_local, near_m=near_m, finest_px=finest_px)
    clock.lap("cull")
    splats = draw_splats(cloud, rows, camera, cam_from_local, options.splats, threads)
    clock.lap("draw")
    planes = None
    if options.surfaces.tilt_splats:
        planes = block_planes(cloud.xyz, splats, camera, cam_from_local, threads)
        clock.lap("planes")
        if planes is not None and np.quantile(apart_px(splats, camera.focal_px), 0.95) > _WORTH_REDRAWING_PX:
            splats = draw_splats(cloud, rows, camera, cam_from_local, options.splats, threads, planes)
            clock.lap("draw again")
    surfaces = surfaces_of(cloud.xyz, splats, planes, camera, cam_from_local, options.surfaces, threads)
    clock.lap("close holes")
    rgb = intensity = None
    if options.attributes and cloud.rgb is not None:
        rgb = _painted(cloud.rgb, splats, surfaces, threads)
    if options.attributes and cloud.intensity is not None:
        intensity = _painted(cloud.intensity[:, None], splats, surfaces, threads)[..., 0]
    depth = _finished(splats, surfaces, threads)
    clock.lap("paint")
    return Rendering(
        camera=camera,
        cam_from_local=cam_from_local,
        depth=depth,
        index=splats.index,
        rgb=rgb,
        intensity=intensity,
        points_drawn=splats.points_drawn,
    )


def _painted(
    values: NDArray[np.uint8], splats: Splats, surfaces: Surfaces, threads: int
) -> NDArray[np.uint8]:
    """Picture (h, w, c) of values (n, c)."""
    loops = compiled_module("featuredb.render.picture_loops")
    picture = np.empty((*splats.index.shape, values.shape[1]), np.uint8)
    s = surfaces
    over_rows(
        lambda first, end: loops.paint(
            values, splats.index, s.nearness, s.filled, splats.apart_m, s.source, picture, first, end
        ),
        len(picture),
        threads,
    )
    return picture


def _finished(splats: Splats, surfaces: Surfaces, threads: int) -> NDArray[np.float32]:
    """Depth (h, w); marks closed holes in the index."""
    loops = compiled_module("featuredb.render.picture_loops")
    depth = np.empty(splats.index.shape, np.float32)
    over_rows(
        lambda first, end: loops.finish(surfaces.filled, surfaces.source, splats.index, depth, first, end),
        len(depth),
        threads,
    )
    return depth
