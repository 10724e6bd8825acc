"""A photogrammetric block as plain arrays; what is known beside its observations: terms of an adjustment."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    """Photos, points and observations in one frame, "block", of any scale and orientation.

    Attributes:
        names: of the k photos.
        cameras: intrinsics; camera_of: (k,) index into them.
        cam_from_block: k poses.
        xyz: (n, 3) points.
        point_of, photo_of: (m,) int64, what each observation sees, and in which photo.
        xy: (m, 2) full-size pixels.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera_of: NDArray[np.int64]
    cam_from_block: tuple[Rigid3, ...]
    xyz: FloatArray
    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    xy: FloatArray

    def camera(self, photo: int) -> Camera:
        """Intrinsics of a photo."""
        return self.cameras[int(self.camera_of[photo])]

    def centers(self) -> FloatArray:
        """Camera centres (k, 3)."""
        return np.array([pose.center for pose in self.cam_from_block]).reshape(-1, 3)

    def distances(self) -> FloatArray:
        """Median distance (k,) of the points that each photo sees from its camera; 1 where it sees none."""
        away = np.linalg.norm(self.xyz[self.point_of] - self.centers()[self.photo_of], axis=1)
        seen = [away[self.photo_of == k] for k in range(len(self.names))]
        return np.array([float(np.median(distances)) if len(distances) else 1.0 for distances in seen])

    def moved(self, target_from_block: Sim3) -> "Block":
        """The same block in another frame."""
        return replace(
            self,
            cam_from_block=tuple(target_from_block.act_on_pose(pose) for pose in self.cam_from_block),
            xyz=target_from_block.act(self.xyz),
        )


def whole_lens(block: Block) -> Block:
    """The block with radial cameras as the same lenses with two focal lengths and tangential terms.

    Fisheye lenses and those that have all of it stay.
    """
    return replace(block, cameras=tuple(whole_camera(camera) for camera in block.cameras))


def whole_camera(camera: Camera) -> Camera:
    """A radial lens with two focal lengths and tangential terms; others stay."""
    lens = camera.params
    if camera.model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        focal, (cx, cy), radial = lens[0], lens[1:3], (*lens[3:], 0.0, 0.0)[:2]
        return replace(camera, model="OPENCV", params=(focal, focal, cx, cy, *radial, 0.0, 0.0))
    if camera.model == "PINHOLE":
        return replace(camera, model="OPENCV", params=(*lens, 0.0, 0.0, 0.0, 0.0))
    return camera


@dataclass(frozen=True, slots=True, kw_only=True)
class LensWidths:
    """Standard deviations of a lens around what is known of it.

    Attributes:
        focal_rel: of the focal length, relative.
        aspect_rel: of the ratio of two focal lengths.
        center_rel: of the principal point, as a share of the longer side.
        radial: of the first radial coefficient; higher ones are as wide.
        tangential: of a tangential coefficient.
    """

    focal_rel: float
    aspect_rel: float
    center_rel: float
    radial: float
    tangential: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LensPrior:
    """A lens as it is known beforehand.

    Attributes:
        mean: expected intrinsics, of the block's model and size.
        covariance: (p, p) of its parameters.
        robust: what was said of the lens may be wrong altogether, as EXIF of a cropped photo is.
    """

    mean: Camera
    covariance: FloatArray
    robust: bool = True


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marks:
    """Points of known position that photos show, such as a scan's: they stay where they are.

    Attributes:
        xyz: (c, 3) in the block's frame. photo_of: (c,) the block's photo. xy: (c, 2) full-size pixels.
        sigma_px: of a pixel coordinate, of all or (c,).
    """

    xyz: FloatArray
    photo_of: NDArray[np.int64]
    xy: FloatArray
    sigma_px: float | FloatArray = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointPriors:
    """Where points of the block are expected.

    Attributes:
        point_of: (c,) rows of the block's points. xyz: (c, 3). covariance: (c, 3, 3).
    """

    point_of: NDArray[np.int64]
    xyz: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CenterPriors:
    """Measured positions of cameras.

    Attributes:
        photo_of: (c,) rows of the block's photos. xyz: (c, 3) in the block's frame. covariance: (c, 3, 3).
    """

    photo_of: NDArray[np.int64]
    xyz: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Orientations:
    """Measured or assumed orientations of cameras.

    Attributes:
        photo_of: (c,) rows of the block's photos. cam_from_block: (c, 3, 3) rotations.
        covariance: (c, 3, 3) square radians, of a turn about the block's axes; wide about an axis of which
            nothing is known.
    """

    photo_of: NDArray[np.int64]
    cam_from_block: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Targets:
    """Points of the block that people marked in photos, and where a survey has them.

    They keep a quadratic loss: tests on their residuals find the wrong ones (`Problem.target_marginals`).

    Attributes:
        point_of, photo_of: (c,) what each mark shows, and in which photo. xy: (c, 2) full-size pixels.
        sigma_px: of a pixel coordinate.
        survey: of points, marked ones and others.
    """

    point_of: NDArray[np.int64]
    photo_of: NDArray[np.int64]
    xy: FloatArray
    sigma_px: float
    survey: PointPriors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Terms:
    """All that an adjustment is made of beside the block.

    Everything but targets and lenses that are known for certain counts with a Cauchy loss on its whitened
    residual, of one sigma, for lenses of two.

    Attributes:
        keypoint_px: standard deviation of a keypoint's coordinate.
        dilution: so many observations count as one against priors of lenses and centres: what a lens model
            leaves over is common to whole photos.
        lenses: prior of each camera; a camera without one is held.
        marks, points, centers, orientations, targets: see there.
        held_photos: rows of photos whose poses stay.
    """

    keypoint_px: float
    lenses: tuple[LensPrior | None, ...]
    dilution: float = 1.0
    marks: Marks | None = None
    points: PointPriors | None = None
    centers: CenterPriors | None = None
    orientations: Orientations | None = None
    targets: Targets | None = None
    held_photos: tuple[int, ...] = field(default=())


def lens_prior(mean: Camera, widths: LensWidths, *, robust: bool = True) -> LensPrior:
    """The prior of a lens of any model."""
    template = mean.to_pycolmap()
    names = [name.strip() for name in template.params_info.split(",")]
    sigma = np.zeros(len(names))
    for k, name in enumerate(names):
        if k in template.focal_length_idxs():
            sigma[k] = widths.aspect_rel * mean.focal_px
        elif k in template.principal_point_idxs():
            sigma[k] = widths.center_rel * max(mean.width, mean.height)
        else:
            sigma[k] = widths.tangential if name.startswith("p") else widths.radial
    covariance = np.diag(sigma**2)
    focal = list(template.focal_length_idxs())
    if len(focal) == 1:
        covariance[focal[0], focal[0]] = 0.0
    covariance[np.ix_(focal, focal)] += (widths.focal_rel * mean.focal_px) ** 2
    return LensPrior(mean=mean, covariance=covariance, robust=robust)


def surface_priors(xyz: FloatArray, offset: FloatArray, normals: FloatArray, sigma_m: float) -> PointPriors:
    """Points on the planes next to them: tight along the normal, loose across it.

    Args:
        xyz: (n, 3) the block's points. offset: (n,) their signed distances from the planes, NaN for none.
        normals: (n, 3) unit.
    """
    near = np.flatnonzero(np.isfinite(offset))
    normal = normals[near]
    along = normal[:, :, None] * normal[:, None, :]
    across = np.eye(3) - along
    return PointPriors(
        point_of=near,
        xyz=xyz[near] - offset[near, None] * normal,
        covariance=sigma_m**2 * (along + _LOOSE**2 * across),
    )


_LOOSE = 1e4  # times the sigma along the normal
