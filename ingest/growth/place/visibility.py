"""Step: what a placed photo must show, if it is where the placement has it, and how much of it it shows.

The other direction of localisation. A camera that looks through a wall, and a copy that was joined at a
look-alike, fit what they see and do not show the rest.
"""

from collections.abc import Sequence

import numpy as np

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.geometry.view_cones import in_view, view_cones
from featuredb.index.area import Area
from ingest.colmap.bridge import Model
from ingest.growth.place.correspondences import Correspondences
from ingest.growth.values import LEAST_VIEWS
from reloc.localise.acceptance import agreement
from reloc.localise.matching import EXPECTED_DEG, visible_points

# Least share of the parts that should show points of existing maps or of the photo's own reconstruction. A
# re-upload 13.3 m off showed 0.17; right photos of that database 0.32 and more, of the one that grew with
# this limit 0.23 and more.
LEAST_SHOWN = 0.25
_LEAST_POINTS = 30  # a photo that should see fewer says nothing


def shown_parts(
    model: Model, sim: Sim3, held: Correspondences, areas: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, FloatArray]:
    """For each photo the share of the image's parts that should show points where it does so.

    Args:
        sim: frame from the model's.
        held: pixels of the model's photos in which existing points are seen, where the placement has them.

    Returns:
        Shares (k,) of the points of existing maps, and (k,) of these and of the points of the model itself
        that several photos bear out; NaN for photos that should show hardly any. Photos that no map localised
        are asked as well.
    """
    often = model.track_lengths() >= LEAST_VIEWS
    cones = view_cones(model.xyz, model.centers(), model.point_of, model.photo_of)
    shares = np.full((2, len(model.rows)), np.nan)
    for k, pose in enumerate(model.cam_from_sfm):
        camera = model.cameras[int(model.camera_of[k])]
        expected, seen = [np.zeros((0, 2))], [held.pixels[held.photo_of == k]]
        for area in areas:
            in_area = sim.act_on_pose(pose) @ frame.enu_from(area.frame)
            rows = visible_points(area, area.searched_points(), camera, in_area)
            expected.append(camera.project(in_area.act(area.points[rows])))
        own = often & in_view(model.xyz, cones, camera, pose, EXPECTED_DEG)
        seen_own = model.point_of[(model.photo_of == k) & often[model.point_of]]
        for row in range(2):
            should = np.concatenate(expected)
            if len(should) >= _LEAST_POINTS:
                shares[row, k] = agreement(np.concatenate(seen), should, camera.width, camera.height)
            expected.append(camera.project(pose.act(model.xyz[own])))
            seen.append(camera.project(pose.act(model.xyz[seen_own])))
    return shares[0], shares[1]
