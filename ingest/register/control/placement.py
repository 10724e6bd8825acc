"""Placement by ground control points: the whole way from marks to an adjusted block with its uncertainty.

Its steps are `fit`, `adjust` and `residuals`; what they do: docs/measurements/control-points.md.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from featuredb.adjust.terms import Block
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import Placement
from featuredb.plain_json import plain
from ingest.register.control.adjust import Adjusted, task_of, with_all_points
from ingest.register.control.fit import ControlFit, Vertical, fit_similarity, hypotheses
from ingest.register.control.marks import Control
from ingest.register.control.residuals import (
    MarkResidual,
    PointResidual,
    gps_offset,
    improve,
    initial_weights,
    residuals_of,
)
from ingest.register.outcome import Outcome

GcpReason = Literal["TOO_FEW", "DEGENERATE_LINE", "RESIDUALS", "SCALE", "UPSIDE_DOWN", "CONTRADICTS_GPS"]

_STEEP = 0.5  # sine of 30 degrees: half the photos look up more steeply than photos of a place ever do
_MIN_POINTS = 3  # three are the least with which one can be found to be wrong
_MIN_SHARE = 0.5  # of the points that must agree; with fewer, the file and the photos do not belong together
# Of the surveyed coordinates' standard deviation over the extent of the points; beyond, they agree no better
# than points drawn at random would.
_MAX_SIGMA_OVER_EXTENT = 0.1
_MAX_SCALE_SIGMA = 0.1  # relative standard deviation of the scale; beyond, a map is no measure
# Extent of the points across their line over that along it; below, heights of the points do not say which way
# is up.
_MIN_LINE_RATIO = 0.02
# Of the placed photos from their own GPS, beyond three of its sigmas. EXIF is off by metres, rarely by tens;
# more means another zone, system or unit.
_MAX_GPS_OFFSET_M = 150.0
# Of the plane through the block's points, about each axis. The cameras' mean axis is no better: a mount may
# be tilted by more (7 degrees against the plane in `copr`).
_SIGMA_TILT_DEG = 3.5
_KEPT_SHARE = 0.9  # of the points, nearest to the middle of them; the far ones are trees and errors
_KEPT_HEIGHT_M = 0.01  # standard deviation of a height that the adjustment is to keep
_ANY_HEIGHT_M = (0.0, 1000.0)  # and standard deviation: that of not knowing; most land lies lower


@dataclass(frozen=True, slots=True, kw_only=True)
class GcpOptions:
    """How a block is placed by control points and when that is refused.

    Attributes:
        sigma_m: standard deviation of the surveyed coordinates, horizontal and vertical; None finds it
            from the residuals.
        ground_m: height of the control points and its standard deviation, where somebody knows it about.
        keep_lens: keep all lenses.
    """

    sigma_m: tuple[float, float] | None = None
    ground_m: tuple[float, float] | None = None
    keep_lens: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GcpPlacement(Outcome[GcpReason]):
    """Outcome of a placement.

    Attributes:
        control: what met the photos, and what did not.
        local_from_block: the similarity nearest to what became of the block, None where there is none.
        covariance: (7, 7) of its left perturbation (sigma, omega, nu), or None.
        block: adjusted, in metres in the local frame, or None.
        points: every control point with its residual; marks: every mark.
        notes: what was assumed, for people.
    """

    control: Control
    local_from_block: Sim3 | None = None
    covariance: FloatArray | None = None
    block: Block | None = None
    points: tuple[PointResidual, ...] = ()
    marks: tuple[MarkResidual, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def residual_rms_m(self) -> float:
        """Root mean square length of the residuals of the surveyed coordinates that were used."""
        squared = [float(np.nansum(p.residual_m**2)) for p in self.points if p.used]
        return float(np.sqrt(np.mean(squared))) if squared else float("nan")

    @property
    def evidence(self) -> dict[str, Any]:
        """Figures, residuals of every point and mark, and notes; JSON-able."""
        found: dict[str, Any] = plain(
            {
                **self.figures,
                "notes": self.notes,
                "points": [point.figures() for point in self.points],
                "marks": [mark.figures() for mark in self.marks],
                "unused_marks": [f"line {mark.line}: {reason}" for mark, reason in self.control.unused],
                "unmarked_points": self.control.unmarked,
                "file_notes": self.control.file.notes,
            }
        )
        return found

    def map_placement(self, block_from_sfm: Sim3) -> Placement:
        """For the map, where it is accepted; `block_from_sfm` had placed the block in its own frame."""
        assert self.local_from_block is not None
        assert self.covariance is not None  # accepted
        return Placement(
            method="gcp",
            local_from_sfm=self.local_from_block @ block_from_sfm,
            covariance=self.covariance,
            residual_rms_m=self.residual_rms_m,
            evidence=self.evidence,
        )

    def height_datum(self, before: str, said: str) -> str:
        """Datum of the map's heights: the survey's where it gives heights, else what it was before.

        What is `said` of surveyed heights counts where the file's reference system does not say it.
        """
        if np.isfinite(self.control.surveyed[:, 2]).sum() < 3:
            return before
        datum = self.control.file.crs.height_datum
        return datum if datum != "unknown" else said


def place_by_gcp(
    block: Block,
    control: Control,
    options: GcpOptions,
    *,
    vertical: Vertical | None = None,
    gps_local: FloatArray | None = None,
    gps_sigma_m: tuple[float, float] = (0.0, 0.0),
) -> GcpPlacement:
    """Place and adjust a block by control points.

    Args:
        block: in a frame of its own, of any scale.
        control: its marks, and the surveyed positions in the local frame.
        vertical: what is known of tilt and height from elsewhere, used where the points do not tell.
        gps_local: (k, 3) the photos' own positions in the local frame, NaN where there are none; they
            guard against gross errors of the file, and what they are off by is told.
        gps_sigma_m: that they state, horizontal and vertical.
    """
    found = hypotheses(block, control)
    usable = sorted({h.point for h in found})
    if len(usable) < _MIN_POINTS:
        message = (
            f"{len(usable)} control points can be located in the photos, at least {_MIN_POINTS} are needed; "
            "mark each point in two photos or more"
        )
        return GcpPlacement(control=control, reason="TOO_FEW", message=message)
    notes: tuple[str, ...] = ()
    if not _vertical_is_needed(control, usable):
        vertical = None
    elif vertical is None:
        vertical = level_ground(block, np.median([h.xyz for h in found], axis=0), options.ground_m)
        notes = (vertical.source,)
    else:
        notes = (f"tilt and height are kept from {vertical.source}",)
    fit = fit_similarity(found, control.surveyed, vertical)
    extent = float(np.linalg.norm(np.ptp(control.surveyed[usable, :2], axis=0)))
    if fit is None or extent <= 0:
        message = "the control points, or their places in the photos, coincide or lie along a line"
        return GcpPlacement(control=control, reason="DEGENERATE_LINE", message=message)
    agree = int(fit.inliers.sum())
    if agree < max(_MIN_POINTS, _MIN_SHARE * len(usable)) or fit.sigma_m > _MAX_SIGMA_OVER_EXTENT * extent:
        message = (
            f"the control points do not fit the photos: {agree} of {len(usable)} agree, to "
            f"{fit.sigma_m:.2f} m over {extent:.0f} m; check the reference system, the order of x and y, the "
            "units, and that the marks are of these photos"
        )
        return GcpPlacement(control=control, reason="RESIDUALS", message=message)
    placement = _adjusted_placement(block, control, fit, vertical, options)
    assert placement.block is not None
    assert placement.covariance is not None
    figures: dict[str, Any] = {}
    if gps_local is not None:
        figures, told = gps_offset(gps_local, gps_sigma_m, placement.block.centers(), placement.covariance)
        notes = (*notes, *told)
    placement = replace(placement, notes=notes, figures=placement.figures | figures)
    reason, message = _verdict(placement, gps_sigma_m)
    return replace(placement, reason=reason, message=message)


def level_ground(block: Block, anchor_block: FloatArray, ground_m: tuple[float, float] | None) -> Vertical:
    """The vertical as the normal of the plane through the block's points, on the cameras' side.

    At `anchor_block` (3,) the ground has the height `ground_m`, which comes with its sigma.
    """
    normal = _plane_normal(block.xyz)
    if float((np.median(block.centers(), axis=0) - np.median(block.xyz, axis=0)) @ normal) < 0:
        normal = -normal
    up_m, sigma_m = ground_m or _ANY_HEIGHT_M
    height = f"the control points are put at height {up_m:g} m, as given"
    if ground_m is None:
        height = "their height is not known at all: the control points are put at height 0"
    return Vertical(
        up_block=normal,
        tilt_covariance=np.eye(2) * np.radians(_SIGMA_TILT_DEG) ** 2,
        anchor_block=anchor_block,
        anchor_up_m=up_m,
        sigma_up_m=sigma_m,
        source="nothing says which way is up, so the ground is taken as level on the whole, to "
        f"{_SIGMA_TILT_DEG:g} degrees; {height}",
    )


def _plane_normal(points: FloatArray) -> FloatArray:
    """Unit normal (3,) of the plane through most points (n, 3)."""
    kept = points
    for _ in range(5):
        middle = kept.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((kept - middle).T))
        normal = axes[:, 0]
        away = np.abs((points - middle) @ normal)
        kept = points[away <= np.quantile(away, _KEPT_SHARE)]
    return np.asarray(normal)


def _vertical_is_needed(control: Control, usable: list[int]) -> bool:
    """Whether the known heights leave tilt or height open: fewer than three, or three on a line."""
    rows = [i for i in usable if np.isfinite(control.surveyed[i, 2])]
    if len(rows) < 3:
        return True
    spread = np.linalg.svd(control.surveyed[rows] - control.surveyed[rows].mean(axis=0))[1]
    return bool(spread[1] < _MIN_LINE_RATIO * spread[0])


def _adjusted_placement(
    block: Block, control: Control, fit: ControlFit, vertical: Vertical | None, options: GcpOptions
) -> GcpPlacement:
    free_height_m = 0.0
    if vertical is not None:
        vertical = vertical.moved(fit.local_from_block)
        if not np.isfinite(control.surveyed[:, 2]).any():
            # Nothing else says the height: the adjustment keeps it, and its uncertainty is added afterwards,
            # which spares the equations a kilometre beside a millimetre.
            free_height_m = vertical.sigma_up_m
            vertical = replace(vertical, sigma_up_m=_KEPT_HEIGHT_M)
    weights, xyz = initial_weights(control, fit, options.sigma_m)
    task = task_of(block.moved(fit.local_from_block), control, xyz, vertical, options.keep_lens)
    adjusted, freedom = improve(task, weights, options.sigma_m is not None)
    points, marks = residuals_of(adjusted, control)
    covariance = _covariance(adjusted, free_height_m, freedom)
    weights = adjusted.weights
    return GcpPlacement(
        control=control,
        reason=None,
        message="placed by control points",
        local_from_block=adjusted.change @ fit.local_from_block,
        covariance=covariance,
        block=with_all_points(adjusted, task),
        points=points,
        marks=marks,
        figures={
            "points_used": int(weights.points.sum()),
            "control_sigma_m": weights.control_m.tolist(),
            "mark_sigma_px": weights.mark_px,
            "scale_sigma": float(np.sqrt(covariance[0, 0])),
        },
    )


def _covariance(adjusted: Adjusted, free_height_m: float, freedom: float) -> FloatArray:
    """(7, 7); a sigma estimated from few residuals is itself uncertain: Student's t instead of the normal."""
    covariance = adjusted.covariance * (freedom / (freedom - 2.0) if freedom > 4 else 2.0)
    covariance[6, 6] += free_height_m**2
    return np.asarray((covariance + covariance.T) / 2)


def _verdict(placement: GcpPlacement, gps_sigma_m: tuple[float, float]) -> tuple[GcpReason | None, str]:
    """The gates that look at the finished placement: which refuses it, and what to tell."""
    figures = placement.figures
    assert placement.block is not None
    looks_up = float(np.median([pose.rotation[2, 2] for pose in placement.block.cam_from_block]))
    away_m = float(np.hypot(*figures.get("gps_offset_m", (0.0, 0.0))[:2]))
    if figures["points_used"] < _MIN_POINTS:
        return "RESIDUALS", (
            f"only {figures['points_used']} control points are left after those that contradict the "
            f"others; at least {_MIN_POINTS} are needed"
        )
    if figures["scale_sigma"] > _MAX_SCALE_SIGMA:
        return "SCALE", (
            f"the scale is known to {figures['scale_sigma']:.1%} only, {_MAX_SCALE_SIGMA:.0%} "
            "is needed: the control points are too close together for their accuracy"
        )
    if looks_up > _STEEP:
        return "UPSIDE_DOWN", (
            "the control points put the cameras under the ground, looking up; x and y of the survey "
            "are probably exchanged, or heights have the wrong sign"
        )
    if away_m > _MAX_GPS_OFFSET_M + 3.0 * gps_sigma_m[0]:
        return "CONTRADICTS_GPS", (
            f"the control points put the photos {away_m:,.0f} m from their GPS; "
            "check the file's reference system, its zone and its units"
        )
    return None, placement.message
