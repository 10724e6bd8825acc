"""A picture that shows how well the map sits on the photo.

Green circles are keypoints that agree with the pose, the short line leads to where their map point
projects; small blue dots are other points of the map that should be visible.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from featuredb.errors import FeatureDbError, InvalidValueError
from featuredb.features.decode import decode_rgb
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from reloc.localise.candidates import IndexedArea
from reloc.localise.matching import visible_points
from reloc.wire.query import LocaliseReply

_INLIER_BGR = (60, 220, 60)
_RESIDUAL_BGR = (40, 40, 240)
_OTHER_BGR = (240, 160, 40)
_MAX_OTHER = 4000  # more dots hide the photo
_SAME_POINT_M = 0.001
_MAX_SIDE_PX = 1600  # of the picture; larger ones only take longer to open


def draw_overlay(
    photo: bytes, reply: LocaliseReply, other_points_utm: FloatArray | None = None
) -> NDArray[np.uint8]:
    """The photo with the projected map, (h, w, 3) uint8 BGR, longer side at most 1600 px.

    Args:
        photo: bytes of the query's image file.
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
    image = np.ascontiguousarray(decode_rgb(photo)[:, :, ::-1])
    shrink = min(1.0, _MAX_SIDE_PX / max(image.shape[:2]))
    if shrink < 1.0:
        image = np.asarray(
            cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    if other_points_utm is not None and len(other_points_utm):
        others = _thinned(_without(other_points_utm, np.array(reply.inlier_points.utm).reshape(-1, 3)))
        for x, y in _inside(project_utm(reply, others), reply) * shrink:
            cv2.circle(image, (round(x), round(y)), 2, _OTHER_BGR, -1, cv2.LINE_AA)
    keypoints = np.array(reply.inlier_points.pixels).reshape(-1, 2)
    projected = project_utm(reply, np.array(reply.inlier_points.utm).reshape(-1, 3))
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
        path.write_bytes(png.tobytes() if encoded else b"")
    except OSError as error:
        raise FeatureDbError(f"overlay: cannot write {path}: {error.strerror or error}") from error


def project_utm(reply: LocaliseReply, points_utm: FloatArray) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in the reply's UTM zone; NaN behind the camera.

    Through a local frame at the camera, because UTM itself is not metric.
    """
    utm, used = reply.utm, reply.camera
    if utm is None or used is None:
        raise InvalidValueError("project_utm: expected a localised reply")
    camera = Camera(model=used.model, width=used.width, height=used.height, params=used.params)
    frame = LocalFrame.from_utm(utm.easting, utm.northing, utm.height, utm.epsg)
    grid_from_local = frame.grid_from_enu(np.zeros(3), utm.epsg)
    rotation = matrix_from_quaternion(utm.cam_from_utm_xyzw) @ grid_from_local
    cam_from_local = Rigid3(rotation=rotation, translation=np.zeros(3))
    return camera.project(cam_from_local.act(frame.enu_from_utm(points_utm, utm.epsg)))


def map_points_in_view(areas: Sequence[IndexedArea], reply: LocaliseReply) -> FloatArray:
    """Points (n, 3) of the answering area that the photo should show: easting, northing, height in its zone.

    Args:
        areas: those of the localiser that gave the reply.
    """
    utm, used = reply.utm, reply.camera
    if utm is None or used is None:
        raise InvalidValueError("map_points_in_view: expected a localised reply")
    camera = Camera(model=used.model, width=used.width, height=used.height, params=used.params)
    for indexed in areas:
        area = indexed.area
        if reply.maps[0] not in {feature_map.map_id for feature_map in area.maps}:
            continue
        center = area.frame.enu_from_utm((utm.easting, utm.northing, utm.height), utm.epsg)
        grid_from_local = area.frame.grid_from_enu(center, utm.epsg)
        rotation = matrix_from_quaternion(utm.cam_from_utm_xyzw) @ grid_from_local
        cam_from_local = Rigid3(rotation=rotation, translation=-rotation @ center)
        rows = visible_points(area, area.searched_points(), camera, cam_from_local)
        return area.frame.utm_from_enu(area.points[rows], utm.epsg)
    return np.empty((0, 3))


def _inside(pixels: FloatArray, reply: LocaliseReply) -> FloatArray:
    assert reply.camera is not None
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < [reply.camera.width, reply.camera.height])).all(axis=1)
    return pixels[inside]


def _without(points: FloatArray, taken: FloatArray) -> FloatArray:
    """The points (n, 3) that are none of `taken` (k, 3), metres; the reply rounds coordinates."""
    if not len(taken):
        return points
    distance, _ = cKDTree(taken).query(points, distance_upper_bound=_SAME_POINT_M)
    return points[~np.isfinite(distance)]


def _thinned(points: FloatArray) -> FloatArray:
    step = max(1, len(points) // _MAX_OTHER)
    return points[::step]


def _caption(image: NDArray[np.uint8], reply: LocaliseReply) -> None:
    assert reply.utm is not None
    text = (
        f"EPSG {reply.utm.epsg}  E {reply.utm.easting:.2f}  N {reply.utm.northing:.2f}  "
        f"H {reply.utm.height:.2f}  {reply.inliers} inliers"
    )
    height = image.shape[0]
    image[max(0, height - 26) :] //= 4  # a dark band, so that the text reads on any photo
    cv2.putText(image, text, (8, height - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
