"""The compiled loop of a pose's fit; import it through `compiled_module`."""

import numpy as np

from featuredb.compiled import compiled
from featuredb.geometry.arrays import FloatArray


@compiled
def linearised(
    rotation: FloatArray,
    translation: FloatArray,
    points: FloatArray,
    seen: FloatArray,
    focal: float,
    longer: float,
    loss: float,
    residual: FloatArray,
    jacobian: FloatArray,
    normal: FloatArray,
    gradient: FloatArray,
) -> None:
    """Residuals, derivatives and normal equations of pixels under a Cauchy loss, at a pose and focal length.

    Points behind the camera have residuals of infinity and no derivatives.

    Args:
        rotation, translation: cam_from_local. points: (n, 3).
        seen: (n, 2) rays by the camera's focal length `focal`; `longer`: the one that is tried. loss: pixels.
        residual: (2, n) pixels, out. jacobian: (7, 2, n), out: by the pose's left perturbation and the
            logarithm of the focal length. normal, gradient: (7, 7), (7,), out.
    """
    normal[:] = 0.0
    gradient[:] = 0.0
    jacobian[:] = 0.0
    row = np.zeros((2, 7))
    for i in range(len(points)):
        x, y, z = points[i]
        u, v, depth = (
            rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0],
            rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1],
            rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2],
        )
        if not (depth > 1e-6 and np.isfinite(seen[i, 0]) and np.isfinite(seen[i, 1])):
            residual[:, i] = np.inf
            continue
        u, v, near = u / depth, v / depth, longer / depth
        row[0] = (-longer * u * v, longer * (1.0 + u * u), -longer * v, near, 0.0, -near * u, longer * u)
        row[1] = (-longer * (1.0 + v * v), longer * u * v, longer * u, 0.0, near, -near * v, longer * v)
        residual[0, i] = longer * u - focal * seen[i, 0]
        residual[1, i] = longer * v - focal * seen[i, 1]
        weight = 1.0 / (1.0 + (residual[0, i] ** 2 + residual[1, i] ** 2) / loss**2)
        for axis in range(2):
            for a in range(7):
                jacobian[a, axis, i] = row[axis, a]
                gradient[a] += weight * row[axis, a] * residual[axis, i]
                for b in range(a, 7):
                    normal[a, b] += weight * row[axis, a] * row[axis, b]
    for a in range(7):
        for b in range(a):
            normal[a, b] = normal[b, a]
