"""Which way is up, from a block alone: the ground under aerial photos is level on the whole."""

from dataclasses import dataclass

import numpy as np

from featuredb.adjust.block import Block
from featuredb.geometry.arrays import FloatArray
from ingest.register.control.fit import Vertical


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelGroundOptions:
    """The assumption of level ground.

    Attributes:
        sigma_tilt_deg: of the plane through the block's points, about each axis. Windows of 60 m of the
            ground in public airborne scans slope by 1.7 to 3.5 degrees, larger ones by
            less. The cameras' mean axis is no better: a mount may be tilted by more (7 degrees
            against the plane in `copr`).
        ground_up_m: height of the control points in metres, where somebody knows it about.
        sigma_ground_m: its standard deviation; 1000 m is that of not knowing: most land lies lower.
        kept_share: of the points, nearest to the middle of them; the far ones are trees and errors.
    """

    sigma_tilt_deg: float = 3.5
    ground_up_m: float = 0.0
    sigma_ground_m: float = 1000.0
    kept_share: float = 0.9


def level_ground(block: Block, anchor_block: FloatArray, options: LevelGroundOptions) -> Vertical:
    """The vertical as the normal of the plane through the block's points, on the cameras' side.

    Args:
        anchor_block: (3,) where the ground has the height that the options say.
    """
    normal = plane_normal(block.xyz, options.kept_share)
    if float((np.median(block.centers(), axis=0) - np.median(block.xyz, axis=0)) @ normal) < 0:
        normal = -normal
    sigma = np.radians(options.sigma_tilt_deg)
    height = (
        "their height is not known at all: the control points are put at height 0"
        if options.sigma_ground_m >= 1000.0
        else f"the control points are put at height {options.ground_up_m:g} m, as given"
    )
    return Vertical(
        up_block=normal,
        tilt_covariance=np.eye(2) * sigma**2,
        anchor_block=anchor_block,
        anchor_up_m=options.ground_up_m,
        sigma_up_m=options.sigma_ground_m,
        source="nothing says which way is up, so the ground is taken as level on the whole, to "
        f"{options.sigma_tilt_deg:g} degrees; {height}",
    )


def plane_normal(points: FloatArray, kept_share: float) -> FloatArray:
    """Unit normal (3,) of the plane through most points (n, 3)."""
    kept = points
    for _ in range(5):
        middle = kept.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((kept - middle).T))
        normal = axes[:, 0]
        away = np.abs((points - middle) @ normal)
        kept = points[away <= np.quantile(away, kept_share)]
    return np.asarray(normal)
