"""A scan under a track: corners of the frame on the scan's surface, and keyframes registered to the scan.

The paper's structure projection (sections 2.3 and 3.2): at a registered frame the scan is rendered as the
camera sees it, and what the frame shows there gets its place from the depth. Landmarks of one keyframe share
the error of its pose; the next keyframe is registered anew, so that none of it is handed on.
"""

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame.register import fit_near, register_frame
from ingest.register.frame.views import FrameOptions, available_sources
from ingest.register.frame_registration import FramePrior, RenderSource
from ingest.register.structure.depth_filter import surface_at
from reloc.localise.result import LocaliseRequest, place_on_earth
from reloc.tracking.ground import EarthPose, Ground, Keyframe, Unmatched
from reloc.tracking.options import TrackOptions
from reloc.tracking.pose_fit import of_camera

_PER_KEYFRAME = 1 << 20  # numbers of landmarks that a keyframe has to itself
_HALF_PX = 0.5  # OpenCV's pixel (0, 0) is a centre, ours a corner
_SHOWN_KEYFRAMES = 4


# A film's frames are small and often near to what they show: at a pixel for each point of the scan most have
# too few pieces to say anything. In frames of the simulated flight, half a metre between the points and
# 50 m away, 38 to 63 % of the pieces agree at poses that were fitted to from 0.3 m off
# and 8 % at most at those fitted to from 8 m off, and 18 % in frames of a town with
# the same streets. A frame that a track leads to is asked for what lies between. One that is looked for over
# metres has more chances to be at a wrong place: frames of that town had 26 to 28 %, and with a limit of 30 %
# one was believed.
# From the track, some pixels off, the last round of the dense fit is enough, as often as it moves the pose.
_FIRST = FrameOptions(finest_spacing=0.5, min_agreeing=0.45, threads=1)
_NEAR = FrameOptions(
    finest_spacing=0.5, min_agreeing=0.33, fit_rounds=((3.75, 40, 6),), more_rounds=4, threads=1
)
# At most, that are looked for in a keyframe; the depth filter leaves out some. _CORNER_QUALITY: least
# strength, as a share of the strongest one's. _CORNER_APART_PX: between them, at 1280 px.
_CORNERS = 600
_CORNER_QUALITY = 0.005
_CORNER_APART_PX = 12.0
# How far the pose of a frame that is followed may be off, generously: the prior of its fit.
_TRACK_SIGMA_M = 1.0
_TRACK_SIGMA_DEG = 1.0
# How far a lost camera may be from where it was last seen: a second of a drone's flight. From so near a frame
# of another town is refused in 7 s; from three times as far the dense search had not ended after four
# minutes.
_LOST_SIGMA_M = 5.0
_LOST_SIGMA_HEADING_DEG = 8.0
_LOST_SIGMA_TILT_DEG = 3.0


class ScanGround:
    """A scan's surface; used from the tracker's thread, except `posed` and `visible`.

    Attributes:
        last: pose of the last keyframe, on the scan or on maps over it; None before the first. A lost camera
            is looked for from there.
    """

    def __init__(self, cloud: PointCloud, scan_id: str, epsg: int) -> None:
        """
        Args:
            scan_id: what poses are said to stand on. epsg: UTM zone of answers.
        """
        self._cloud, self._scan_id, self._epsg = cloud, scan_id, epsg
        self._source: RenderSource = available_sources(cloud)[0]
        self._covariances: list[FloatArray] = []  # by number of the keyframe, local axes
        self._average = KeyframeAverage()
        self._shown: deque[FloatArray] = deque(maxlen=_SHOWN_KEYFRAMES)
        self.last: Rigid3 | None = None

    @property
    def frame(self) -> LocalFrame:
        """The cloud's."""
        return self._cloud.frame

    def match(
        self, gray: NDArray[np.uint8], camera: Camera, pose: Rigid3, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """A frame (h, w) that the track knows, registered to the scan from there."""
        prior = FramePrior.around(pose, _TRACK_SIGMA_M, _TRACK_SIGMA_DEG)
        found = fit_near(gray, camera, prior, self._cloud, self._source, _NEAR)
        if found.cam_from_local is None or found.covariance is None or found.source is None:
            return Unmatched(reason=str(found.reason), detail=found.message)
        averaged = self._average.add(pose, found.cam_from_local, found.covariance)
        return self._landmarks(gray, camera, averaged, found.covariance, found.source, options)

    def found(
        self,
        gray: NDArray[np.uint8],
        camera: Camera,
        pose: Rigid3,
        covariance: FloatArray,
        source: RenderSource,
        options: TrackOptions,
    ) -> Keyframe | Unmatched:
        """Landmarks of a frame (h, w) that was registered without a track.

        Args:
            covariance: (6, 6) of the left perturbation of the pose. source: by which it was registered.
        """
        self._average.begin(pose, covariance)
        return self._landmarks(gray, camera, pose, covariance, source, options)

    def seen_elsewhere(self, pose: Rigid3) -> None:
        """The camera's pose by something else than the scan."""
        self.last = pose
        self._average.end()

    def _landmarks(
        self,
        gray: NDArray[np.uint8],
        camera: Camera,
        pose: Rigid3,
        covariance: FloatArray,
        source: RenderSource,
        options: TrackOptions,
    ) -> Keyframe | Unmatched:
        """The frame's corners, on the scan's surface."""
        self._source = source
        pixels = _corners(gray)
        rendering = render(self._cloud, camera, pose, RenderOptions(attributes=False, threads=1))
        hits = surface_at(rendering, self._cloud, pixels)
        pixels, points = pixels[hits.rows], hits.points
        if len(points) < options.min_matches:
            return Unmatched(
                reason="TOO_FEW_POINTS",
                detail=f"{len(points)} corners of the frame lie on the scan's surface, {options.min_matches} "
                "needed",
            )
        number = len(self._covariances)
        self._covariances.append(of_camera(pose, covariance))
        self._shown.append(points)
        self.last = pose
        return Keyframe(
            cam_from_local=pose,
            ground=self,
            camera=camera,
            pixels=pixels,
            points=points,
            # Below zero: a map's points, which may stand beside them, are numbered from zero.
            rows=-1 - (number * _PER_KEYFRAME + np.arange(len(points), dtype=np.int64)),
        )

    def posed(self, rows: NDArray[np.int64], pose: Rigid3, measured: FloatArray) -> EarthPose:
        """With the error that the landmarks of a keyframe share: that of the keyframe with most of them."""
        number = int(np.bincount((-1 - rows) // _PER_KEYFRAME).argmax())
        to_true = np.kron(np.eye(2), self.frame.true_enu_from_enu(pose.center))
        covariance = to_true @ (measured + self._covariances[number]) @ to_true.T
        return EarthPose(
            **place_on_earth(self.frame, pose, self._epsg),
            height_datum=self._cloud.height_datum,
            map_id=self._scan_id,
            covariance=0.5 * (covariance + covariance.T),
        )

    def visible(self, camera: Camera, pose: Rigid3) -> FloatArray:
        """Landmarks of the last keyframes, followed or not."""
        shown = list(self._shown)
        if not shown:
            return np.empty((0, 2))
        pixels = camera.project(pose.act(np.concatenate(shown)))
        return pixels[np.isfinite(pixels).all(axis=1)]


class ScanFinder:
    """Finds frames on a scan: the first from a coarse pose, later ones from where the camera was last."""

    def __init__(self, cloud: PointCloud, scan_id: str, epsg: int, first: FramePrior | None) -> None:
        """
        Args:
            cloud: the scan around the flight.
            first: coarse pose of the first frame, in the cloud's frame; None: nothing is found until
                something else has found a frame.
        """
        self._cloud = cloud
        self.ground = ScanGround(cloud, scan_id, epsg)
        self._first = first

    def find(
        self, gray: NDArray[np.uint8], request: LocaliseRequest, options: TrackOptions
    ) -> Keyframe | Unmatched:
        """A frame (h, w) registered from the prior; the request's camera is taken as calibrated."""
        if request.camera is None:
            return Unmatched(reason="NO_CAMERA", detail="a scan alone does not tell the lens; give a camera")
        prior = self._prior()
        if prior is None:
            return Unmatched(reason="NO_POSE", detail="a scan is not searched without a coarse pose")
        found = register_frame(gray, request.camera, prior, self._cloud, _FIRST)
        if found.cam_from_local is None or found.covariance is None or found.source is None:
            return Unmatched(reason=str(found.reason), detail=found.message)
        return self.ground.found(
            gray, request.camera, found.cam_from_local, found.covariance, found.source, options
        )

    def has(self, ground: Ground) -> bool:
        """Whether the track is on this scan."""
        return ground is self.ground

    def _prior(self) -> FramePrior | None:
        """The coarse pose; once the camera was seen, from there as far as it may have gone."""
        if self.ground.last is None:
            return self._first
        return FramePrior(
            cam_from_local=self.ground.last,
            sigma_horizontal_m=_LOST_SIGMA_M,
            sigma_vertical_m=_LOST_SIGMA_M,
            sigma_heading_deg=_LOST_SIGMA_HEADING_DEG,
            sigma_tilt_deg=_LOST_SIGMA_TILT_DEG,
        )


def _corners(gray: NDArray[np.uint8]) -> FloatArray:
    """Pixels (n, 2) that the flow can hold on to, the strongest first."""
    scale = max(gray.shape) / 1280
    found = cv2.goodFeaturesToTrack(gray, _CORNERS, _CORNER_QUALITY, _CORNER_APART_PX * scale)
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + _HALF_PX


# Registrations of a film's keyframes, averaged along its track, so that poses do not jump at each.
#
# A window of keyframes whose older ones fade: what is adjusted in one go over a sliding window is folded into
# one normal distribution, as a Kalman filter does. The track says how the camera moved between keyframes, far
# better than a registration says where it is.


_FADE = 0.75  # what a keyframe counts at the next one: about 1 / (1 - 0.75) of them take part
# Squared normalised distance between the track and a registration; beyond it the track has gone astray, and
# the average begins again.
_MAX_CHI2 = 20.1


class KeyframeAverage:
    """The fading average of the registrations of one uninterrupted track."""

    def __init__(self) -> None:
        self._information: FloatArray | None = None
        self._center = np.zeros(3)

    def begin(self, pose: Rigid3, covariance: FloatArray) -> None:
        """With the registration of a frame that was found."""
        self._information = np.asarray(np.linalg.inv(of_camera(pose, covariance)), dtype=np.float64)
        self._center = pose.center

    def end(self) -> None:
        """The track goes on by something else, or is lost."""
        self._information = None

    def add(self, tracked: Rigid3, registered: Rigid3, covariance: FloatArray) -> Rigid3:
        """The pose of a keyframe by all of them.

        Args:
            tracked: where the track has it. registered: where the scan has it.
            covariance: (6, 6) of the left perturbation of the registered pose.
        """
        if self._information is None:
            self.begin(registered, covariance)
            return registered
        # An error of the older keyframes' rotation moves the camera by what it has gone since.
        back = np.eye(6)
        back[3:, :3] = skew(tracked.center - self._center)
        older = _FADE * back.T @ self._information @ back
        own = np.linalg.inv(of_camera(registered, covariance))
        to_local = np.kron(np.eye(2), -tracked.rotation.T)
        apart = to_local @ (registered @ tracked.inverse()).log()
        if apart @ np.linalg.solve(np.linalg.inv(older) + np.linalg.inv(own), apart) > _MAX_CHI2:
            self.begin(registered, covariance)
            return registered
        moved = np.linalg.solve(older + own, own @ apart)
        fused = Rigid3.exp(to_local.T @ moved) @ tracked
        self._information, self._center = older + own, fused.center
        return fused
