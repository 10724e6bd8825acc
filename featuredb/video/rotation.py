"""How a film's pictures are turned to stand upright: its display matrix, and the turning.

A phone held upright stores its pictures as its sensor reads them, lying on their side, and beside them a
matrix that says how to show them (ISO 14496-12, the `matrix` of `tkhd` and `mvhd`). Decoders leave the
pictures as they are. Features, cameras and poses of a film belong to the upright pictures.
"""

import math
import struct

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.errors import VideoError

_MATRIX = struct.Struct("=9i")  # 16.16 fixed point but for the last column, in host order as libav keeps it
_ONE = 65536.0
# Writers round the sines of 90 degrees to 16.16; what is further off is meant to be another angle.
_MAX_OFF_DEG = 0.5
_TURNS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


def clockwise_from_display_matrix(matrix: bytes | None, name: str) -> int:
    """Degrees, 0, 90, 180 or 270, by which stored pictures are turned clockwise to stand upright.

    The matrix (a b u; c d v; x y w) takes the stored point (p, q), y down, to (a p + c q + x, b p + d q + y)
    on the screen. What it shifts or scales is of no interest: only where its axes point.

    Args:
        matrix: the side data DISPLAYMATRIX, 36 bytes, or None for a film without one.

    Raises:
        VideoError: another angle, a mirrored picture, or no matrix of that size.
    """
    if matrix is None:
        return 0
    if len(matrix) != _MATRIX.size:
        raise VideoError(f"{name}: expected a display matrix of {_MATRIX.size} bytes, found {len(matrix)}")
    a, b, _, c, d, *_ = (value / _ONE for value in _MATRIX.unpack(matrix))
    determinant = a * d - b * c
    if determinant == 0.0:
        raise VideoError(
            f"{name}: the display matrix ({a:g} {b:g}; {c:g} {d:g}) shows no picture; encode the film again"
        )
    if determinant < 0.0:
        raise VideoError(
            f"{name}: the display matrix mirrors the picture (as of a selfie camera), and scenes would come "
            "out mirrored; switch mirroring off in the camera, or encode the film again as it is to be read"
        )
    angles = (math.degrees(math.atan2(b, a)), math.degrees(math.atan2(-c, d)))
    turns = round(angles[0] / 90.0)
    if any(abs(math.remainder(angle - 90.0 * turns, 360.0)) > _MAX_OFF_DEG for angle in angles):
        raise VideoError(
            f"{name}: the display matrix turns the picture by {angles[0] % 360.0:.1f} degrees, "
            "expected 0, 90, 180 or 270; encode the film again without that rotation"
        )
    return turns % 4 * 90


def turned(picture: NDArray[np.uint8], clockwise_deg: int) -> NDArray[np.uint8]:
    """The picture (h, w) or (h, w, 3) uint8 turned clockwise by 0, 90, 180 or 270 degrees."""
    if clockwise_deg == 0:
        return picture
    # OpenCV turns in blocks that stay in the cache: eight times as fast as a copy of numpy's rot90 at 4K.
    return np.asarray(cv2.rotate(picture, _TURNS[clockwise_deg]), dtype=np.uint8)
