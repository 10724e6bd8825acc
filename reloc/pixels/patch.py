"""The plane that points around a place lie on, whatever else is near."""

from dataclasses import dataclass

import numpy as np

from featuredb.geometry.arrays import FloatArray

FEWEST_POINTS = 6  # three make a plane; twice as many say how flat it is
_DRAWS = 64  # of three points: where half of them lie on the plane, one draw in eight is clean
_MOST_POINTS = 80


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A piece of surface.

    Attributes:
        point: (3,) on it, nearest to the place that was asked for.
        normal: (3,) unit vector, towards the viewer.
        scatter_m: standard deviation of the points off the plane, metres.
        fitted_m: how well they determine the plane there, along its normal: one standard deviation.
        share: of the points around that lie on it.
    """

    point: FloatArray
    normal: FloatArray
    scatter_m: float
    fitted_m: float
    share: float


def fit_patch(points: FloatArray, near: FloatArray, viewer: FloatArray, tolerance_m: float) -> Patch | None:
    """The plane through the points around a place that most of them lie on; None where there is none.

    Nearer points count more, with a Gaussian as wide as a half of the farthest.

    Args:
        points: (n, 3). near: (3,) the place, on the wanted surface. viewer: (3,) from where it is seen.
        tolerance_m: a point so far off a plane does not belong to it.
    """
    distance = np.linalg.norm(points - near, axis=1)
    chosen = np.argsort(distance, kind="stable")[:_MOST_POINTS]
    points, distance = points[chosen], distance[chosen]
    if len(points) < FEWEST_POINTS:
        return None
    weight = np.exp(-2.0 * (distance / max(float(distance.max()), 1e-9)) ** 2)
    # The place itself is on the surface to within the points' own distance: it chooses among planes.
    on = _most_supported(points, near, weight, tolerance_m)
    for _ in range(3):
        if on is None or on.sum() < FEWEST_POINTS:
            return None
        origin, axes = _axes(points[on], weight[on])
        off = (points - origin) @ axes[2]
        on = np.abs(off) < tolerance_m
    if on is None or on.sum() < FEWEST_POINTS:
        return None
    return _patch(points[on], weight[on], near, viewer, float(weight[on].sum() / weight.sum()))


def _most_supported(
    points: FloatArray, near: FloatArray, weight: FloatArray, tolerance_m: float
) -> FloatArray | None:
    """Which points lie on the best of the planes through three of them (MSAC)."""
    rng = np.random.default_rng(len(points))
    best, most = None, 0.0
    likely = weight / weight.sum()
    for _ in range(_DRAWS):
        a, b, c = points[rng.choice(len(points), 3, replace=False, p=likely)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs((near - a) @ normal) > 2.0 * tolerance_m * length:
            continue
        off = np.abs((points - a) @ normal) / length / tolerance_m
        support = float(weight @ np.maximum(1.0 - off**2, 0.0))
        if support > most:
            best, most = off < 1.0, support
    return best


def _axes(points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    origin = np.average(points, axis=0, weights=weight)
    _, _, axes = np.linalg.svd((points - origin) * np.sqrt(weight)[:, None], full_matrices=False)
    return np.asarray(origin), np.asarray(axes)


def _patch(
    points: FloatArray, weight: FloatArray, near: FloatArray, viewer: FloatArray, share: float
) -> Patch | None:
    origin, axes = _axes(points, weight)
    s, t, off = ((points - origin) @ axes.T).T
    a, b = (near - origin) @ axes[0], (near - origin) @ axes[1]
    plan = np.column_stack([np.ones(len(points)), s - a, t - b])
    information = plan.T @ (plan * weight[:, None])
    if np.linalg.cond(information) > 1e8:  # on a line
        return None
    inverse = np.linalg.inv(information)
    height, slope_s, slope_t = inverse @ plan.T @ (weight * off)
    residual = off - plan @ [height, slope_s, slope_t]
    effective = weight.sum() ** 2 / (weight**2).sum()
    variance = float(weight @ residual**2 / weight.sum()) * effective / max(effective - 3.0, 1.0)
    leverage = float((inverse @ plan.T @ (plan * (weight**2)[:, None]) @ inverse)[0, 0])
    normal = axes[2] - slope_s * axes[0] - slope_t * axes[1]
    normal /= np.linalg.norm(normal)
    point = origin + a * axes[0] + b * axes[1] + height * axes[2]
    if normal @ (viewer - point) < 0:
        normal = -normal
    return Patch(
        point=np.asarray(point),
        normal=np.asarray(normal),
        scatter_m=float(np.sqrt(variance)),
        fitted_m=float(np.sqrt(variance * leverage)),
        share=share,
    )
