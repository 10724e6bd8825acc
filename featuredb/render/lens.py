"""Any camera model as one row of numbers, for projection inside compiled loops."""

from typing import Final

import numpy as np

from featuredb.geometry.camera import Camera

# fx, fy, cx, cy; numerator k1..k4 and denominator k1..k3 of the radial factor; tangential p1, p2;
# 1 for a fisheye; square of the tangent beyond which the lens sees nothing.
LENS_SIZE: Final = 15
FISHEYE: Final = 13
FOLD: Final = 14


def lens_numbers(camera: Camera) -> tuple[float, ...]:
    """LENS_SIZE numbers of a camera: focal lengths, principal point, distortion, fold limit.

    The radial factor is (1 + n1 q + n2 q^2 + n3 q^3 + n4 q^4) / (1 + d1 q + d2 q^2 + d3 q^3), q being the
    squared tangent of the angle off the axis, or the squared angle in a fisheye.
    """
    one_focal = camera.model in (
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
    )
    p = camera.params
    fx, fy, cx, cy, *k = (p[0], *p) if one_focal else p
    lens = np.zeros(LENS_SIZE)
    lens[:4] = fx, fy, cx, cy
    if camera.model == "OPENCV":
        lens[4:6], lens[11:13] = k[:2], k[2:4]
    elif camera.model == "FULL_OPENCV":
        lens[4:7], lens[11:13], lens[8:11] = (k[0], k[1], k[4]), k[2:4], k[5:8]
    else:
        lens[4 : 4 + len(k)] = k
    lens[FISHEYE] = "FISHEYE" in camera.model
    lens[FOLD] = camera.tan_of_fold**2
    return tuple(lens.tolist())
