"""Intensity refinement: the pose at which a photo and a scan's picture agree best (paper, section 2.3).

A study: the fit to dense pieces is more accurate (docs/registration.md), so registration does without it;
`python -m tools.frame_real_photos --refine` shows what it does to real photos.

The measure is mutual information combined with gradient correlation, maximised over se(3) by downhill
simplex at three octaves. Drawing the scan for each of some hundred evaluations would take most of the time
allowed, and a picture of splats changes in steps when a point moves into the next pixel. So the scan is
drawn once per octave, at the pose where the octave starts; from that picture come scan points with their
values and with gradients, and an evaluation projects the points by the pose at hand and samples the photo,
smoothly, at their pixels. What is hidden changes little over the few pixels that a refinement moves.

Gradients are compared as the oriented channels of `oriented_gradients`, the photo's sampled at the points:
unlike derivatives in image axes they bear contrast that turns round, which between laser intensity and photo
is the rule.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from featuredb.geometry.arrays import FloatArray, frozen_array
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.render.cloud import PointCloud
from featuredb.render.renderer import RenderOptions, render
from ingest.register.frame.dense.pictures import (
    FloatImage,
    PinholeView,
    finest_side_px,
    inner_part,
    oriented_gradients,
    pinhole_view,
    source_picture,
)
from ingest.register.frame_registration import RenderSource

_BINS = 24  # some ten thousand samples fill 24 x 24 bins with about twenty each
_LEAST_SAMPLES = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class IntensityOptions:
    """Settings of the refinement.

    Attributes:
        octaves: how many; each halves the picture.
        side_px: longer side at the finest octave, where the scan is dense enough.
        finest_spacing: a pixel is at least this share of the mean distance between scan points.
        max_samples: scan points per octave.
        information_weight, gradient_weight: of normalised mutual information and of the correlation of
            oriented gradients. The first is a few hundredths for laser intensity, the second some tenths;
            the weights make both fall by about the same over the width of their peak.
        simplex_px: how far the corners of the first simplex move the picture.
        leash_px: the refined pose may not move the picture by more than this many pixels of the coarsest
            octave, root mean square over the samples; a pose that does has left the evidence, and the start
            is kept.
        min_gain: nor is a pose kept that raises the measure by less.
        sigma_px: standard deviation, in pixels of the finest octave, of how far the refined picture lies off;
            scales the covariance. A judgement, not calibrated: edges in laser intensity and photo differ by
            about a pixel, and the average over many by less.
        max_evaluations: per octave.
    """

    octaves: int = 3
    side_px: int = 640
    finest_spacing: float = 1.0
    max_samples: int = 12_000
    information_weight: float = 4.0
    gradient_weight: float = 1.0
    simplex_px: float = 1.5
    leash_px: float = 5.0
    min_gain: float = 0.0
    sigma_px: float = 0.7
    max_evaluations: int = 250


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IntensityRefinement:
    """A pose before and after.

    Attributes:
        cam_from_local: refined, or the start where `moved` is False.
        covariance: (6, 6) of the left perturbation, from the curvature of the measure; None where the
            measure is no maximum there or nothing was compared.
        moved: whether the refinement was kept.
        information, gradients: normalised mutual information and correlation of oriented gradients at the
            result, at the finest octave; `*_before` at the start.
        shift_px: root mean square movement of the picture, pixels of the photo.
        samples: scan points compared at the finest octave.
        message: why the start was kept, or "".
    """

    cam_from_local: Rigid3
    covariance: FloatArray | None
    moved: bool
    information: float
    gradients: float
    information_before: float
    gradients_before: float
    shift_px: float
    samples: int
    message: str

    def __post_init__(self) -> None:
        if self.covariance is not None:
            value = frozen_array("IntensityRefinement.covariance", self.covariance, (6, 6))
            object.__setattr__(self, "covariance", value)


def refine_by_intensity(
    photo_gray: NDArray[np.uint8],
    camera: Camera,
    cam_from_local: Rigid3,
    cloud: PointCloud,
    source: RenderSource = "intensity",
    options: IntensityOptions = IntensityOptions(),
) -> IntensityRefinement:
    """Maximises the agreement of pictures around a pose that is a few pixels off at most.

    Args:
        photo_gray: (h, w) uint8 of `camera`'s size.
        source: which picture of the scan is compared.
    """
    finest = min(options.side_px, finest_side_px(camera, cam_from_local, cloud, options.finest_spacing))
    pose = cam_from_local
    octave: _Octave | None = None
    for level in range(options.octaves - 1, -1, -1):
        view = pinhole_view(photo_gray, camera, max(finest >> level, 48))
        octave = _octave(view, pose, cloud, source, options)
        if len(octave.points) < _LEAST_SAMPLES:
            return _kept(cam_from_local, octave, f"only {len(octave.points)} scan points to compare")
        pose = _climb(octave, pose, options)
    assert octave is not None
    shift = octave.shift_px(cam_from_local, pose)
    leash = options.leash_px * 2 ** (options.octaves - 1)
    before, after = octave.measures(cam_from_local), octave.measures(pose)
    gain = octave.measure(pose, options) - octave.measure(cam_from_local, options)
    if shift > leash:
        return _kept(cam_from_local, octave, f"it moved by {shift:.1f} px, more than {leash:.0f} px allowed")
    if gain <= options.min_gain:
        return _kept(cam_from_local, octave, "no pose nearby agrees better")
    return IntensityRefinement(
        cam_from_local=pose,
        covariance=_covariance(octave, pose, options),
        moved=True,
        information=after[0],
        gradients=after[1],
        information_before=before[0],
        gradients_before=before[1],
        shift_px=shift * max(camera.width, camera.height) / max(octave.camera.width, octave.camera.height),
        samples=len(octave.points),
        message="",
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Octave:
    """What is compared at one octave: scan points with values and channels, and the photo.

    Attributes:
        points: (n, 3) float64, local frame. bins: (n,) grey value of each. channels: (n, k) oriented
            gradients.
        photo: (h, w, 1 + k) float32: bin number of the smoothed photo, and its channels.
    """

    points: FloatArray
    bins: NDArray[np.int64]
    channels: FloatImage
    photo: FloatImage
    camera: Camera

    def pixels(self, pose: Rigid3) -> NDArray[np.float32]:
        cam = pose.act(self.points)
        focal, cx, cy = self.camera.params
        pixels = cam[:, :2] / np.maximum(cam[:, 2:], 1e-3) * focal + (cx, cy)
        return np.asarray(pixels, dtype=np.float32)

    def shift_px(self, first: Rigid3, second: Rigid3) -> float:
        """Root mean square distance of the samples' pixels between two poses."""
        moved = self.pixels(first) - self.pixels(second)
        return float(np.sqrt(np.mean(np.sum(moved.astype(np.float64) ** 2, axis=1))))

    def measures(self, pose: Rigid3) -> tuple[float, float]:
        """Normalised mutual information and correlation of oriented gradients."""
        pixels = self.pixels(pose) - np.float32(0.5)
        h, w = self.photo.shape[:2]
        inside = ((pixels >= 0) & (pixels <= (w - 1, h - 1))).all(axis=1)
        if inside.sum() < _LEAST_SAMPLES:
            return 0.0, 0.0
        x, y = pixels[inside].T
        seen = _bilinear(self.photo, x, y)
        ours = self.channels[inside]
        theirs = seen[:, 1:]
        norm = float(
            np.sqrt(np.sum(ours * ours, dtype=np.float64) * np.sum(theirs * theirs, dtype=np.float64))
        )
        gradients = float(np.sum(ours * theirs, dtype=np.float64)) / norm if norm > 1e-9 else 0.0
        return normalised_information(_shared_histogram(self.bins[inside], seen[:, 0])), gradients

    def measure(self, pose: Rigid3, options: IntensityOptions) -> float:
        information, gradients = self.measures(pose)
        return options.information_weight * information + options.gradient_weight * gradients


def _octave(
    view: PinholeView, pose: Rigid3, cloud: PointCloud, source: RenderSource, options: IntensityOptions
) -> _Octave:
    rendering = render(cloud, view.camera, pose, RenderOptions(threads=1))
    picture = source_picture(rendering, source)
    channels = oriented_gradients(picture, rendering.valid)
    smooth = cv2.GaussianBlur(view.image.astype(np.float32), (0, 0), 0.7)
    photo = np.concatenate([_soft_bins(smooth)[None], oriented_gradients(view.image, view.valid)])
    usable = inner_part(rendering.valid, 2) & view.valid
    rows, columns = np.nonzero(usable)
    if len(rows) > options.max_samples:
        # Even and the same each time; a fixed stride would fall into step with rows.
        chosen = np.sort(np.random.default_rng(0).choice(len(rows), options.max_samples, replace=False))
        rows, columns = rows[chosen], columns[chosen]
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1)
    rays = np.column_stack([view.camera.unproject(pixels), np.ones(len(pixels))])
    points_cam = rays * rendering.depth[rows, columns, None].astype(np.float64)
    return _Octave(
        points=pose.inverse().act(points_cam),
        bins=np.clip(_soft_bins(picture)[rows, columns], 0, _BINS - 1).round().astype(np.int64),
        channels=np.ascontiguousarray(channels[:, rows, columns].T),
        photo=np.ascontiguousarray(photo.transpose(1, 2, 0)),
        camera=view.camera,
    )


def _soft_bins(picture: FloatImage) -> FloatImage:
    """Grey values as fractional bin numbers, equally wide between the 1st and the 99th percentile."""
    low, high = np.percentile(picture, (1.0, 99.0))
    scaled = (picture - low) / max(high - low, 1e-6) * (_BINS - 1)
    return np.asarray(np.clip(scaled, 0, _BINS - 1.001), dtype=np.float32)


def _shared_histogram(bins: NDArray[np.int64], fractional: NDArray[np.float32]) -> FloatArray:
    """Joint histogram; each sample is shared between the two bins nearest to it: smooth in the pose."""
    lower = fractional.astype(np.int64)
    upper_part = (fractional - lower).astype(np.float64)
    index = bins * _BINS + lower
    size = _BINS * _BINS
    joint = np.bincount(index, 1.0 - upper_part, minlength=size)
    joint += np.bincount(np.minimum(index + 1, size - 1), upper_part, minlength=size)
    return joint.reshape(_BINS, _BINS).astype(np.float64)


def _bilinear(picture: FloatImage, x: NDArray[np.float32], y: NDArray[np.float32]) -> FloatImage:
    """Values (n, c) of a picture (h, w, c) at positions inside it."""
    h, w, c = picture.shape
    column = np.minimum(x.astype(np.int32), w - 2)
    row = np.minimum(y.astype(np.int32), h - 2)
    fx, fy = (x - column)[:, None], (y - row)[:, None]
    flat = picture.reshape(-1, c)
    at = row * w + column
    top = flat[at] * (1 - fx) + flat[at + 1] * fx
    bottom = flat[at + w] * (1 - fx) + flat[at + w + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, dtype=np.float32)


def _steps(octave: _Octave, pose: Rigid3, pixels: float) -> FloatArray:
    """Per axis of se(3), the step that moves the samples by that many pixels, root mean square."""
    small = np.array([1e-4, 1e-4, 1e-4, 1e-2, 1e-2, 1e-2])
    effect = [octave.shift_px(Rigid3.exp(small * axis) @ pose, pose) for axis in np.eye(6)]
    return small * pixels / np.maximum(effect, 1e-6)


def _climb(octave: _Octave, pose: Rigid3, options: IntensityOptions) -> Rigid3:
    """The pose that a downhill simplex reaches from another at one octave."""
    scale = _steps(octave, pose, options.simplex_px)

    def cost(step: FloatArray) -> float:
        return -octave.measure(Rigid3.exp(step * scale) @ pose, options)

    result = minimize(
        cost,
        np.zeros(6),
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([np.zeros(6), np.eye(6)]) - 1.0 / 7.0,
            "maxfev": options.max_evaluations,
            "xatol": 0.02,
            "fatol": 1e-5,
        },
    )
    return Rigid3.exp(result.x * scale) @ pose


def _covariance(octave: _Octave, pose: Rigid3, options: IntensityOptions) -> FloatArray | None:
    """Inverse curvature of the measure, scaled so that the picture's own error is `sigma_px`.

    The curvature is the Gauss-Newton one: each sample ties the pose as firmly as the photo's channels change
    around its pixel, and only across edges. Second differences of the measure itself would be drowned, in
    directions where a turn and a step move the picture alike, by what it loses through not being a parabola.
    Pixels are not independent, so the curvature gives the shape of the uncertainty, which directions are
    known well and which are traded for each other, but not its size; the size is set by what was measured.
    """
    some = slice(None, None, max(1, len(octave.points) // 2000))
    jacobian = _pixel_jacobian(octave, pose, some)
    pixels = octave.pixels(pose)[some] - np.float32(0.5)
    h, w = octave.photo.shape[:2]
    inside = ((pixels >= 1) & (pixels <= (w - 2, h - 2))).all(axis=1)
    if inside.sum() < 50:
        return None
    x, y = pixels[inside].T
    half = np.float32(0.5)
    across = _bilinear(octave.photo, x + half, y)[:, 1:] - _bilinear(octave.photo, x - half, y)[:, 1:]
    down = _bilinear(octave.photo, x, y + half)[:, 1:] - _bilinear(octave.photo, x, y - half)[:, 1:]
    slopes = np.stack([across, down], axis=2).astype(np.float64)
    jacobian = jacobian[inside]
    curvature = np.einsum("nka,nai,nkb,nbj->ij", slopes, jacobian, slopes, jacobian, optimize=True)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    values, vectors = np.linalg.eigh(curvature * np.outer(scale, scale))
    if values[0] <= 1e-12 * values[-1]:
        return None
    shape = np.outer(scale, scale) * ((vectors / values) @ vectors.T)
    spread = float(np.mean(np.einsum("nij,jk,nik->n", jacobian, shape, jacobian)))
    return np.asarray(shape * (options.sigma_px**2 / max(spread, 1e-12)), dtype=np.float64)


def _pixel_jacobian(octave: _Octave, pose: Rigid3, some: slice) -> FloatArray:
    """(m, 2, 6) derivatives of some of the samples' pixels by the left perturbation."""
    x, y, z = pose.act(octave.points[some]).T
    focal = octave.camera.params[0]
    zero = np.zeros(len(x))
    by_point = focal * np.array([[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]).transpose(2, 0, 1)
    # d(exp(xi) p) = omega x p + nu
    turned = np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]).transpose(2, 0, 1)
    by_pose = np.concatenate([turned, np.broadcast_to(np.eye(3), (len(x), 3, 3))], axis=2)
    return np.asarray(by_point @ by_pose, dtype=np.float64)


def _kept(start: Rigid3, octave: _Octave, message: str) -> IntensityRefinement:
    information, gradients = octave.measures(start)
    return IntensityRefinement(
        cam_from_local=start,
        covariance=None,
        moved=False,
        information=information,
        gradients=gradients,
        information_before=information,
        gradients_before=gradients,
        shift_px=0.0,
        samples=len(octave.points),
        message=message,
    )


def normalised_information(joint: FloatArray) -> float:
    """Mutual information of a joint histogram of counts, (H(A) + H(B)) / H(A, B) - 1.

    Studholme, Hill, Hawkes 1999, less one: it does not grow when the overlap shrinks to something busy.
    """
    p = joint / max(float(joint.sum()), 1e-300)
    both = _entropy(p.ravel())
    return (_entropy(p.sum(axis=1)) + _entropy(p.sum(axis=0))) / both - 1.0 if both > 1e-12 else 0.0


def _entropy(p: FloatArray) -> float:
    q = p[p > 0]
    return float(-np.sum(q * np.log(q)))
