"""What is known of a focal length beforehand, as a term of COLMAP's bundle adjustment.

From above, focal length and height hardly differ in the pixels: what little they tell is drowned by what the
lens model leaves over, and thousands of observations then settle on a wrong one with great confidence
(`brighton`: 2720 to 2920 px; a laser scan says 2296, EXIF 2311). The camera itself knows better.

COLMAP has no priors of intrinsics. Images that see fixed points near the optical axis are the same thing: a
point at the angle t (tangent) off the axis, found where the prior focal length f0 puts it, leaves a residual
of t (f - f0) pixels, and at small t nothing of the distortion. Points on opposite sides cancel in the
principal point.
"""

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap

from featuredb.errors import InvalidValueError

# COLMAP leaves points out that a single image sees.
_IMAGES = 2
# More tell no more: residuals so large are those of a reconstruction that has not settled yet.
_MAX_COPIES = 100
_SIDES = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class FocalPriorOptions:
    """How much a focal length of EXIF counts.

    Attributes:
        sigma_rel: of the focal length. 35 mm equivalents are rounded to whole millimetres (1 % at 28 mm),
            nominal focal lengths are met within 1 to 2 %.
        weight: how many times an independent residual of one sigma the prior counts, of the size that the
            residuals have with what neighbours share (`ingest.precision.shared_variance_px2`). Above one
            because a lens model's faults are common to whole photos too, which neighbours do not show: with
            50 `brighton` comes to 2325 px, where its scan says 2296. Where residuals are those
            of keypoints alone, as in simulated photos, the photos still decide.
    """

    sigma_rel: float = 0.02
    weight: float = 50.0

    def __post_init__(self) -> None:
        if not (self.sigma_rel > 0.0 and self.weight >= 0.0):
            raise InvalidValueError(f"FocalPriorOptions: value out of range in {self}")

    def of(self, focal_px: Mapping[int, float], cameras: Container[int]) -> dict[int, float]:
        """Those of the focal lengths that hold one of these cameras; none without weight."""
        return {c: focal for c, focal in sorted(focal_px.items()) if c in cameras and self.weight > 0.0}


def add_focal_priors(
    reconstruction: Any,
    config: Any,
    focal_px: Mapping[int, float],
    variance_px2: float,
    loss_scale_px: float,
    options: FocalPriorOptions,
) -> None:
    """Images and points that hold focal lengths near `focal_px`, by camera id, for a problem to be solved.

    They stay in the reconstruction: give it a copy, and take from that what was adjusted (`take_adjusted`).
    Beyond two sigmas the Cauchy loss lets go: an EXIF entry that is wrong loses to photos that know.

    Args:
        variance_px2: of `ingest.precision.shared_variance_px2`.
    """
    next_id = max(reconstruction.images, default=0) + 1
    # Of the sum of squares at one sigma no residual takes more than half the loss scale.
    most_px2, count = (0.5 * loss_scale_px) ** 2, _IMAGES * len(_SIDES)
    total_px2 = min(options.weight * variance_px2, count * _MAX_COPIES * most_px2)
    copies = max(1, math.ceil(total_px2 / (count * most_px2)))
    at_one_sigma_px = math.sqrt(total_px2 / (count * copies))
    for camera_id, focal in sorted(focal_px.items()):
        camera = reconstruction.camera(camera_id)
        angle = at_one_sigma_px / (options.sigma_rel * focal)
        middle = np.array([camera.principal_point_x, camera.principal_point_y])
        sides = np.tile(_SIDES, (copies, 1))
        ids = range(next_id, next_id + _IMAGES)
        next_id += _IMAGES
        for image_id in ids:
            image = pycolmap.Image(
                name=f"focal prior {image_id}",
                keypoints=middle + focal * angle * sides,
                camera_id=camera_id,
                image_id=image_id,
            )
            reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
            config.add_image(image_id)
            config.set_constant_rig_from_world_pose(reconstruction.image(image_id).frame_id)
        for k, (x, y) in enumerate(sides):
            track = pycolmap.Track()
            for image_id in ids:
                track.add_element(image_id, k)
            config.add_constant_point(
                reconstruction.add_point3D(np.array([angle * x, angle * y, 1.0]), track)
            )


def fix_gauge(reconstruction: Any, config: Any, image_id: int, focal_px: Mapping[int, float]) -> None:
    """Fix the gauge of a problem that nothing else fixes; to be called before `add_focal_priors`.

    COLMAP takes the priors' images, which are constant, for the gauge, and the photos would float. With
    priors the pose of the given image stays, and the scale is free.
    """
    if focal_px:
        config.set_constant_rig_from_world_pose(reconstruction.image(image_id).frame_id)
    else:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)


def take_adjusted(adjusted: Any, reconstruction: Any) -> None:
    """Poses, points and lenses of an adjusted copy into the reconstruction that it was copied from."""
    for camera_id in reconstruction.cameras:
        reconstruction.camera(camera_id).params = adjusted.camera(camera_id).params
    for frame_id in reconstruction.reg_frame_ids():
        reconstruction.frame(frame_id).rig_from_world = adjusted.frame(frame_id).rig_from_world
    for point_id in reconstruction.point3D_ids():
        reconstruction.point3D(point_id).xyz = adjusted.point3D(point_id).xyz
