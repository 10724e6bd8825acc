"""Rotations: SO(3) exponential and logarithm, Hamilton quaternions in xyzw order."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, frozen_array

_SHORTEST_QUATERNION = 1e-6  # a shorter one is an unset field, not a rotation


def skew(vectors: ArrayLike) -> FloatArray:
    """The matrices [v]x with [v]x w = v x w. vectors (..., 3) -> (..., 3, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    x, y, z = np.moveaxis(v, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*v.shape, 3)


def rotation_to_up(up: FloatArray) -> FloatArray:
    """A rotation (3, 3) that carries the unit vector `up` to (0, 0, 1)."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(helper, up)
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(up, east), up])


def so3_exp(omega: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of the axis-angle vector omega (3,), radians."""
    matrix: FloatArray = Rotation.from_rotvec(np.array(omega, dtype=np.float64)).as_matrix()
    return matrix


def so3_log(rotation: ArrayLike) -> FloatArray:
    """Axis-angle vector (3,) in radians, length in [0, pi], of a rotation matrix (3, 3)."""
    vector: FloatArray = Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_rotvec()
    return vector


def matrix_from_quaternion(xyzw: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of a Hamilton quaternion (x, y, z, w); the norm is taken out.

    Raises:
        InvalidValueError: not four finite numbers, or all of them zero.
    """
    quaternion = frozen_array("quaternion", xyzw, (4,))
    if np.linalg.norm(quaternion) < _SHORTEST_QUATERNION:
        raise InvalidValueError(f"quaternion: expected a length > 0, found {quaternion.tolist()}")
    matrix: FloatArray = Rotation.from_quat(quaternion).as_matrix()
    return matrix


def quaternion_from_matrix(rotation: ArrayLike) -> FloatArray:
    """Hamilton quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3)."""
    quaternion: FloatArray = Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_quat(
        canonical=True
    )
    return quaternion


def rotation_angle(rotation: ArrayLike) -> float:
    """Angle in radians, [0, pi], of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(so3_log(rotation)))


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """The rotation (3, 3) nearest to a 3x3 matrix in the Frobenius norm (orthogonal Procrustes).

    Raises:
        InvalidValueError: wrong shape or not finite.
    """
    u, _, vt = np.linalg.svd(frozen_array("nearest_rotation", matrix, (3, 3)))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)
