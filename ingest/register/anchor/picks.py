"""A pose from points that a person picked in a photo and in the scan."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import RegistrationError
from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from ingest.register.anchor.start import StartOptions
from ingest.register.frame_registration import FramePrior
from reloc.jacobians import pixel_jacobians
from reloc.options import PoseOptions
from reloc.pose import estimate_pose, pose_uncertainty, refine_pose, reprojection_errors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picks:
    """Correspondences that a person picked in one photo.

    Attributes:
        image: the photo's name.
        pixels: (n, 2) full-size pixels, the centre of the top-left one at (0.5, 0.5).
        utm: (n, 3) easting, northing, height in the map's zone and the scan's datum, metres.
    """

    image: str
    pixels: FloatArray
    utm: FloatArray

    def __post_init__(self) -> None:
        pixels = frozen_array("Picks.pixels", self.pixels, (None, 2))
        object.__setattr__(self, "pixels", pixels)
        object.__setattr__(self, "utm", frozen_array("Picks.utm", self.utm, (len(pixels), 3)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PickedPose:
    """What the picks say.

    Attributes:
        prior: the pose with its deviations.
        covariance: (6, 6) of the left perturbation of the pose.
        residuals_px: (n,) of all picks.
        inliers: (n,) bool.
    """

    prior: FramePrior
    covariance: FloatArray
    residuals_px: FloatArray
    inliers: NDArray[np.bool_]

    @property
    def outliers(self) -> list[int]:
        """Rows of the picks that contradict the others."""
        return [int(i) for i in np.flatnonzero(~self.inliers)]


def pose_from_picks(
    picks: Picks, points: FloatArray, camera: Camera, present: Rigid3, options: StartOptions
) -> PickedPose:
    """Robust pose from picked correspondences.

    Args:
        points: (n, 3) the picks' coordinates in the local frame, metres.
        present: where the map has the camera now, in the local frame; only its vertical counts.

    Raises:
        RegistrationError: too few, contradictory, or badly spread picks.
    """
    count = len(picks.pixels)
    if count < options.min_picks:
        raise RegistrationError(
            f"picks of {picks.image}: expected at least {options.min_picks}, found {count}; "
            "add well-spread points"
        )
    settings = PoseOptions(tolerance_rel=options.pick_tolerance_rel, min_matches=options.min_picks)
    found = estimate_pose(picks.pixels, points, camera, "map", settings)
    if found is not None:
        found = refine_pose(picks.pixels, points, found, settings)
    if found is None or found.count < max(options.min_pick_share * count, options.min_picks - 1):
        agreeing = 0 if found is None else found.count
        raise RegistrationError(
            f"picks of {picks.image}: only {agreeing} of {count} agree with one pose within "
            f"{options.pick_tolerance_rel * max(camera.width, camera.height):.0f} px; check the order of the "
            "columns (pixel x, pixel y, easting, northing, height), the zone, the heights and the photo"
        )
    tilt = np.degrees(np.arccos(np.clip(found.cam_from_local.rotation[:, 2] @ present.rotation[:, 2], -1, 1)))
    if tilt > options.max_pick_tilt_deg:
        raise RegistrationError(
            f"picks of {picks.image}: they turn the camera's vertical by {tilt:.0f} degrees against the map; "
            "are easting and northing, or pixel x and y, swapped?"
        )
    inner = found.inliers
    covariance = _pick_covariance(picks.pixels[inner], points[inner], camera, found.cam_from_local, options)
    uncertainty = pose_uncertainty(
        picks.pixels[inner],
        points[inner],
        np.broadcast_to(options.pick_sigma_m**2 * np.eye(3), (found.count, 3, 3)),
        found,
        settings,
    )
    # The residuals of six picks may be small by luck: a person's precision is the least that is believed.
    covariance = np.maximum(1.0, np.trace(uncertainty.covariance) / np.trace(covariance)) * covariance
    prior = _prior(found.cam_from_local, covariance, options)
    if prior.sigma_horizontal_m > options.max_pick_sigma_m or max(
        prior.sigma_tilt_deg, prior.sigma_heading_deg
    ) > (options.max_pick_sigma_deg):
        raise RegistrationError(
            f"picks of {picks.image}: they leave the pose open to {prior.sigma_horizontal_m:.0f} m and "
            f"{max(prior.sigma_tilt_deg, prior.sigma_heading_deg):.0f} degrees; spread them over the photo"
        )
    to_left = np.kron(np.eye(2), -found.cam_from_local.rotation)
    return PickedPose(
        prior=prior,
        covariance=to_left @ covariance @ to_left.T,
        residuals_px=reprojection_errors(picks.pixels, points, camera, found.cam_from_local),
        inliers=inner,
    )


def _pick_covariance(
    pixels: FloatArray, points: FloatArray, camera: Camera, pose: Rigid3, options: StartOptions
) -> FloatArray:
    """(6, 6) of rotation about the local axes and centre, from a person's precision alone."""
    by_point, by_pose = pixel_jacobians(camera, pose, points)
    sigma_px = options.pick_sigma_px_rel * max(camera.width, camera.height)
    noise = sigma_px**2 * np.eye(2) + options.pick_sigma_m**2 * by_point @ by_point.transpose(0, 2, 1)
    information = np.einsum("nij,nik,nkl->jl", by_pose, np.linalg.inv(noise), by_pose)
    return np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64)


def _prior(pose: Rigid3, covariance: FloatArray, options: StartOptions) -> FramePrior:
    """From a covariance of rotation about the local axes and centre."""
    sigma = np.sqrt(np.diag(covariance))
    return FramePrior(
        cam_from_local=pose,
        sigma_horizontal_m=max(float(sigma[3:5].max()), options.min_sigma_horizontal_m),
        sigma_vertical_m=max(float(sigma[5]), options.min_sigma_vertical_m),
        sigma_heading_deg=max(float(np.degrees(sigma[2])), options.min_sigma_angle_deg),
        sigma_tilt_deg=max(float(np.degrees(sigma[:2].max())), options.min_sigma_angle_deg),
    )
