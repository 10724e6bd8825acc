"""How far an answer is from the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.rotation import matrix_from_quaternion, rotation_angle


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseError:
    """Distance of an answered pose from the true one, and the angle between the orientations."""

    position_m: float
    angle_deg: float


def pose_difference(
    frame: LocalFrame, cam_from_local: Rigid3, epsg: int, utm: ArrayLike, cam_from_utm_xyzw: ArrayLike
) -> PoseError:
    """An answer given in UTM minus a pose given in a local frame.

    Args:
        utm: (3,) easting, northing, ellipsoidal height in the zone `epsg`.
        cam_from_utm_xyzw: (4,) rotation of grid axes into camera axes.
    """
    center = frame.enu_from_utm(np.asarray(utm, dtype=np.float64), epsg)
    rotation = matrix_from_quaternion(cam_from_utm_xyzw) @ frame.grid_from_enu(center, epsg)
    return PoseError(
        position_m=float(np.linalg.norm(center - cam_from_local.center)),
        angle_deg=float(np.degrees(rotation_angle(rotation @ cam_from_local.rotation.T))),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What a group of queries came to.

    Attributes:
        position_m, angle_deg: (median, 95th percentile) over the localised ones; NaN where there are none.
        within: share of all queries within 0.25 m and 0.3 degrees.
        wrong: answers more than 5 m off.
    """

    position_m: tuple[float, float]
    angle_deg: tuple[float, float]
    within: float
    wrong: int


def summarise(errors: Sequence[PoseError | None]) -> Summary:
    """Summary of errors, None standing for "not localised"."""
    found = [e for e in errors if e is not None]
    close = sum(e.position_m <= 0.25 and e.angle_deg <= 0.3 for e in found)
    return Summary(
        position_m=_median_and_95([e.position_m for e in found]),
        angle_deg=_median_and_95([e.angle_deg for e in found]),
        within=close / len(errors) if errors else float("nan"),
        wrong=sum(e.position_m > 5.0 for e in found),
    )


def _median_and_95(values: list[float]) -> tuple[float, float]:
    if not values:
        return float("nan"), float("nan")
    return float(np.median(values)), float(np.percentile(values, 95))
