"""Photos asked of a database in this process: what `featuredb localise` and Python share."""

import base64
import threading
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.decode import read_image_bytes
from featuredb.features.shrink import shrunk
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.store import Database
from reloc.answered_view import AnsweredView, geopose_of
from reloc.localiser import Localiser
from reloc.overlay import draw_overlay, map_points_in_view
from reloc.service.handler import answer_query
from reloc.service.options import wire_name_of
from reloc.wire.query import (
    CameraRequest,
    LocaliseReply,
    LocaliseWireRequest,
    PriorRequest,
    RequestOptions,
    explain,
)
from reloc.wording import describe

Image = bytes | str | Path | NDArray[np.uint8]
_SHOWN_PX = 900  # longer side of a picture in a notebook


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhotoAnswer:
    """Where a photo was taken, or why that is not known. `print` it, or let a notebook show it.

    Attributes:
        name: of the photo. database: name of the one that was asked.
        reply: every figure, as the wire words it (docs/wire.md).
        photo: bytes of the image file.
        other_points_utm: (n, 3) further points of the map that the photo should show, easting, northing,
            height in metres; None where it is not localised on Earth.
    """

    name: str
    database: str
    reply: LocaliseReply
    photo: bytes
    other_points_utm: FloatArray | None

    @property
    def localised(self) -> bool:
        """Whether there is a pose, on Earth or in a map without a place."""
        return self.reply.status != "not_localised"

    @property
    def utm(self) -> FloatArray | None:
        """(3,) float64: easting, northing, height of the camera in metres, zone `reply.utm.epsg`; or None."""
        utm = self.reply.utm
        return None if utm is None else np.array([utm.easting, utm.northing, utm.height])

    @property
    def heading_pitch_roll_deg(self) -> tuple[float, float, float] | None:
        """Degrees: heading clockwise from true north, pitch up from level, roll clockwise; or None."""
        return None if self.reply.quaternion is None else geopose_of(self.reply).heading_pitch_roll_deg

    @property
    def covariance(self) -> FloatArray | None:
        """(6, 6) float64 along true east, north, up: rotation (rad) before position (m); or None."""
        return None if self.reply.covariance is None else np.array(self.reply.covariance)

    def overlay(self) -> NDArray[np.uint8]:
        """The photo with the projected map, (h, w, 3) uint8 red first, longer side at most 1600 px.

        Raises:
            InvalidValueError: not localised on Earth.
        """
        return np.ascontiguousarray(draw_overlay(self.photo, self.reply, self.other_points_utm)[:, :, ::-1])

    def __str__(self) -> str:
        return describe(self.name, self.reply, self.database)

    def _repr_html_(self) -> str:
        """Text, and the photo with its inliers."""
        text = f"<pre>{escape(str(self))}</pre>"
        if self.reply.inlier_points is None or self.utm is None:
            return text
        small = shrunk(draw_overlay(self.photo, self.reply, self.other_points_utm), _SHOWN_PX)
        data = base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode("ascii")
        return f'{text}<img alt="inliers" src="data:image/jpeg;base64,{data}">'


class PhotoAsker:
    """Answers photos from a snapshot; its index is kept between calls. Threads may share it."""

    def __init__(self, database: Database, as_of: int | None = None) -> None:
        """`as_of`: answer from this snapshot for ever; None: from the newest."""
        self._database, self._as_of = database, as_of
        self.name = wire_name_of(database.url)  # as a server calls it
        self._lock = threading.Lock()
        self._localiser: Localiser | None = None

    def localiser(self) -> Localiser:
        """The maps of the snapshot; what did not change is not indexed again."""
        with self._lock:
            wanted = self._database.poll_version() if self._as_of is None else self._as_of
            if self._localiser is None or self._localiser.snapshot != wanted:
                self._localiser = Localiser.open(self._database, as_of=self._as_of, previous=self._localiser)
            return self._localiser

    def ask(
        self,
        image: Image,  # path or bytes of a file, or pixels, (h, w) or (h, w, 3) uint8, red first
        *,
        prior: PriorRequest | tuple[float, float, float] | None = None,  # WGS84 degrees, sigma in metres
        camera: CameraRequest | Camera | None = None,  # of any size; exact unless it gives sigmas
        exif_prior: bool = True,  # the photo's EXIF position settles what is ambiguous without a prior
        maps: tuple[str, ...] | None = None,  # ask only these
        inliers: bool = True,  # the answer carries the matches that agree, which its pictures need
    ) -> PhotoAnswer:
        """Where was this photo taken?

        Raises:
            ImageError: no usable image. InvalidValueError: a prior or camera that is none.
            RequestError: an image, a camera or maps that do not fit. StoreError: the database is gone.
        """
        photo, called = _image_bytes(image)
        try:
            if isinstance(prior, tuple):
                lat, lon, sigma_m = map(float, prior)
                prior = PriorRequest(lat=lat, lon=lon, sigma_m=sigma_m)
            if isinstance(camera, Camera):
                camera = CameraRequest(**asdict(camera))
            options = RequestOptions(inliers=inliers, exif_prior=exif_prior, maps=maps)
            request = LocaliseWireRequest(prior=prior, camera=camera, options=options)
        except ValidationError as error:
            raise InvalidValueError(f"localise: {explain(error)}") from error
        except (TypeError, ValueError) as error:
            raise InvalidValueError(
                f"localise: expected a prior of latitude, longitude and metres, found {prior!r}"
            ) from error
        localiser = self.localiser()
        reply = answer_query(request, photo, localiser)
        others = None
        if reply.status == "localised" and inliers:
            others = map_points_in_view(localiser.areas, AnsweredView.of_reply(reply))
        return PhotoAnswer(name=called, database=self.name, reply=reply, photo=photo, other_points_utm=others)


def _image_bytes(image: Image) -> tuple[bytes, str]:
    """An image file, and what to call it."""
    if isinstance(image, bytes):
        return image, "photo"
    if isinstance(image, str | Path):
        return read_image_bytes(Path(image)), str(image)
    pixels = np.asarray(image)
    is_picture = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if pixels.dtype != np.uint8 or not pixels.size or not is_picture:
        raise ImageError(
            "image: expected a path, bytes, or pixels (h, w) or (h, w, 3) uint8, found an array of "
            f"{pixels.shape} {pixels.dtype}"
        )
    stored = pixels if pixels.ndim == 2 else pixels[:, :, ::-1]
    return cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes(), "photo"
