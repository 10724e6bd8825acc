"""Similarity transforms of space: the group in which a feature map is placed on Earth."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import nearest_rotation, skew, so3_exp, so3_log

_SMALL_ANGLE = 1e-8  # below this the square of the angle is under float64's resolution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sim3:
    """x_target = scale * rotation @ x_source + translation; name instances `target_from_source`.

    The tangent vector is (sigma, omega, nu), in the order of the structure-projection paper (eq. 8):
    log of scale, rotation in radians, translation. A covariance that belongs to a Sim3 is the (7, 7) of
    its left perturbation: S_true = exp(xi) S, axes of the target frame.

    Attributes:
        scale: target units per source unit, > 0.
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, unit of the target frame.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise InvalidValueError(f"Sim3.scale: expected a finite number > 0, found {self.scale!r}")
        rigid = Rigid3(rotation=self.rotation, translation=self.translation)
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rigid.rotation)
        object.__setattr__(self, "translation", rigid.translation)

    @classmethod
    def identity(cls) -> Self:
        return cls(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))

    @classmethod
    def shift(cls, translation: FloatArray) -> Self:
        """A move by (3,) without turn."""
        return cls(scale=1.0, rotation=np.eye(3), translation=translation)

    @classmethod
    def from_rigid3(cls, rigid: Rigid3) -> Self:
        return cls(scale=1.0, rotation=rigid.rotation, translation=rigid.translation)

    @classmethod
    def exp(cls, tangent: ArrayLike) -> Self:
        """Exponential of sim(3), tangent (7,) = (sigma, omega, nu).

        The exact closed form (Strasdat, Local Accuracy and Global Consistency for Efficient Visual SLAM,
        2012, A.3). The structure-projection paper's eq. 9 multiplies Rodrigues' formula by e^sigma, which
        is the exponential only for sigma = 0 or omega = 0 to first order; tests compare this one with
        `scipy.linalg.expm`.
        """
        xi = frozen_array("Sim3.exp tangent", tangent, (7,))
        sigma, omega, nu = float(xi[0]), xi[1:4], xi[4:]
        return cls(
            scale=float(np.exp(sigma)),
            rotation=so3_exp(omega),
            translation=_translation_factor(sigma, omega) @ nu,
        )

    def log(self) -> FloatArray:
        """Inverse of `exp`: (7,) = (sigma, omega, nu), |omega| <= pi."""
        sigma, omega = float(np.log(self.scale)), so3_log(self.rotation)
        nu = np.linalg.solve(_translation_factor(sigma, omega), self.translation)
        return np.concatenate([[sigma], omega, nu])

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """c_from_b @ b_from_a = c_from_a."""
        return Sim3(
            scale=self.scale * other.scale,
            rotation=self.rotation @ other.rotation,
            translation=self.scale * self.rotation @ other.translation + self.translation,
        )

    def about(self, middle: FloatArray) -> "Sim3":
        """The same change about a place (3,) in the origin's stead."""
        shift = Sim3.shift(middle)
        return shift @ self @ shift.inverse()

    def inverse(self) -> "Sim3":
        inverse_scale = 1.0 / self.scale
        return Sim3(
            scale=inverse_scale,
            rotation=self.rotation.T,
            translation=-inverse_scale * self.rotation.T @ self.translation,
        )

    def act(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) of the source frame into the target frame, (..., 3) float64."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation

    def act_on_pose(self, cam_from_source: Rigid3) -> Rigid3:
        """The camera pose cam_from_target of a camera given as cam_from_source.

        The camera keeps its own metric: its centre moves with the similarity, its axes turn with it, and
        its frame takes the target's unit.
        """
        rotation = cam_from_source.rotation @ self.rotation.T
        return Rigid3(rotation=rotation, translation=-rotation @ self.act(cam_from_source.center))

    def adjoint(self) -> FloatArray:
        """(7, 7) matrix with S exp(xi) = exp(Ad xi) S for xi = (sigma, omega, nu)."""
        ad = np.zeros((7, 7))
        ad[0, 0] = 1.0
        ad[1:4, 1:4] = self.rotation
        ad[4:, 0] = -self.translation
        ad[4:, 1:4] = skew(self.translation) @ self.rotation
        ad[4:, 4:] = self.scale * self.rotation
        return ad

    def carried(self, covariance: ArrayLike) -> FloatArray:
        """Covariance (7, 7) of `self @ other` for that of `other`, to first order."""
        ad = self.adjoint()
        result = ad @ np.asarray(covariance, dtype=np.float64) @ ad.T
        return np.asarray(0.5 * (result + result.T))

    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous matrix [sR t; 0 1]."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.scale * self.rotation, self.translation
        return m


def point_jacobian(points_target: ArrayLike) -> FloatArray:
    """Derivative (..., 3, 7) of exp(xi) x at xi = 0 for points x (..., 3) already in the target frame."""
    points = np.asarray(points_target, dtype=np.float64)
    jacobian = np.zeros((*points.shape[:-1], 3, 7))
    jacobian[..., :, 0] = points
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    jacobian[..., 0, 2], jacobian[..., 0, 3] = z, -y
    jacobian[..., 1, 1], jacobian[..., 1, 3] = -z, x
    jacobian[..., 2, 1], jacobian[..., 2, 2] = y, -x
    jacobian[..., :, 4:] = np.eye(3)
    return jacobian


def place_covariance(covariance: FloatArray, place: ArrayLike) -> FloatArray:
    """(3, 3) of a place (3,) in the target frame, by that (7, 7) of the similarity that put it there."""
    jacobian = point_jacobian(place)
    return np.asarray(jacobian @ covariance @ jacobian.T)


def turns_about(middle: FloatArray) -> FloatArray:
    """(7, 3) left perturbations of rotations about a place."""
    return np.vstack([np.zeros((1, 3)), np.eye(3), skew(middle)])


def left_jacobian(tangent: FloatArray) -> FloatArray:
    """J (7, 7) with exp(x + dx) = exp(J dx) exp(x) to first order.

    The integral over t in [0, 1] of exp(t ad), with ad the derivative of `Sim3.adjoint`: the corner of one
    matrix exponential (Van Loan 1978).
    """
    from scipy.linalg import expm  # slow to import, and commands that list maps come by here

    sigma, omega, nu = float(tangent[0]), tangent[1:4], tangent[4:]
    both = np.zeros((14, 14))
    both[1:4, 1:4] = skew(omega)
    both[4:7, 0] = -nu
    both[4:7, 1:4] = skew(nu)
    both[4:7, 4:7] = sigma * np.eye(3) + skew(omega)
    both[:7, 7:] = np.eye(7)
    return np.asarray(expm(both)[:7, 7:], dtype=np.float64)


def _translation_factor(sigma: float, omega: FloatArray) -> FloatArray:
    """W = integral over t in [0, 1] of exp(t sigma) exp(t [omega]x), so that exp's translation is W nu.

    [omega]x has the eigenvalues 0 and +-i theta, so W is a polynomial in it whose coefficients come from
    phi(z) = (e^z - 1) / z, the integral of e^(tz), at sigma and at sigma + i theta. Only phi has to be
    computed without cancellation, which complex expm1 does.
    """
    theta = float(np.linalg.norm(omega))
    k = skew(omega)
    real = _phi(complex(sigma, 0.0)).real
    if theta < _SMALL_ANGLE:
        # The term of first order: integral of t e^(t sigma), by its series where the closed form cancels.
        first = 0.5 + sigma / 3 if abs(sigma) < 1e-4 else (np.exp(sigma) * (sigma - 1) + 1) / sigma**2
        return np.asarray(real * np.eye(3) + first * k, dtype=np.float64)
    phi = _phi(complex(sigma, theta))
    return np.asarray(
        real * np.eye(3) + phi.imag / theta * k + (real - phi.real) / theta**2 * (k @ k), dtype=np.float64
    )


def _phi(z: complex) -> complex:
    """(e^z - 1) / z, 1 at z = 0."""
    return complex(np.expm1(z)) / z if z != 0 else 1.0 + 0.0j


def similarity_closed_form(source: FloatArray, target: FloatArray) -> Sim3 | None:
    """Least-squares similarity target = S source, both (n, 3) (Umeyama 1991); None if points coincide."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    variance = float((a**2).sum())
    cross = b.T @ a
    if variance < 1e-18 or float((b**2).sum()) < 1e-12:
        return None
    rotation = nearest_rotation(cross)
    scale = float(np.trace(rotation.T @ cross)) / variance
    if scale <= 0:
        return None
    return Sim3(scale=scale, rotation=rotation, translation=target_mean - scale * rotation @ source_mean)
