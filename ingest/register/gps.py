"""Placement by positions of any quality: the similarity, how wide it is, and whether it may be by chance.

How noisy the positions are is estimated with the similarity (`ingest.positions.position_noise`). What noise
leaves of the stated sigmas is taken for a bias that all positions share, unless many people told them. Two
tests, each by a rate of error (docs/measurements/ingest.md): how often positions that have nothing to do with
the reconstruction would fit as well, and how few receivers are as noisy.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from featuredb.features.exif.gps import DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, similarity_closed_form
from ingest.positions.held import ANGLES_WRONG, Held
from ingest.positions.position_noise import NoisyFit, fit_noisy
from ingest.positions.receivers import receivers
from ingest.positions.variance_components import NOISE_SHARE, stated_sigma
from ingest.register.outcome import Outcome

GpsReason = Literal["TOO_FEW", "DEGENERATE_LINE", "RESIDUALS", "SCALE"]

_LEAST_PHOTOS = 3  # fix a similarity
_MANY_SHARE = 0.1  # of what they state, of many people's positions: pins on one map, which may be off
# Shares of receivers that are noisier than what is refused: in general, and where chance explains the fit.
_WRONG, _NO_PLACE = 0.001, 0.05
_ANSWERS = 0.001  # chance below which a map may answer
# Standard deviations of scale and turn beyond which covariances say nothing, as they are linear.
_MAX_SCALE_SIGMA, _MAX_TURN_DEG = 0.3, 25.0
_ANSWERS_TURN_DEG = 10.0  # standard deviation of the turn beyond which a map may not answer
_LEANS_DEG = (
    30.0  # photos that are level with each other, off the level in the median: no one's and no gimbal's
)
_MAX_SAMPLES = 500  # of three positions; fewer photos are tried exhaustively
_PLAIN_M = np.array([DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_HORIZONTAL_M, DEFAULT_SIGMA_VERTICAL_M])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GpsPlacement(Outcome[GpsReason]):
    """Outcome of a placement.

    Attributes:
        provisional: why the map may not answer before something confirms it; "" where it may.
        local_from_sfm: the similarity, None where none could be estimated.
        covariance: (7, 7) of its left perturbation (sigma, omega, nu), or None.
        residuals_m: (n, 3) GPS minus placed centre, east, north, up; NaN without a similarity.
        inliers: (n,) bool, those that are not far out.
    """

    residuals_m: FloatArray
    inliers: NDArray[np.bool_]
    provisional: str = ""
    local_from_sfm: Sim3 | None = None
    covariance: FloatArray | None = None

    @property
    def residual_rms_m(self) -> float:
        """Root mean square length of the inliers' residuals, metres."""
        inner = self.residuals_m[self.inliers]
        return float(np.sqrt(np.nansum(inner**2, axis=1).mean())) if len(inner) else float("nan")


def place_by_gps(
    centers_sfm: FloatArray,
    positions_local: FloatArray,
    sigmas_m: FloatArray,
    times_s: FloatArray | None = None,
    held: Held | None = None,
    camera_of: NDArray[np.int64] | None = None,
) -> GpsPlacement:
    """Robust similarity from camera centres to GPS positions.

    Args:
        centers_sfm: (n, 3) camera centres in the reconstruction's frame.
        positions_local: (n, 3) GPS in the local frame, metres.
        sigmas_m: (n, 3) standard deviations of the positions along the local axes; infinite for a coordinate
            that is not known.
        times_s: (n,) of capture; None: in the order given.
        held: how the photos are held.
        camera_of: (n,) whose and which camera took the photo; None: one took all.
    """
    count = len(centers_sfm)
    figures: dict[str, Any] = {"photos_with_gps": count}
    if count < _LEAST_PHOTOS:
        message = f"{count} registered photos have GPS, at least {_LEAST_PHOTOS} are needed"
        return _refused("TOO_FEW", message, count, figures)
    start = _start(centers_sfm, positions_local, sigmas_m)
    if start is None:
        return _refused("DEGENERATE_LINE", "the camera centres or positions coincide", count, figures)
    many = receivers(camera_of, count) > 1.0
    given = (centers_sfm, positions_local, sigmas_m, times_s, held, many)
    fit = fit_noisy(start, *given)
    if held is not None and (fit.local_from_sfm.rotation @ held.down)[2] > 0:  # a line, the wrong side up
        over = fit_noisy(_turned_over(fit.local_from_sfm, centers_sfm), *given)
        if over.log_chance <= fit.log_chance + np.log(1.0 / _WRONG):  # else pictures are upside down
            fit = over
    if held is not None:
        figures["angles"] = _angles(fit, held)
    inner = fit.used.all(axis=1)
    by = receivers(None if camera_of is None else camera_of[inner], int(inner.sum()))
    return _judged(fit, centers_sfm, positions_local, sigmas_m, by, figures)


def _angles(fit: NoisyFit, held: Held) -> dict[str, Any]:
    """How far off photos are held from what they say, or from level, at the median."""
    off = held.terms(fit.local_from_sfm.rotation)[2]
    down = float((fit.local_from_sfm.rotation @ held.down)[2])
    result: dict[str, Any] = {"told": held.told, "upside_down": down > 0}
    for name, rows in (("tilt", ~held.by_yaw), ("yaw", held.by_yaw)):
        if rows.any():
            result |= {
                f"{name}_off_deg": float(np.degrees(np.median(off[rows]))),
                f"{name}_contradicts": bool(np.median(off[rows] / held.sigma_rad[rows]) > ANGLES_WRONG),
            }
    return result


def _judged(
    fit: NoisyFit,
    centers: FloatArray,
    positions: FloatArray,
    sigmas: FloatArray,
    by: float,
    figures: dict[str, Any],
) -> GpsPlacement:
    """Covariance, figures and tests of an estimated similarity; `by`: `receivers` of positions that agree."""
    known = np.isfinite(sigmas)
    residuals = np.where(known, positions - fit.local_from_sfm.act(centers), np.nan)
    stated = np.array([stated_sigma(sigmas[:, k]) for k in range(3)])
    white, drift = (of[[0, 0, 1]] for of in (fit.white_m, fit.drift_m))
    bias = np.sqrt(np.maximum(stated**2 - white**2, 0.0))
    if by > 1.0:  # what each is off by shows among them, but not what all share: a datum of heights, a map
        shared = np.hypot(np.minimum(bias, white) / np.sqrt(by - 1.0), _MANY_SHARE * stated)
        bias[:2] = np.minimum(bias, shared)[:2]
    noise = np.sqrt(white**2 + drift**2 / 3.0)
    above = np.log(noise / (np.maximum(stated, _PLAIN_M) * NOISE_SHARE))  # deviations of a receiver's noise
    # Noisier than any receiver: two data of heights, another clock. These are shared, and do not average out.
    bias = np.where(above > -ndtri(_NO_PLACE), np.maximum(bias, noise), bias)
    each = int(fit.used.all(axis=1).sum()) / by if by > 1.0 else 1.0  # positions by one of many
    covariance = each * fit.covariance
    covariance[4:, 4:] += np.diag(bias**2)
    rms, most = noise[known.any(axis=0)], float(above[known.any(axis=0)].max())
    # Where positions are noisier than usual, those along another way would be, too: fewer of them count.
    unusual = most > -ndtri(_NO_PLACE)
    chance = fit.log_chance_of_path if unusual else fit.log_chance
    inliers = np.asarray(fit.used.all(axis=1))
    turn_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1])))
    checked_deg = max(turn_deg, float(np.degrees(fit.checked_turn_rad)))
    told = [bool(known[:, k].any()) for k in range(3)]
    axes = [any(told[:2]), told[2]]
    figures = figures | {
        "inliers": int(inliers.sum()),
        "noise_m": _where(axes, fit.white_m.tolist()),
        "drift_m": _where(axes, fit.drift_m.tolist()),
        "lag_s": fit.lag_s,
        "bias_sigma_m": _where(told, bias.tolist()),
        "scale_sigma": float(np.sqrt(covariance[0, 0])),
        "turn_sigma_deg": turn_deg,
        "checked_turn_sigma_deg": checked_deg,
        "log10_chance": chance / np.log(10.0),
        "rms_horizontal_m": _rms(residuals[fit.used[:, 0], :2]),
        "rms_vertical_m": _rms(residuals[fit.used[:, 1] & known[:, 2], 2:]),
    }

    outcome = partial(
        GpsPlacement,
        local_from_sfm=fit.local_from_sfm,
        covariance=covariance,
        residuals_m=residuals,
        inliers=inliers,
        figures=figures,
    )
    refused = -ndtri(_WRONG if chance <= np.log(_NO_PLACE) else _NO_PLACE)
    if most > refused or inliers.sum() < _LEAST_PHOTOS:
        height = f" and {rms[2]:.0f} m in height" if len(rms) == 3 else ""
        words = (
            f"the photos' GPS does not fit the reconstruction: {inliers.sum()} of {len(inliers)} positions "
            f"agree, noisy by {rms[0]:.0f} m horizontally{height}; positions of other photos would fit as "
            f"well in {np.exp(chance):.1g} of cases"
        )
        return outcome(reason="RESIDUALS", message=words)
    if turn_deg > _MAX_TURN_DEG:
        words = (
            f"the photos lie along a line: their GPS tells the orientation to {turn_deg:.0f} degrees, "
            f"{_MAX_TURN_DEG:.0f} are needed; add photos beside the line or the camera's angles, or "
            "place it by control points (--gcp) or a scan"
        )
        return outcome(reason="DEGENERATE_LINE", message=words)
    if figures["scale_sigma"] > _MAX_SCALE_SIGMA:
        words = (
            f"the scale is known to {figures['scale_sigma']:.1%} only, {_MAX_SCALE_SIGMA:.0%} is "
            "needed: the photos are too close together for their GPS"
        )
        return outcome(reason="SCALE", message=words)
    provisional = ""
    if chance > np.log(_ANSWERS):
        provisional = (
            f"positions that have nothing to do with these photos would fit as well in {np.exp(chance):.1%} "
            f"of cases (limit {_ANSWERS:.1%}): too few are left to check the place by"
        )
    elif checked_deg > _ANSWERS_TURN_DEG:
        provisional = (
            f"the photos lie along a line: their GPS tells the turn about it to {checked_deg:.0f} degrees, "
            f"{_ANSWERS_TURN_DEG:.0f} are needed, and no camera angles do"
        )
    angles = figures.get("angles", {})
    if angles.get("upside_down") or angles.get("tilt_off_deg", 0.0) > _LEANS_DEG:
        provisional = (
            "the positions lay the photos on their sides or upside down: latitude and longitude may be "
            "exchanged, one of them may lack its sign, or pictures are stored rotated"
        )
    message = "placed by GPS" if provisional else _words("placed by GPS", figures)
    return outcome(reason=None, message=message, provisional=provisional)


def _words(placed: str, figures: dict[str, Any]) -> str:
    """With what angles contradict positions by."""
    angles = figures.get("angles", {})
    against = [
        f"{name} by {angles[f'{name}_off_deg']:.0f} degrees"
        for name in ("tilt", "yaw")
        if angles.get(f"{name}_contradicts") and (name == "yaw" or angles["told"])  # level is only assumed
    ]
    if not against:
        return placed
    return f"{placed}; the cameras' angles contradict it and hardly count: {', '.join(against)} (median)"


def _where(known: Sequence[bool], values: Sequence[float]) -> list[float | None]:
    return [value if there else None for there, value in zip(known, values, strict=True)]


def _rms(residuals_m: FloatArray) -> float | None:
    """Root mean square length of residuals (n, d); None without any."""
    return float(np.sqrt((residuals_m**2).sum(axis=1).mean())) if len(residuals_m) else None


def _turned_over(sim: Sim3, centers: FloatArray) -> Sim3:
    """Turned by half a turn about the main line of the centres."""
    placed = sim.act(centers)
    middle = placed.mean(axis=0)
    axis = np.linalg.svd(placed - middle, full_matrices=False)[2][0]
    turn = 2.0 * np.outer(axis, axis) - np.eye(3)
    return Sim3(scale=1.0, rotation=turn, translation=middle - turn @ middle) @ sim


def _start(centers: FloatArray, positions: FloatArray, sigmas: FloatArray) -> Sim3 | None:
    """The similarity of three photos, or of all, that fits most of them at whatever noise they have."""
    whole = np.isfinite(sigmas).all(axis=1)
    if not whole.any():  # heights that nobody knows: one height for all
        positions, whole = np.where(np.isfinite(sigmas), positions, 0.0), np.ones(len(sigmas), dtype=np.bool_)
    rows = np.flatnonzero(whole)

    def cost(sim: Sim3) -> float:
        off = (positions - sim.act(centers)) / sigmas
        off[~np.isfinite(off)] = 0.0
        return float(np.log1p((off[:, :2] ** 2).sum(axis=1)).sum() + 0.5 * np.log1p(off[:, 2] ** 2).sum())

    samples = [rows, *(rows[s] for s in _samples(len(rows)))]
    sims = (similarity_closed_form(centers[sample], positions[sample]) for sample in samples)
    return min((sim for sim in sims if sim is not None), key=cost, default=None)


def _samples(count: int) -> list[NDArray[np.int64]]:
    if count * (count - 1) * (count - 2) // 6 <= _MAX_SAMPLES:
        return [np.array(c) for c in itertools.combinations(range(count), 3)]
    generator = np.random.default_rng(0)
    return [generator.choice(count, 3, replace=False) for _ in range(_MAX_SAMPLES)]


def _refused(reason: GpsReason, message: str, count: int, figures: dict[str, Any]) -> GpsPlacement:
    return GpsPlacement(
        reason=reason,
        message=message,
        residuals_m=np.full((count, 3), np.nan),
        inliers=np.zeros(count, dtype=bool),
        figures=figures,
    )
