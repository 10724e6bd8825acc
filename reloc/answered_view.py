"""The camera of an answer: its lens and pose in a frame of its own, with how well both are known."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geo.geopose import GeoPose
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion
from featuredb.maps.feature_map import GeoPrior
from reloc.localise.lens_prior import lens_of, opencv_by_lens, pixel_jacobians
from reloc.wire.query import CameraRequest, Intrinsics, LocaliseReply, PriorRequest
from reloc.wire.track import TrackPose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnsweredView:
    """A camera on Earth."""

    frame: LocalFrame  # true east, north, up at the camera's centre, or near it
    camera: Camera  # of the photo's stored pixels
    cam_from_local: Rigid3  # `frame` to camera axes, metres
    # (6 + n, 6 + n) of the pose as LocalisedPose has it, then of the n camera parameters; n = 0: the lens is
    # exact.
    covariance: FloatArray
    epsg: int  # UTM zone of the answer
    height_datum: str  # of its heights
    map_ids: tuple[str, ...] = ()  # that answered

    def __post_init__(self) -> None:
        freeze(self, covariance=(None, None))
        if self.covariance.shape not in ((6, 6), (6 + len(self.camera.params),) * 2):
            raise InvalidValueError(
                f"AnsweredView.covariance: expected a pose's, or with its lens, found {self.covariance.shape}"
            )

    @classmethod
    def of_reply(cls, reply: LocaliseReply) -> Self:
        """The camera of a localised reply. Raises InvalidValueError: it has no pose on Earth."""
        utm, used, covariance = reply.utm, reply.camera, reply.covariance
        if utm is None or used is None or covariance is None:
            raise InvalidValueError(f"expected a pose on Earth, found {reply.status}: {reply.detail}")
        return cls.at(
            (utm.easting, utm.northing, utm.height),
            utm.epsg,
            utm.cam_from_utm_xyzw,
            camera=camera_of(used),
            covariance=np.array(covariance if reply.view_covariance is None else reply.view_covariance),
            height_datum=reply.height_datum or "unknown",
            map_ids=reply.maps,
        )

    @classmethod
    def at(cls, utm: ArrayLike, epsg: int, cam_from_utm_xyzw: ArrayLike, **known: Any) -> Self:
        """A camera at a UTM place (3,), with the rotation (4,) of grid axes into camera axes.

        `known`: camera, covariance and height_datum, and map_ids where they are known.
        """
        easting, northing, height = np.asarray(utm, dtype=np.float64).tolist()
        frame = LocalFrame.from_utm(easting, northing, height, epsg)
        rotation = matrix_from_quaternion(cam_from_utm_xyzw) @ frame.grid_from_enu(np.zeros(3), epsg)
        cam_from_local = Rigid3(rotation=rotation, translation=np.zeros(3))
        return cls(frame=frame, cam_from_local=cam_from_local, epsg=epsg, **known)

    def seen_in(self, frame: LocalFrame) -> "AnsweredView":
        """The same camera with its pose in another frame nearby; the covariance keeps its axes."""
        return replace(self, frame=frame, cam_from_local=self.cam_from_local @ self.frame.enu_from(frame))

    def project_utm(self, points_utm: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3), easting, northing, height in the zone; NaN behind the camera.

        Through the local frame, because UTM itself is not metric.
        """
        points = self.frame.enu_from_utm(points_utm, self.epsg)
        return self.camera.project(self.cam_from_local.act(points))

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) in `frame`, of depth 1 along the optical axis; NaN where the lens sees nothing."""
        xy = self.camera.unproject(pixels)
        return np.asarray(np.column_stack([xy, np.ones(len(xy))]) @ self.cam_from_local.rotation)

    def pixel_derivatives(self, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of the pixel of a point (3,): by the point (2, 3), and by what `covariance` is of (2, 6 + n).

        Raises:
            InvalidValueError: with a lens that is neither OPENCV nor SIMPLE_RADIAL, and not exact.
        """
        lens = len(self.covariance) > 6
        by_point, by_view = pixel_jacobians(self.camera, self.cam_from_local, point[None], lens=lens)
        by_params = np.eye(len(self.covariance))
        if lens and self.camera.model == "OPENCV":
            by_params[6:, 6:] = np.linalg.inv(opencv_by_lens(lens_of(self.camera)))
        return by_point[0], by_view[0] @ by_params


def geopose_of(message: LocaliseReply | TrackPose) -> GeoPose:
    """The pose of an answer that has one on Earth, which tells its angles; see docs/localisation.md."""
    assert message.position is not None
    assert message.quaternion is not None
    q = message.quaternion
    return GeoPose(
        latitude_deg=message.position.lat,
        longitude_deg=message.position.lon,
        height_m=message.position.h,
        quaternion_xyzw=(q.x, q.y, q.z, q.w),
    )


def camera_of(lens: CameraRequest | Intrinsics) -> Camera:
    """The camera that a message speaks of. Raises InvalidValueError: it is none."""
    return Camera(model=lens.model, width=lens.width, height=lens.height, params=lens.params)


def geo_prior(prior: PriorRequest) -> GeoPrior:
    """The prior that a message speaks of."""
    return GeoPrior(
        latitude_deg=prior.lat,
        longitude_deg=prior.lon,
        height_m=prior.h,
        sigma_horizontal_m=prior.sigma_m,
        sigma_vertical_m=prior.sigma_vertical_m,
    )
