"""Step: what a placed photo must show, if it is where the placement has it, and how much of it it shows.

The other direction of localisation. A camera that looks through a wall, and a copy that was joined at a
look-alike, fit what they see and do not show the rest.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.view_cones import in_view, view_cones
from featuredb.index.area import Area
from ingest.colmap.bridge import Model
from ingest.growth.place.correspondences import Correspondences
from reloc.localise.acceptance import agreement
from reloc.localise.matching import EXPECTED_DEG, visible_points

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityOptions:
    """What a photo must show.

    Attributes:
        min_visible: least share of the parts of a photo where existing points should be seen that shows some:
            as for a query (reloc.localise.acceptance). In a simulated community a re-upload 10.8 m off showed
            0.13 of its parts, right photos 0.22 and more.
        min_shown: the same where the points of its own reconstruction are asked for as well. Another
            re-upload, 13.3 m off, showed 0.17; right photos of that database 0.32 and more, of the one that
            grew with this limit 0.23 and more.
        min_points: a photo that should see fewer says nothing.
        min_views: photos that see a point of the reconstruction before it may be asked for. What two
            photos alone see says where the one is from the other, not what is there.
    """

    min_visible: float = 0.2
    min_shown: float = 0.25
    min_points: int = 30
    min_views: int = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownParts:
    """For each photo the share of the image's parts that should show points where it does so.

    NaN for photos that should show hardly any. Photos that no map localised are asked as well.

    Attributes:
        existing: (k,) of the points of existing maps.
        with_own: (k,) of these and of the points of the model itself that several photos bear out.
    """

    existing: FloatArray
    with_own: FloatArray


def shown_parts(
    model: Model,
    sim: Sim3,
    held: Correspondences,
    areas: Sequence[Area],
    frame: LocalFrame,
    options: VisibilityOptions,
) -> ShownParts:
    """What the photos of a placed model show of what they should.

    Args:
        sim: frame from the model's.
        held: pixels of the model's photos in which existing points are seen, where the placement has them.
    """
    often = model.track_lengths() >= options.min_views
    cones = view_cones(model.xyz, model.centers(), model.point_of, model.photo_of)
    existing, with_own = np.full(len(model.rows), np.nan), np.full(len(model.rows), np.nan)
    for k, pose in enumerate(model.cam_from_sfm):
        camera = model.cameras[int(model.camera_of[k])]
        expected, seen = _existing(model, k, sim, areas, frame), held.pixels[held.photo_of == k]
        existing[k] = _share(camera, seen, expected, options)
        own = often & in_view(model.xyz, cones, camera, pose, EXPECTED_DEG)
        seen_own = model.point_of[(model.photo_of == k) & often[model.point_of]]
        with_own[k] = _share(
            camera,
            np.concatenate([seen, camera.project(pose.act(model.xyz[seen_own]))]),
            np.concatenate([expected, camera.project(pose.act(model.xyz[own]))]),
            options,
        )
    logger.debug("shares of what should be seen: %s", np.round(with_own, 2).tolist())
    return ShownParts(existing=existing, with_own=with_own)


def _existing(model: Model, k: int, sim: Sim3, areas: Sequence[Area], frame: LocalFrame) -> FloatArray:
    """Pixels (n, 2) of the existing points that the k-th photo should show."""
    camera = model.cameras[int(model.camera_of[k])]
    pose = sim.act_on_pose(model.cam_from_sfm[k])
    pixels = [np.zeros((0, 2))]
    for area in areas:
        in_area = pose @ frame.enu_from(area.frame)
        rows = visible_points(area, area.searched_points(), camera, in_area)
        pixels.append(camera.project(in_area.act(area.points[rows])))
    return np.concatenate(pixels)


def _share(camera: Camera, seen: FloatArray, expected: FloatArray, options: VisibilityOptions) -> float:
    if len(expected) < options.min_points:
        return float("nan")
    return agreement(seen, expected, camera.width, camera.height)
