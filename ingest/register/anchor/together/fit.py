"""One similarity of a map from where the pieces of all its photos lie on the scan.

As one photo's pose is fitted to its pieces (`ingest.register.frame.dense.fit`), round by round: renders are
made at the poses that the similarity gives, each piece takes its best place near by, and the similarity is
fitted to all of them with a robust loss, and held near its start where they tell little.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import MapImage
from featuredb.render.cloud import PointCloud
from ingest.register.frame.dense.fit import MAX_SIDE_PX, near_places
from ingest.register.frame.options import FrameOptions
from ingest.register.frame.views import FrameViews, first_look
from ingest.register.frame_registration import FramePrior, RenderSource

# Spacing of the scan's points and side of a piece, pixels of the render; how near a place is looked for.
_ROUNDS = ((2.4, 28, 12), (2.4, 28, 10), (3.75, 40, 6), (3.75, 40, 6), (3.75, 40, 6))
_LOSS_PX = 2.0  # Cauchy's; a piece is off by a pixel or two where laser and photo show an edge differently
_LEAST_PIECES = 14  # twice what seven parameters need
# Of the start, which the picture from above and the surface give: logarithm of the size, radians, metres.
_SIGMAS = np.array([0.02, *[np.radians(2.0)] * 3, *[1.5] * 3])
_FAR_PX = 50.0  # of a point behind the camera
_OFF_M, _OFF_DEG = 1.0, 1.0  # of a start, for the first look, which counts points only


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Seen:
    """A photo's pieces: pixels (n, 2) of the full photo and points (n, 3) of the scan; pixels of the render
    for one of the photo."""

    camera: Camera
    cam_from_old: Rigid3
    pixels: FloatArray
    points: FloatArray
    shrunk: float


def views_at(gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, cloud: PointCloud) -> FrameViews | None:
    """A photo and the scan seen from a pose; None where it shows none."""
    look = first_look(cloud, camera, FramePrior.around(pose, _OFF_M, _OFF_DEG))
    return None if look is None else FrameViews(gray, camera, cloud, look, FrameOptions(threads=1))


def fitted_together(
    start: Sim3,
    images: Sequence[MapImage],
    cameras: Sequence[Camera],
    grays: Mapping[int, NDArray[np.uint8]],
    cloud: PointCloud,
    source: RenderSource,
) -> Sim3 | None:
    """The similarity of the map's frame under which the pieces of all photos fit best; None with too few.

    Args:
        start: within the deviations above. grays: (h, w) of each image, by id.
    """
    new_from_old = start
    for spacing_px, piece_px, near_px in _ROUNDS:
        seen = []
        for image in images:
            camera = cameras[image.camera_id]
            pose = new_from_old.act_on_pose(image.cam_from_local)
            views = views_at(grays[image.image_id], camera, pose, cloud)
            if views is None:
                continue
            side_px = views.side_px(spacing_px, MAX_SIDE_PX)
            for rendering in views.renders([pose], side_px):
                found = near_places(views.gray, camera, rendering, source, piece_px, near_px)
                seen.append(
                    _Seen(
                        camera=camera,
                        cam_from_old=image.cam_from_local,
                        pixels=found.pixels,
                        points=found.points,
                        shrunk=side_px / max(camera.width, camera.height),
                    )
                )
        if sum(len(one.points) for one in seen) < _LEAST_PIECES:
            return None
        new_from_old = _moved(new_from_old, start, seen)
    return new_from_old


def _moved(new_from_old: Sim3, start: Sim3, seen: Sequence[_Seen]) -> Sim3:
    """The similarity fitted to the pieces' places, from one near it."""
    middle = np.median(np.vstack([one.points for one in seen]), axis=0)
    about = Sim3(scale=1.0, rotation=np.eye(3), translation=middle)

    def at(step: FloatArray) -> Sim3:
        return about @ Sim3.exp(step * _SIGMAS) @ about.inverse() @ new_from_old

    def off(step: FloatArray) -> FloatArray:
        similarity = at(step)
        parts = [
            one.shrunk
            * (one.camera.project(similarity.act_on_pose(one.cam_from_old).act(one.points)) - one.pixels)
            for one in seen
        ]
        pixels = np.nan_to_num(np.vstack(parts), nan=_FAR_PX).ravel() / _LOSS_PX
        moved = (about.inverse() @ similarity @ start.inverse() @ about).log() / _SIGMAS
        return np.concatenate([pixels, moved])

    return at(np.asarray(least_squares(off, np.zeros(7), loss="cauchy").x))
