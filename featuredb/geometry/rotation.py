"""Rotations: SO(3) exponential and logarithm, Hamilton quaternions in xyzw order.

In plain floats: of nine numbers that is several times as fast as arrays are, and needs no SciPy, whose import
takes longer than most commands.
"""

from math import asin, atan2, cos, hypot, radians, sin

import numpy as np
from numpy.typing import ArrayLike

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray, frozen_array

_SHORTEST_QUATERNION = 1e-6  # a shorter one is an unset field, not a rotation
_SMALL_ANGLE = 1e-3  # radians; below it the series' next term is under float64's resolution
_NOT_ORTHONORMAL = 1e-12  # what products of some rotations reach by rounding is left as it is
# Closer to the vertical than this, the heading of a camera says less than that of its image's top.
_VERTICAL_SINE = cos(radians(0.1))
_IDENTITY = np.eye(3)


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
    x, y, z = np.asarray(omega, dtype=np.float64).tolist()
    angle = hypot(x, y, z)
    if angle < _SMALL_ANGLE:
        scale = 0.5 - angle**2 / 48.0 + angle**4 / 3840.0
    else:
        scale = sin(0.5 * angle) / angle
    return _matrix_of_unit(scale * x, scale * y, scale * z, cos(0.5 * angle))


def so3_log(rotation: ArrayLike) -> FloatArray:
    """Axis-angle vector (3,) in radians, length in [0, pi], of a rotation matrix (3, 3).

    Raises:
        InvalidValueError: the determinant is not positive.
    """
    x, y, z, w = _unit_of_matrix(rotation)
    sine = hypot(x, y, z)
    angle = 2.0 * atan2(sine, w)
    small = angle < _SMALL_ANGLE
    scale = 2.0 + angle**2 / 12.0 + 7.0 * angle**4 / 2880.0 if small else angle / sine
    return np.array([scale * x, scale * y, scale * z])


def matrix_from_quaternion(xyzw: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of a Hamilton quaternion (x, y, z, w); the norm is taken out.

    Raises:
        InvalidValueError: not four finite numbers, or all of them zero.
    """
    x, y, z, w = frozen_array("quaternion", xyzw, (4,)).tolist()
    length = hypot(x, y, z, w)
    if length < _SHORTEST_QUATERNION:
        raise InvalidValueError(f"quaternion: expected a length > 0, found {[x, y, z, w]}")
    return _matrix_of_unit(x / length, y / length, z / length, w / length)


def quaternion_from_matrix(rotation: ArrayLike) -> FloatArray:
    """Hamilton quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3).

    Of a half turn, w = 0, the first of x, y, z that is not zero is positive.

    Raises:
        InvalidValueError: the determinant is not positive.
    """
    return np.array(_unit_of_matrix(rotation))


def rotation_angle(rotation: ArrayLike) -> float:
    """Angle in radians, [0, pi], of a rotation matrix (3, 3)."""
    x, y, z, w = _unit_of_matrix(rotation)
    return 2.0 * atan2(hypot(x, y, z), w)


def yaw_pitch_roll(rotation: ArrayLike) -> tuple[float, float, float]:
    """Angles in rad of Rz(yaw) Ry(pitch) Rx(roll) (3, 3).

    Within 0.1 degrees of a pitch of 90 yaw and roll turn about the same axis: roll is 0 there.
    """
    m = np.asarray(rotation)
    pitch = asin(float(np.clip(-m[2, 0], -1.0, 1.0)))
    if abs(m[2, 0]) > _VERTICAL_SINE:
        return atan2(-m[0, 1], m[1, 1]), pitch, 0.0
    return atan2(m[1, 0], m[0, 0]), pitch, atan2(m[2, 1], m[2, 2])


def determinant(matrix: FloatArray) -> float:
    """Of a matrix (3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def is_rotation(matrix: FloatArray, tolerance: float) -> bool:
    """Whether a matrix (3, 3) times its transpose is the identity to this tolerance, with determinant +1."""
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return (
        abs(a * a + b * b + c * c - 1.0) <= tolerance
        and abs(d * d + e * e + f * f - 1.0) <= tolerance
        and abs(g * g + h * h + i * i - 1.0) <= tolerance
        and abs(a * d + b * e + c * f) <= tolerance
        and abs(a * g + b * h + c * i) <= tolerance
        and abs(d * g + e * h + f * i) <= tolerance
        and determinant(matrix) >= 0.0
    )


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """The rotation (3, 3) nearest to a 3x3 matrix in the Frobenius norm (orthogonal Procrustes).

    Raises:
        InvalidValueError: wrong shape or not finite.
    """
    u, _, vt = np.linalg.svd(frozen_array("nearest_rotation", matrix, (3, 3)))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def _matrix_of_unit(x: float, y: float, z: float, w: float) -> FloatArray:
    """Of a quaternion of length 1."""
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    return np.array(
        [
            [xx - yy - zz + ww, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), -xx + yy - zz + ww, 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -xx - yy + zz + ww],
        ]
    )


def _unit_of_matrix(rotation: ArrayLike) -> tuple[float, float, float, float]:
    """Quaternion (x, y, z, w) of length 1, w >= 0, of the rotation nearest to a matrix that is almost one.

    From the largest of the four: Shepperd, Quaternion from rotation matrix, J. Guidance and Control, 1978.
    """
    matrix = np.asarray(rotation, dtype=np.float64)
    if not determinant(matrix) > 0.0:
        raise InvalidValueError(f"expected a rotation matrix, found {matrix.tolist()}")
    if np.abs(matrix @ matrix.T - _IDENTITY).max() > _NOT_ORTHONORMAL:
        u, _, vt = np.linalg.svd(matrix)
        matrix = u @ vt
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    trace = a + e + i
    largest = max(a, e, i, trace)
    if largest == trace:
        x, y, z, w = h - f, c - g, d - b, 1.0 + trace
    elif largest == a:
        x, y, z, w = 1.0 + 2.0 * a - trace, d + b, g + c, h - f
    elif largest == e:
        x, y, z, w = d + b, 1.0 + 2.0 * e - trace, h + f, c - g
    else:
        x, y, z, w = g + c, h + f, 1.0 + 2.0 * i - trace, d - b
    length = hypot(x, y, z, w)
    # The same rotation by the other of the two quaternions, where that is the one wanted.
    if w < 0.0 or (w == 0.0 and (x < 0.0 or (x == 0.0 and (y < 0.0 or (y == 0.0 and z < 0.0))))):
        length = -length
    return x / length, y / length, z / length, w / length
