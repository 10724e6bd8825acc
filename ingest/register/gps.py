"""Placement by GPS: the similarity that carries camera centres to the photos' positions.

Equation: gps_i = S center_i + bias + noise_i, with S = local_from_sfm. The sigma of a position is that of
its whole error, bias + noise. Noise is independent for each photo and shows in the residuals; the bias is
shared by all photos of a flight (atmosphere, ephemeris, barometer) and never does. What the sigmas claim
and the residuals do not show is therefore taken for bias: it goes into the covariance of the translation.
"""

import itertools
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3, point_jacobian
from featuredb.geometry.similarity import refined_similarity, similarity_closed_form

GpsReason = Literal["TOO_FEW", "DEGENERATE_LINE", "RESIDUALS", "SCALE"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GpsOptions:
    """How the similarity is estimated and when it is refused.

    Attributes:
        min_photos: three positions are the least that fix a similarity.
        outlier_sigmas: a photo whose residual is further out, in sigmas of its own prior, is left out.
            3.5 keeps 99.3 % of honest positions (three axes).
        max_outlier_share: with more outliers than that the priors or the reconstruction are wrong.
        min_rotation_sigma_ratio: the spread of the centres across their main line, over the sigma of
            GPS across it; below, the rotation about the line is not observed to better than ~30 deg.
        max_variance_factor: of weighted residuals over their expectation; 9 means that GPS is three
            times worse than it says.
        max_scale_sigma: relative standard deviation of the scale; beyond, a map is no measure.
        noise_confidence: small residuals of few photos may be luck; the noise is taken as large as it
            can be at this confidence, up to what the sigmas claim.
        max_ransac_samples: of three positions; fewer photos are tried exhaustively.
        seed: of the samples.
    """

    min_photos: int = 3
    outlier_sigmas: float = 3.5
    max_outlier_share: float = 0.4
    min_rotation_sigma_ratio: float = 2.0
    max_variance_factor: float = 9.0
    max_scale_sigma: float = 0.1
    noise_confidence: float = 0.95
    max_ransac_samples: int = 500
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GpsPlacement:
    """Outcome of a placement: accepted when `reason` is None.

    Attributes:
        reason: gate that refused it, or None; `message` says it for people.
        local_from_sfm: the similarity, None where none could be estimated.
        covariance: (7, 7) of its left perturbation (sigma, omega, nu), or None.
        residuals_m: (n, 3) GPS minus placed centre, east, north, up; NaN without a similarity.
        inliers: (n,) bool.
        variance_factor: weighted residuals' variance over the priors' own.
        figures: what the decision rests on, JSON-able.
    """

    reason: GpsReason | None
    message: str
    local_from_sfm: Sim3 | None
    covariance: FloatArray | None
    residuals_m: FloatArray
    inliers: NDArray[np.bool_]
    variance_factor: float
    figures: dict[str, Any] = field(default_factory=dict)

    @property
    def residual_rms_m(self) -> float:
        """Root mean square length of the inliers' residuals, metres."""
        inner = self.residuals_m[self.inliers]
        return float(np.sqrt((inner**2).sum(axis=1).mean())) if len(inner) else float("nan")


def place_by_gps(
    centers_sfm: FloatArray, positions_local: FloatArray, sigmas_m: FloatArray, options: GpsOptions
) -> GpsPlacement:
    """Robust similarity from camera centres to GPS positions.

    Args:
        centers_sfm: (n, 3) camera centres in the reconstruction's frame.
        positions_local: (n, 3) GPS in the local frame, metres.
        sigmas_m: (n, 3) standard deviations of the positions along the local axes.
    """
    count = len(centers_sfm)
    if count < options.min_photos:
        return _refused(
            "TOO_FEW",
            f"{count} registered photos have GPS, at least {options.min_photos} are needed",
            count,
            {"photos_with_gps": count},
        )
    start = _ransac(centers_sfm, positions_local, sigmas_m, options)
    if start is None:
        return _refused(
            "DEGENERATE_LINE", "the camera centres or positions coincide", count, {"photos_with_gps": count}
        )
    sim, inliers = start
    for _ in range(10):  # inliers settle in two or three rounds
        sim = refined_similarity(sim, centers_sfm[inliers], positions_local[inliers], sigmas_m[inliers])
        again = _distances(sim, centers_sfm, positions_local, sigmas_m) <= options.outlier_sigmas
        if (again == inliers).all() or again.sum() < options.min_photos:
            break
        inliers = again
    return _judge(sim, centers_sfm, positions_local, sigmas_m, inliers, options)


def _judge(
    sim: Sim3,
    centers: FloatArray,
    positions: FloatArray,
    sigmas: FloatArray,
    inliers: NDArray[np.bool_],
    options: GpsOptions,
) -> GpsPlacement:
    """Covariance, figures and gates of an estimated similarity."""
    residuals = positions - sim.act(centers)
    used = int(inliers.sum())
    freedom = 3 * used - 7
    weighted = float(((residuals[inliers] / sigmas[inliers]) ** 2).sum())
    factor = weighted / freedom
    spread_ratio = _spread_over_sigma(positions[inliers], sigmas[inliers])
    figures: dict[str, Any] = {
        "photos_with_gps": len(centers),
        "inliers": used,
        "variance_factor": factor,
        "chi_square": weighted,
        "degrees_of_freedom": freedom,
        "chi_square_probability": float(chi2.sf(weighted, freedom)),
        "across_line_over_sigma": spread_ratio,
        "rms_horizontal_m": float(np.sqrt((residuals[inliers, :2] ** 2).sum(axis=1).mean())),
        "rms_vertical_m": float(np.sqrt((residuals[inliers, 2] ** 2).mean())),
        "options": asdict(options),
    }

    def outcome(reason: GpsReason | None, message: str, covariance: FloatArray | None) -> GpsPlacement:
        return GpsPlacement(
            reason=reason,
            message=message,
            local_from_sfm=sim,
            covariance=covariance,
            residuals_m=residuals,
            inliers=inliers,
            variance_factor=factor,
            figures=figures,
        )

    if spread_ratio < options.min_rotation_sigma_ratio:
        return outcome(
            "DEGENERATE_LINE",
            f"the photos lie along a line: {spread_ratio:.1f} sigmas of GPS across it, at least "
            f"{options.min_rotation_sigma_ratio:g} are needed to tell which way is up; add photos "
            "beside the line, or place it by control points (--gcp) or a scan",
            None,
        )
    share = 1.0 - used / len(centers)
    if share > options.max_outlier_share or factor > options.max_variance_factor:
        return outcome(
            "RESIDUALS",
            f"the photos' GPS does not fit the reconstruction: {share:.0%} outliers, the rest "
            f"{factor**0.5:.1f} times their sigma (limits {options.max_outlier_share:.0%} and "
            f"{options.max_variance_factor**0.5:g})",
            None,
        )
    noise = noise_variance_factor(weighted, freedom, options.noise_confidence)
    bias = _bias_shares(residuals[inliers] / sigmas[inliers], freedom)
    covariance = _covariance(sim, centers[inliers], sigmas[inliers], noise, bias)
    figures["noise_variance_factor"] = noise
    figures["bias_sigma_m"] = (np.median(sigmas[inliers], axis=0) * np.sqrt(bias)).tolist()
    figures["scale_sigma"] = float(np.sqrt(covariance[0, 0]))
    if figures["scale_sigma"] > options.max_scale_sigma:
        return outcome(
            "SCALE",
            f"the scale is known to {figures['scale_sigma']:.1%} only, {options.max_scale_sigma:.0%} is "
            "needed: the photos are too close together for their GPS",
            None,
        )
    return outcome(None, "placed by GPS", covariance)


def _covariance(
    sim: Sim3, centers: FloatArray, sigmas: FloatArray, noise_factor: float, bias_shares: FloatArray
) -> FloatArray:
    """(7, 7): noise by the normal equations, plus the shared bias in the translation."""
    jacobian = point_jacobian(sim.act(centers)) / sigmas[:, :, None]
    normal = np.einsum("nij,nik->jk", jacobian, jacobian)
    covariance = np.linalg.inv(normal) * noise_factor
    covariance[4:, 4:] += np.diag(np.median(sigmas, axis=0) ** 2 * bias_shares)
    return np.asarray((covariance + covariance.T) / 2)


def _bias_shares(normalised: FloatArray, freedom: int) -> FloatArray:
    """(3,) share of each axis' variance that is taken for bias, east, north, up: what the noise leaves.

    A height is often off by metres and yet steady to decimetres, steadier than the position: by one noise
    factor for all axes, part of its bias would pass for noise, which averages out. So the height's own
    factor counts where it leaves more to the bias, and likewise that of the horizontal axes. The noise is
    counted as measured here: its upper limit would take from the bias what may be the bias's.

    Args:
        normalised: (n, 3) residuals over sigmas.
        freedom: degrees of freedom of all of them together; they are shared out evenly.
    """
    squared = (normalised**2).sum(axis=0)
    horizontal = float(squared[:2].sum()) / (freedom * 2 / 3)
    vertical = float(squared[2]) / (freedom / 3)
    noise = np.minimum(float(squared.sum()) / freedom, np.array([horizontal, horizontal, vertical]))
    return np.asarray(np.maximum(0.0, 1.0 - noise), dtype=np.float64)


def noise_variance_factor(weighted: float, freedom: float, confidence: float) -> float:
    """Variance of the noise over the square of the sigmas, from the weighted sum of squared residuals.

    Where the residuals are larger than the sigmas say: as measured. Where they are smaller: the upper end
    of the confidence interval, at most 1.
    """
    measured = weighted / freedom
    upper = weighted / float(chi2.ppf(1.0 - confidence, freedom))
    return max(measured, min(1.0, upper))


def _ransac(
    centers: FloatArray, positions: FloatArray, sigmas: FloatArray, options: GpsOptions
) -> tuple[Sim3, NDArray[np.bool_]] | None:
    """The similarity of three photos, or of all, with the smallest truncated sum of squared distances."""
    samples = _samples(len(centers), options)
    best: tuple[float, Sim3] | None = None
    for rows in [np.arange(len(centers)), *samples]:
        sim = similarity_closed_form(centers[rows], positions[rows])
        if sim is None:
            continue
        distances = _distances(sim, centers, positions, sigmas)
        cost = float(np.minimum(distances, options.outlier_sigmas).__pow__(2).sum())
        if best is None or cost < best[0]:
            best = (cost, sim)
    if best is None:
        return None
    inliers = _distances(best[1], centers, positions, sigmas) <= options.outlier_sigmas
    if inliers.sum() < options.min_photos:  # nothing fits: let the gates see all residuals
        inliers = np.ones(len(centers), dtype=bool)
    return best[1], inliers


def _samples(count: int, options: GpsOptions) -> list[NDArray[np.int64]]:
    if count * (count - 1) * (count - 2) // 6 <= options.max_ransac_samples:
        return [np.array(c) for c in itertools.combinations(range(count), 3)]
    generator = np.random.default_rng(options.seed)
    return [generator.choice(count, 3, replace=False) for _ in range(options.max_ransac_samples)]


def _distances(sim: Sim3, centers: FloatArray, positions: FloatArray, sigmas: FloatArray) -> FloatArray:
    """Mahalanobis distance (n,) of each position from its placed centre."""
    return np.asarray(np.sqrt((((positions - sim.act(centers)) / sigmas) ** 2).sum(axis=1)))


def _spread_over_sigma(positions: FloatArray, sigmas: FloatArray) -> float:
    """Root sum of squares of the positions across their main line, over the sigma of GPS in that direction.

    The inverse is about the standard deviation, in radians, of the rotation about the line. A single
    direction across counts: it fixes the rotation, the other does not add to the question.
    """
    centred = positions - positions.mean(axis=0)
    _, values, axes = np.linalg.svd(centred, full_matrices=False)
    sigma_across = float(np.sqrt(((axes[1] * np.median(sigmas, axis=0)) ** 2).sum()))
    return float(values[1]) / sigma_across


def _refused(reason: GpsReason, message: str, count: int, figures: dict[str, Any]) -> GpsPlacement:
    return GpsPlacement(
        reason=reason,
        message=message,
        local_from_sfm=None,
        covariance=None,
        residuals_m=np.full((count, 3), np.nan),
        inliers=np.zeros(count, dtype=bool),
        variance_factor=float("nan"),
        figures=figures,
    )
