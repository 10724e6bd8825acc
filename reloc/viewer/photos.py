"""Photos on the page: pictures of those that maps are made of, and answers to those that are dropped on it.

Pixels are shown as they are stored, like everywhere here: a photo's camera and pose belong to the stored
pixels, so EXIF's orientation is not applied and not passed on.
"""

import base64
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.decode import INGEST_LIMITS, DecodeLimits, decode_rgb
from featuredb.features.shrink import shrunk
from featuredb.geo.local_frame import LocalFrame
from featuredb.maps.feature_map import MapImage
from featuredb.maps.photo_files import PhotoFolder
from featuredb.store import Database
from reloc.answered_view import AnsweredView, geopose_of
from reloc.asking import PhotoAsker
from reloc.overlay import draw_overlay
from reloc.viewer.map_layer import drawn_pose, worded_sigmas
from reloc.viewer.scene import ViewerScene
from reloc.wire.query import LocaliseReply

PICTURE_PX = 1200  # longer side on the page
THUMBNAIL_PX = 480  # in a file that is sent
_QUALITY = 82
LIMITS = DecodeLimits()  # of a photo that is dropped


class Pictures:
    """Where pictures come from; threads may share it."""

    def __init__(self, folder: Path | None) -> None:
        """Without a folder there are none, and the page says so. InvalidValueError: no such folder."""
        if folder is not None and not folder.is_dir():
            raise InvalidValueError(f"--photos {folder}: expected the folder of the photos, found none")
        self._folder = None if folder is None else PhotoFolder(folder)

    def jpeg(self, image: MapImage, longer_side_px: int) -> tuple[bytes | None, str]:
        """The picture as JPEG, its longer side at most so many pixels; or None and why, in words."""
        if self._folder is None:
            return None, "no folder of photos was given (--photos FOLDER)"
        path, reason = self._folder.find(image)
        if path is None:
            return None, f"not found in the folder of photos: {reason}"
        try:
            pixels = decode_rgb(path, INGEST_LIMITS)
        except ImageError as error:
            return None, f"the file cannot be shown: {error}"
        return jpeg_of(np.ascontiguousarray(pixels[:, :, ::-1]), longer_side_px), ""


def jpeg_of(bgr: NDArray[np.uint8], longer_side_px: int) -> bytes:
    """Pixels (h, w, 3) uint8 BGR as JPEG without metadata, shrunk to the given longer side."""
    small = shrunk(bgr, longer_side_px)
    encoded, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert encoded
    return data.tobytes()


class Queries:
    """Answers photos from the snapshot that the page shows; one at a time, threads may share it.

    The maps are indexed with the first photo.
    """

    def __init__(self, database: Database, scene: ViewerScene) -> None:
        self._scene = scene
        self._asker = PhotoAsker(database, as_of=int(scene.document["snapshot"]))
        self._lock = threading.Lock()

    def ask(self, photo: bytes, *, exif_prior: bool = False) -> dict[str, Any]:
        """The answer to the bytes of an image file.

        Returns:
            `reply`: as on the wire. Where it is localised also `angles`, `overlay` (JPEG as a data URL), and
            where the place is shown `place`: row of it, and `pose`, `points` (inliers), metres in its frame.

        Raises:
            RequestError: no usable image, or maps of another extractor. StoreError: the database is gone.
        """
        with self._lock:
            found = self._asker.ask(photo, exif_prior=exif_prior)
        reply = found.reply
        answer: dict[str, Any] = {"reply": reply.model_dump(mode="json")}
        if reply.status != "localised":
            return answer
        heading, pitch, roll = geopose_of(reply).heading_pitch_roll_deg
        answer["angles"] = {"heading_deg": heading, "pitch_deg": pitch, "roll_deg": roll}
        overlay = draw_overlay(photo, reply, found.other_points_utm)
        answer["overlay"] = data_url("image/jpeg", jpeg_of(overlay, PICTURE_PX))
        place = next((self._scene.place_of_map[m] for m in reply.maps if m in self._scene.place_of_map), None)
        if place is not None:
            answer |= {"place": place, **_drawn(reply, self._scene.frames[place])}
        return answer


def data_url(media_type: str, data: bytes) -> str:
    """Bytes as a URL."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


def _drawn(reply: LocaliseReply, frame: LocalFrame) -> dict[str, Any]:
    """Pose, ellipse and inliers in the place's frame."""
    assert reply.inlier_points is not None
    seen = AnsweredView.of_reply(reply).seen_in(frame)
    center = seen.cam_from_local.center
    pose = {
        **drawn_pose(center, np.asarray(seen.cam_from_local.rotation.T), seen.camera),
        **worded_sigmas(np.array(reply.covariance), frame.true_enu_from_enu(center).T),
    }
    points = frame.enu_from_utm(np.array(reply.inlier_points.utm).reshape(-1, 3), seen.epsg)
    return {"pose": pose, "points": np.round(points, 3).tolist()}
