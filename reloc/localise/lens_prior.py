"""What is known of a lens before a photo is looked at, its parameters, and derivatives of pixels by them."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from featuredb.adjust.terms import whole_camera
from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, freeze
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import skew
from featuredb.maps.lens_uncertainty import LensUncertainty

# An exact parameter has a sigma that no photo can tell from 0.
_EXACT = np.array([1e-6, 1e-6, 1e-6, 1e-8, 1e-8, 1e-8, 1e-8, 1e-8])
_SAME_LENS_RATE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QueryLensPrior:
    """A normal distribution over a lens's parameters, each by itself, in the order of `lens_of`.

    Attributes:
        mean, sigma: (4,) of SIMPLE_RADIAL's parameters or (8,) of OPENCV's.
        dilution: so many observations count as one against it: what lens models leave over is common to whole
            photos.
    """

    mean: FloatArray
    sigma: FloatArray
    dilution: float = 1.0

    def __post_init__(self) -> None:
        freeze(self, mean=(None,), sigma=(None,))
        if self.mean.shape not in ((4,), (8,)) or self.sigma.shape != self.mean.shape:
            raise InvalidValueError(
                f"QueryLensPrior: expected 4 or 8 means and as many sigmas, found {self.mean.shape} and "
                f"{self.sigma.shape}"
            )
        if not (np.isfinite(self.mean).all() and (self.sigma > 0).all()):
            raise InvalidValueError("QueryLensPrior: expected finite means and sigmas above 0")

    @property
    def information(self) -> FloatArray:
        """Inverse variances, against observations that count in full."""
        return np.asarray(self.dilution / self.sigma**2)


@dataclass(frozen=True, slots=True, kw_only=True)
class LensPriors:
    """Standard deviations of what is known of a lens before the photo is looked at.

    Attributes:
        exif_focal_rel: EXIF focal lengths of well-behaved cameras are within 1 to 3 %, by rounding of the
            35 mm equivalent mostly; wide, because cropped pictures and video-like modes miss by tens of
            percent, and one photo alone has to get away from that.
        unknown_focal_rel: without EXIF: a factor of two either way.
        radial: k1 of consumer lenses is within a few hundredths, phones' wide lenses up to 0.1.
        center_rel: principal points of consumer cameras lie within 1 % of the longer side of the middle.
        cut_out_rel: of a picture cut out of a larger one. The middle of that is anywhere in a picture of half
            its size: uniform, 0.5 / sqrt(3). Its focal length is not known either: EXIF's is that of the
            whole.
        whole_lens: OPENCV's parameters are estimated, and not SIMPLE_RADIAL's alone. What a lens has beyond
            one radial coefficient leaves a pattern that passes for another focal length, and the covariance
            knows nothing of it: photos of a drone's lens had errors of 0.39 m at the median and 3.2 m at
            most, their squared normalised errors a mean of 66 where 3 is right; with whole lenses 0.17 m,
            0.6 m and 4.4.
        second_radial, tangential, aspect: k2; p1 and p2; the second focal length over the first, less one.
    """

    exif_focal_rel: float = 0.15
    unknown_focal_rel: float = 0.7
    radial: float = 0.04
    center_rel: float = 0.01
    cut_out_rel: float = 0.29
    whole_lens: bool = True
    second_radial: float = 0.04
    tangential: float = 0.001
    aspect: float = 0.001

    def of_source(self, camera: Camera, source: str) -> QueryLensPrior | None:
        """What is known of a lens whose focal length is EXIF's, or a guess; None: it is told otherwise."""
        rel = {"exif": self.exif_focal_rel, "estimated": self.unknown_focal_rel}.get(source)
        return None if rel is None else self.around(camera, camera.focal_px, rel)

    def of_part(self, camera: Camera, *, distorts: bool) -> QueryLensPrior:
        """What is known of the lens of a picture that was cut out of a larger one, zoomed, or put into one.

        Args:
            distorts: how much is not known either; otherwise it is as the camera has it.
        """
        wide = replace(self, center_rel=self.cut_out_rel)
        prior = wide.around(camera, camera.focal_px, self.unknown_focal_rel)
        if distorts:
            return prior
        mean = lens_of(camera)
        return replace(prior, mean=mean, sigma=np.append(prior.sigma[:3], _EXACT[3 : len(mean)]))

    def around(self, camera: Camera, focal_px: float, focal_rel: float) -> QueryLensPrior:
        """What is known of a lens of pictures of this camera's size, whose focal length is about this."""
        longer, count = max(camera.width, camera.height), 8 if self.whole_lens else 4
        mean = [focal_px, camera.width / 2, camera.height / 2, 0.0, 0.0, 0.0, 0.0, 0.0]
        center, tangential = [self.center_rel * longer] * 2, [self.tangential] * 2
        sigma = [focal_rel * focal_px, *center, self.radial, self.aspect, self.second_radial, *tangential]
        return QueryLensPrior(mean=np.array(mean[:count]), sigma=np.array(sigma[:count]))


def known_within(camera: Camera, sigmas: FloatArray) -> QueryLensPrior:
    """What is known of a calibrated lens.

    Args:
        camera: OPENCV or SIMPLE_RADIAL. sigmas: one standard deviation of each of its parameters, in their
            order.

    Raises:
        InvalidValueError: the camera is of another model, or there are not as many sigmas.
    """
    mean = lens_of(camera)
    if sigmas.shape != mean.shape:
        raise InvalidValueError(
            f"known_within: expected {len(mean)} sigmas of {camera.model}'s parameters, found {sigmas.shape}"
        )
    sigma = sigmas
    if len(mean) == 8:
        fx, fy, cx, cy, k1, k2, p1, p2 = sigmas
        # Pixels are square but for a thousandth, and both focal lengths are off together.
        aspect = min(float(np.hypot(fx, fy)) / mean[0], LensPriors().aspect)
        sigma = np.array([fx, cx, cy, k1, aspect, k2, p1, p2])
    return QueryLensPrior(mean=mean, sigma=np.maximum(sigma, _EXACT[: len(mean)]))


def seen_by_a_map(camera: Camera, lenses: LensUncertainty) -> tuple[Camera, QueryLensPrior] | None:
    """An exactly known lens as photos of a map show it, whose points are bent by its own lenses' errors.

    Returns:
        The same lens as OPENCV, and its prior; None for lenses that are no OPENCV.
    """
    whole = whole_camera(camera)
    if whole.model != "OPENCV":
        return None
    longer, fx = max(camera.width, camera.height), whole.params[0]
    center_px, (k1, k2) = (longer * share for share in lenses.center_rel), lenses.radial
    sigma = np.array([lenses.focal_rel * fx, *center_px, k1, lenses.aspect, k2, *lenses.tangential])
    return whole, QueryLensPrior(
        mean=lens_of(whole), sigma=np.maximum(sigma, _EXACT), dilution=lenses.dilution
    )


def is_lens_of_a_map(camera: Camera, of_map: Camera, lenses: LensUncertainty) -> bool:
    """Whether an exactly known lens may be the one that the map has estimated from photos of the same camera.

    Each parameter is tested by itself, at a rate of error of 0.1 % together (Bonferroni: they correlate).
    """
    own = whole_camera(of_map)
    seen = seen_by_a_map(camera, lenses)
    if seen is None or own.model != "OPENCV" or (own.width, own.height) != (camera.width, camera.height):
        return False
    off = (lens_of(own) - seen[1].mean) / seen[1].sigma
    return bool(np.abs(off).max() <= -ndtri(0.5 * _SAME_LENS_RATE / len(off)))


def lens_for(camera: Camera, width: int, height: int) -> Camera | None:
    """The lens for another size of its pictures; None where that is of another shape."""
    try:
        return camera.scaled_to(width, height)
    except InvalidValueError:
        return None


def lens_of(camera: Camera) -> FloatArray:
    """Parameters of a lens, (4,) of SIMPLE_RADIAL or (8,) of OPENCV: f, cx, cy, k1, aspect, k2, p1, p2.

    Raises:
        InvalidValueError: the camera is of another model.
    """
    if camera.model == "SIMPLE_RADIAL":
        return np.asarray(camera.params)
    if camera.model == "OPENCV":
        fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
        return np.array([fx, cx, cy, k1, fy / fx - 1.0, k2, p1, p2])
    raise InvalidValueError(
        f"expected the parameters of a SIMPLE_RADIAL or an OPENCV lens, found {camera.model}'s"
    )


def opencv_by_lens(lens: FloatArray) -> FloatArray:
    """(8, 8) derivatives of OPENCV's parameters by those of `lens_of` (8,)."""
    derivatives = np.zeros((8, 8))
    derivatives[[0, 2, 3, 4, 5, 6, 7], [0, 1, 2, 3, 5, 6, 7]] = 1.0
    derivatives[1, [0, 4]] = 1.0 + lens[4], lens[0]
    return derivatives


def whole_lens(lens: FloatArray) -> FloatArray:
    """(8,) with what a SIMPLE_RADIAL lens has not."""
    return np.concatenate([lens, np.zeros(8 - len(lens))])


def with_lens(camera: Camera, lens: FloatArray) -> Camera:
    """A camera of the same pictures with these parameters, in the order of `lens_of`."""
    if len(lens) == 4:
        return replace(camera, model="SIMPLE_RADIAL", params=tuple(lens))
    f, cx, cy, k1, aspect, k2, p1, p2 = lens
    return replace(camera, model="OPENCV", params=(f, f * (1.0 + aspect), cx, cy, k1, k2, p1, p2))


def pixel_jacobians(
    camera: Camera, cam_from_local: Rigid3, points: FloatArray, *, lens: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the pixels of points (k, 3), in front of the camera.

    Returns:
        By the points (k, 2, 3), and by the pose (k, 2, 6): a small rotation of the camera about the local
        axes (rad), then a displacement of its centre (m): R_true = R(dtheta) R, C_true = C + dC for
        local_from_cam = (R, C). With `lens` by its parameters, too, (k, 2, 6 + n), n as in `lens_of`.
    """
    in_camera = cam_from_local.act(points)
    if lens:
        by_camera, by_lens = lens_jacobians(camera, in_camera)
    else:
        by_camera, by_lens = camera.projection_jacobian(in_camera), np.zeros((len(points), 2, 0))
    by_point = by_camera @ cam_from_local.rotation
    by_turn = by_point @ skew(points - cam_from_local.center)
    return by_point, np.concatenate([by_turn, -by_point, by_lens], axis=2)


def lens_jacobians(camera: Camera, in_camera: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of pixels by points (k, 2, 3) in camera axes, and by the lens (k, 2, n), n as in `lens_of`.

    In closed form: pixel = (f, f (1 + aspect)) d(u, v) + c with (u, v) = (x, y) / z and Brown's distortion d.
    """
    lens = lens_of(camera)
    focal, _, _, k1, aspect, k2, p1, p2 = whole_lens(lens)
    depth = in_camera[:, 2]
    uv = in_camera[:, :2] / depth[:, None]
    u, v = uv.T
    squared = u * u + v * v
    stretch, slope = 1.0 + (k1 + k2 * squared) * squared, 2.0 * (k1 + 2.0 * k2 * squared)
    scale = focal * np.array([1.0, 1.0 + aspect])
    first = np.stack([2.0 * u * v, squared + 2.0 * v * v], axis=1)  # by p1
    second = np.stack([squared + 2.0 * u * u, 2.0 * u * v], axis=1)  # by p2
    bent = stretch[:, None] * uv + p1 * first + p2 * second
    across = slope * u * v + 2.0 * (p1 * u + p2 * v)
    along_u = stretch + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    along_v = stretch + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v
    by_uv = scale[:, None] * np.stack([along_u, across, across, along_v], axis=1).reshape(-1, 2, 2)
    by_camera = np.concatenate([by_uv, -by_uv @ uv[:, :, None]], axis=2) / depth[:, None, None]
    by_lens = [
        bent * [1.0, 1.0 + aspect],
        np.tile([1.0, 0.0], (len(in_camera), 1)),
        np.tile([0.0, 1.0], (len(in_camera), 1)),
        scale * squared[:, None] * uv,
        focal * bent * [0.0, 1.0],
        scale * (squared**2)[:, None] * uv,
        scale * first,
        scale * second,
    ]
    return by_camera, np.stack(by_lens[: len(lens)], axis=2)
