"""Clouds out of arrays, in levels of detail as the store has them."""

import numpy as np
from numpy.typing import ArrayLike

from featuredb.geo.local_frame import LocalFrame
from featuredb.lidar.clean import finest_level, order_by_level
from featuredb.render.cloud import UNCLASSIFIED, CloudNodes, PointCloud, point_spacing


def build_cloud(
    frame: LocalFrame,
    height_datum: str,
    xyz: ArrayLike,
    rgb: ArrayLike | None = None,
    intensity: ArrayLike | None = None,
) -> PointCloud:
    """The points (n, 3), metres in the frame, n >= 1, ordered as those of an added scan; none is left out."""
    points, spacing = np.asarray(xyz, np.float32), point_spacing(xyz)
    found = order_by_level(points.astype(np.float64), finest_level(float(np.median(spacing))))
    points = points[found.order]
    keys = np.column_stack([found.level, found.node])
    start = np.flatnonzero(np.r_[True, (keys[1:] != keys[:-1]).any(axis=1)])
    return PointCloud(
        frame=frame,
        height_datum=height_datum,
        xyz=points,
        rgb=None if rgb is None else np.asarray(rgb)[found.order],
        intensity=None if intensity is None else np.asarray(intensity)[found.order],
        classification=np.full(len(points), UNCLASSIFIED, np.uint8),
        nodes=CloudNodes(
            start=start,
            count=np.diff(start, append=len(points)),
            level=found.level[start].astype(np.int16),
            spacing_m=found.spacing_m[start],
            box_min=np.minimum.reduceat(points, start, axis=0),
            box_max=np.maximum.reduceat(points, start, axis=0),
        ),
        spacing_m=spacing[found.order],
    )
