"""A photo dropped on the page: the answer that a server would give, and how to draw it."""

import base64
import threading
import uuid
from typing import Any

import numpy as np

from featuredb.features.decode import DecodeLimits
from featuredb.geo.geopose import GeoPose
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.camera import Camera
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.stage_clock import StageClock
from featuredb.store import Database
from reloc.localiser import Localiser
from reloc.overlay import draw_overlay, map_points_in_view
from reloc.service.handler import answer_query
from reloc.viewer.photos import PICTURE_PX, jpeg_of
from reloc.viewer.poses import drawn_pose, worded_sigmas
from reloc.viewer.scene import ViewerScene
from reloc.wire.query import LocaliseReply, LocaliseWireRequest, RequestOptions

LIMITS = DecodeLimits()


class Queries:
    """Answers photos from the snapshot that the page shows; one at a time, threads may share it.

    The maps are indexed with the first photo.
    """

    def __init__(self, database: Database, scene: ViewerScene) -> None:
        self._database = database
        self._scene = scene
        self._lock = threading.Lock()
        self._localiser: Localiser | None = None

    def ask(self, photo: bytes, *, exif_prior: bool = False) -> dict[str, Any]:
        """The answer to the bytes of an image file.

        Returns:
            `reply`: as on the wire. Where it is localised also `angles`, `overlay` (JPEG as a data URL), and
            where the place is shown `place`: row of it, and `pose`, `points` (inliers), metres in its frame.

        Raises:
            RequestError: no usable image, or maps of another extractor. StoreError: the database is gone.
        """
        request = LocaliseWireRequest(options=RequestOptions(inliers=True, exif_prior=exif_prior))
        with self._lock:
            if self._localiser is None:
                version = int(self._scene.document["snapshot"])
                self._localiser = Localiser.open(self._database, as_of=version)
            localiser = self._localiser
            reply = answer_query(
                photo,
                request,
                localiser,
                limits=LIMITS,
                request_id=uuid.uuid4().hex,
                clock=StageClock(),
            )
        answer: dict[str, Any] = {"reply": reply.model_dump(mode="json")}
        if reply.status != "localised":
            return answer
        answer["angles"] = _angles(reply)
        overlay = draw_overlay(photo, reply, map_points_in_view(localiser.areas, reply))
        answer["overlay"] = data_url("image/jpeg", jpeg_of(overlay, PICTURE_PX))
        place = next((self._scene.place_of_map[m] for m in reply.maps if m in self._scene.place_of_map), None)
        if place is not None:
            answer |= {"place": place, **_drawn(reply, self._scene.frames[place])}
        return answer


def data_url(media_type: str, data: bytes) -> str:
    """Bytes as a URL."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


def _angles(reply: LocaliseReply) -> dict[str, float]:
    assert reply.position is not None
    assert reply.quaternion is not None
    turn = reply.quaternion
    geopose = GeoPose(
        latitude_deg=reply.position.lat,
        longitude_deg=reply.position.lon,
        height_m=reply.position.h,
        quaternion_xyzw=(turn.x, turn.y, turn.z, turn.w),
    )
    heading, pitch, roll = geopose.heading_pitch_roll_deg
    return {"heading_deg": heading, "pitch_deg": pitch, "roll_deg": roll}


def _drawn(reply: LocaliseReply, frame: LocalFrame) -> dict[str, Any]:
    """Pose, ellipse and inliers in the place's frame."""
    utm, used = reply.utm, reply.camera
    assert utm is not None
    assert used is not None
    assert reply.inlier_points is not None
    center = frame.enu_from_utm((utm.easting, utm.northing, utm.height), utm.epsg)
    cam_from_local = matrix_from_quaternion(utm.cam_from_utm_xyzw) @ frame.grid_from_enu(center, utm.epsg)
    camera = Camera(model=used.model, width=used.width, height=used.height, params=used.params)
    pose = {
        **drawn_pose(center, np.asarray(cam_from_local.T), camera),
        **worded_sigmas(np.array(reply.covariance), frame.true_enu_from_enu(center).T),
    }
    points = frame.enu_from_utm(np.array(reply.inlier_points.utm).reshape(-1, 3), utm.epsg)
    return {"pose": pose, "points": np.round(points, 3).tolist()}
