"""A picture that shows how well the map sits on the photo: keypoints, and where they should lie."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.atomic import atomic_file
from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.features.decode import decode_rgb
from featuredb.features.shrink import shrunk
from featuredb.geometry.arrays import FloatArray
from reloc.answered_view import AnsweredView
from reloc.localise.candidates import IndexedArea
from reloc.localise.matching import visible_points
from reloc.wire.query import LocaliseReply

_INLIER_BGR = (60, 220, 60)
_RESIDUAL_BGR = (40, 40, 240)
_OTHER_BGR = (240, 160, 40)
_MAX_OTHER = 4000  # more dots hide the photo
_SAME_POINT_M = 0.001
_LEGEND = "green: keypoints that agree; red: how far off; blue: other map points"
_MAX_SIDE_PX = 1600  # of the picture; larger ones only take longer to open


def draw_overlay(
    photo: bytes, reply: LocaliseReply, other_points_utm: FloatArray | None = None
) -> NDArray[np.uint8]:
    """The photo with the projected map, (h, w, 3) uint8 BGR, longer side at most 1600 px.

    Args:
        reply: localised, with `inlier_points` (ask for them).
        other_points_utm: (n, 3) further points of the map, easting, northing, height in the reply's zone.

    Raises:
        InvalidValueError: the reply has no pose or no inlier points.
        ImageError: the photo cannot be read.
    """
    if reply.utm is None or reply.camera is None or reply.inlier_points is None:
        raise InvalidValueError(
            f"overlay: expected a localised reply with inlier points, found {reply.status} "
            f"({reply.detail}); ask with options.inliers"
        )
    whole = decode_rgb(photo)
    image = np.ascontiguousarray(shrunk(whole, _MAX_SIDE_PX)[:, :, ::-1])
    shrink = max(image.shape) / max(whole.shape)
    view, inliers_utm = AnsweredView.of_reply(reply), np.array(reply.inlier_points.utm).reshape(-1, 3)
    if other_points_utm is not None and len(other_points_utm):
        others = _without(other_points_utm, inliers_utm)
        others = others[:: max(1, len(others) // _MAX_OTHER)]
        pixels = view.project_utm(others)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels < [view.camera.width, view.camera.height])).all(axis=1)
        for x, y in pixels[inside] * shrink:
            cv2.circle(image, (round(x), round(y)), 2, _OTHER_BGR, -1, cv2.LINE_AA)
    keypoints = np.array(reply.inlier_points.pixels).reshape(-1, 2)
    projected = view.project_utm(inliers_utm)
    for (x, y), (u, v) in zip(keypoints * shrink, projected * shrink, strict=True):
        cv2.circle(image, (round(x), round(y)), 4, _INLIER_BGR, 1, cv2.LINE_AA)
        if np.isfinite([u, v]).all():
            cv2.line(image, (round(x), round(y)), (round(u), round(v)), _RESIDUAL_BGR, 1, cv2.LINE_AA)
    _caption(image, reply)
    return image


def write_overlay(
    path: Path, photo: bytes, reply: LocaliseReply, other_points_utm: FloatArray | None = None
) -> None:
    """Draw and write the picture as PNG.

    Raises:
        As `draw_overlay`; FeatureDbError: the file cannot be written.
    """
    encoded, png = cv2.imencode(".png", draw_overlay(photo, reply, other_points_utm))
    try:
        with atomic_file(path) as part:
            part.write_bytes(png.tobytes() if encoded else b"")
    except OSError as error:
        raise FeatureDbError(f"overlay: cannot write {path}: {error.strerror or error}") from error


def map_points_in_view(areas: Sequence[IndexedArea], view: AnsweredView) -> FloatArray:
    """Points (n, 3) of the answering area that the photo should show: easting, northing, height in its zone.

    `areas`: those of the localiser that gave the answer.
    """
    for area in (indexed.area for indexed in areas):
        if view.map_ids[0] in {feature_map.map_id for feature_map in area.maps}:
            pose = view.seen_in(area.frame).cam_from_local
            rows = visible_points(area, area.searched_points(), view.camera, pose)
            return area.frame.utm_from_enu(area.points[rows], view.epsg)
    return np.empty((0, 3))


def _without(points: FloatArray, taken: FloatArray) -> FloatArray:
    """The points (n, 3) that are none of `taken` (k, 3), metres; the reply rounds coordinates."""
    if not len(taken):
        return points
    distance, _ = cKDTree(taken).query(points, distance_upper_bound=_SAME_POINT_M)
    return points[~np.isfinite(distance)]


def _caption(image: NDArray[np.uint8], reply: LocaliseReply) -> None:
    assert reply.utm is not None
    text = (
        f"EPSG {reply.utm.epsg}  E {reply.utm.easting:.2f}  N {reply.utm.northing:.2f}  "
        f"H {reply.utm.height:.2f}  {reply.inliers} inliers"
    )
    height, white = image.shape[0], (255, 255, 255)
    image[max(0, height - 46) :] //= 4  # a dark band, so that the text reads on any photo
    for up, line in ((28, text), (8, _LEGEND)):
        cv2.putText(image, line, (8, height - up), cv2.FONT_HERSHEY_SIMPLEX, 0.5, white, 1, cv2.LINE_AA)
