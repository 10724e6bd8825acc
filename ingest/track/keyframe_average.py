"""Registrations of a film's keyframes, averaged along its track, so that poses do not jump at each.

A window of keyframes whose older ones fade: what is adjusted in one go over a sliding window is folded into
one normal distribution, as a Kalman filter does. The track says how the camera moved between keyframes, far
better than a registration says where it is.
"""

import numpy as np

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from reloc.tracking.pose_fit import of_camera


class KeyframeAverage:
    """The fading average of the registrations of one uninterrupted track."""

    def __init__(self, fade: float, max_chi2: float) -> None:
        """
        Args:
            fade: what a keyframe counts at the next one, 0 to 1: about 1 / (1 - fade) of them take part.
            max_chi2: squared normalised distance between the track and a registration; beyond it the track
                has gone astray, and the average begins again.
        """
        self._fade, self._max_chi2 = fade, max_chi2
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
        older = self._fade * back.T @ self._information @ back
        own = np.linalg.inv(of_camera(registered, covariance))
        to_local = np.kron(np.eye(2), -tracked.rotation.T)
        apart = to_local @ (registered @ tracked.inverse()).log()
        if apart @ np.linalg.solve(np.linalg.inv(older) + np.linalg.inv(own), apart) > self._max_chi2:
            self.begin(registered, covariance)
            return registered
        moved = np.linalg.solve(older + own, own @ apart)
        fused = Rigid3.exp(to_local.T @ moved) @ tracked
        self._information, self._center = older + own, fused.center
        return fused
