"""Rays of a camera's pixels, exact to float32 and cheap for any distortion."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.camera import Camera

# Undistortion is smooth: a polynomial of this degree in both directions interpolates it to better than
# 1e-7 for the lenses of photo cameras, and costs two small matrix products instead of one
# Newton iteration per pixel.
_DEGREE = 24


@lru_cache(maxsize=3)
def pixel_rays(camera: Camera, supersample: int = 1) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Normalised image coordinates x and y, each (height * supersample, width * supersample) float32.

    The ray of element (i, j) is (x, y, 1) and passes the centre of that (sub)pixel, at pixel coordinates
    ((j + 0.5) / supersample, (i + 0.5) / supersample).
    """
    nodes = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    u, v = np.meshgrid(0.5 * (nodes + 1) * camera.width, 0.5 * (nodes + 1) * camera.height)
    at_nodes = camera.unproject(np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
    fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, _DEGREE))
    rows = np.polynomial.chebyshev.chebvander(_centres(camera.height * supersample), _DEGREE) @ fit
    columns = np.polynomial.chebyshev.chebvander(_centres(camera.width * supersample), _DEGREE) @ fit
    x, y = (np.ascontiguousarray(rows @ at_nodes[..., k] @ columns.T, dtype=np.float32) for k in (0, 1))
    x.setflags(write=False)
    y.setflags(write=False)
    return x, y


def _centres(n: int) -> FloatArray:
    """Centres of n cells of [-1, 1]."""
    return (2.0 * np.arange(n) + 1.0) / n - 1.0
