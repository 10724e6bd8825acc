"""Rigid transforms of space, with the covariance of their left perturbation."""

from dataclasses import dataclass
from math import hypot, sin
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.rotation import (
    is_rotation,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotation_angle,
    so3_exp,
    so3_log,
)

_SMALL_ANGLE = 1e-6  # below this the series' next term is under float64's resolution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rigid3:
    """x_target = rotation @ x_source + translation; name instances `target_from_source`.

    The tangent vector is (omega, nu): rotation in radians before translation in metres. A covariance
    that belongs to a Rigid3 is that of its left perturbation: T_true = exp(xi) T, xi ~ N(0, cov), with
    axes of the target frame.

    Attributes:
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64, metres (or the unit of the target frame).
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        rotation = frozen_array("Rigid3.rotation", self.rotation, (3, 3))
        if not is_rotation(rotation, 1e-6):
            raise InvalidValueError(
                "Rigid3.rotation: expected an orthonormal matrix with determinant +1, "
                f"found {rotation.tolist()}; use nearest_rotation() to clean up a noisy one"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", frozen_array("Rigid3.translation", self.translation, (3,)))

    @classmethod
    def identity(cls) -> Self:
        return cls(rotation=np.eye(3), translation=np.zeros(3))

    @classmethod
    def from_center(cls, rotation: FloatArray, center: FloatArray) -> Self:
        """The pose of a camera with this rotation (3, 3) and this centre (3,) in the source frame."""
        return cls(rotation=rotation, translation=-rotation @ center)

    @classmethod
    def from_quaternion(cls, xyzw: ArrayLike, translation: ArrayLike) -> Self:
        """From a Hamilton quaternion (x, y, z, w) and a translation (3,)."""
        return cls(
            rotation=matrix_from_quaternion(xyzw), translation=np.asarray(translation, dtype=np.float64)
        )

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Self:
        """From a (3, 4) or (4, 4) matrix [R | t].

        Raises:
            InvalidValueError: another shape, a last row other than 0 0 0 1, or no rotation in it.
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((3, 4), (4, 4)) or (
            len(m) == 4 and not np.array_equal(m[3], (0.0, 0.0, 0.0, 1.0))
        ):
            raise InvalidValueError(
                f"Rigid3.from_matrix: expected (3, 4), or (4, 4) with last row 0 0 0 1, found {m.tolist()}"
            )
        return cls(rotation=m[:3, :3], translation=m[:3, 3])

    @classmethod
    def exp(cls, tangent: ArrayLike) -> Self:
        """Exponential of se(3), tangent (6,) = (omega, nu). Barfoot, State Estimation for Robotics, 7.1.3."""
        xi = frozen_array("Rigid3.exp tangent", tangent, (6,))
        return cls(rotation=so3_exp(xi[:3]), translation=_left_jacobian(xi[:3]) @ xi[3:])

    def log(self) -> FloatArray:
        """Inverse of `exp`: (6,) = (omega, nu), |omega| <= pi."""
        omega = so3_log(self.rotation)
        return np.concatenate([omega, np.linalg.solve(_left_jacobian(omega), self.translation)])

    def __matmul__(self, other: "Rigid3") -> "Rigid3":
        """c_from_b @ b_from_a = c_from_a."""
        return Rigid3(
            rotation=self.rotation @ other.rotation,
            translation=self.rotation @ other.translation + self.translation,
        )

    def inverse(self) -> "Rigid3":
        return Rigid3(rotation=self.rotation.T, translation=-self.rotation.T @ self.translation)

    def act(self, points: ArrayLike) -> FloatArray:
        """Transform points (..., 3) of the source frame into the target frame, (..., 3) float64."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    @property
    def quaternion_xyzw(self) -> FloatArray:
        """Hamilton quaternion (x, y, z, w), w >= 0."""
        return quaternion_from_matrix(self.rotation)

    @property
    def center(self) -> FloatArray:
        """Origin of the target frame in the source frame, (3,): for cam_from_world the camera centre."""
        return -self.rotation.T @ self.translation

    def matrix(self) -> FloatArray:
        """(4, 4) homogeneous matrix."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m

    def angle_to_deg(self, other: "Rigid3") -> float:
        """Angle in degrees between the two rotations."""
        return float(np.degrees(rotation_angle(self.rotation @ other.rotation.T)))


def _left_jacobian(omega: FloatArray) -> FloatArray:
    """Left Jacobian of SO(3): V with exp(omega, nu) = (exp(omega), V nu).

    It is 1 + a k + b k k, with k the matrix of the cross product, in plain floats, which are faster.
    """
    x, y, z = omega.tolist()
    theta = hypot(x, y, z)
    if theta < _SMALL_ANGLE:
        a, b = 0.5, 1.0 / 6.0
    else:
        a = 0.5 * (sin(0.5 * theta) / (0.5 * theta)) ** 2  # (1 - cos) / theta^2 without its cancellation
        b = (theta - sin(theta)) / theta**3
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    ax, ay, az = a * x, a * y, a * z
    return np.array(
        [
            [1.0 - b * (y * y + z * z), xy - az, xz + ay],
            [xy + az, 1.0 - b * (x * x + z * z), yz - ax],
            [xz - ay, yz + ax, 1.0 - b * (x * x + y * y)],
        ]
    )
