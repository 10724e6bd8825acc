"""A photo dropped on the page: the answer that a server would give, and how to draw it."""

import base64
import threading
from typing import Any

import numpy as np

from featuredb.features.decode import DecodeLimits
from featuredb.geo.local_frame import LocalFrame
from featuredb.store import Database
from reloc.answered_view import AnsweredView, geopose_of
from reloc.asking import PhotoAsker
from reloc.overlay import draw_overlay
from reloc.viewer.photos import PICTURE_PX, jpeg_of
from reloc.viewer.poses import drawn_pose, worded_sigmas
from reloc.viewer.scene import ViewerScene
from reloc.wire.query import LocaliseReply

LIMITS = DecodeLimits()


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
