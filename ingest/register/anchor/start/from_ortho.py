"""A map without a place, found on a scan whose intensities share no features with photos.

The map's photos are laid out as one small picture from above (`ortho`), whose oriented gradients are compared
with the scan's (`dense.pictures`) at all places, headings and sizes: coarse, then the best of them finer.
What comes out is a start. Whether it is right, frames say that are registered from there one by one.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter

from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import rotation_to_up, so3_exp
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.move import moved_image
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.render.cloud import PointCloud
from ingest.register.anchor.files import PhotoFiles
from ingest.register.anchor.start.from_above import FoundPlace
from ingest.register.anchor.start.ortho import FloatImage, OrthoPicture, picture_of_map, picture_of_scan
from ingest.register.frame.dense.pictures import inner_part, oriented_gradients, plan_spacing_m
from ingest.register.frame.views import searched_sources
from ingest.register.frame_registration import RenderSource

_CELLS = 440  # along the scan's longer side, at most; with 220 a town's streets all look alike
_LEAST_SHARE, _SIZE_STEP = 0.12, 0.06  # of the map's picture over the scan's shorter side; logarithm
_TURN_STEP = np.radians(6.0)
_AGAIN, _AGAIN_STEP = 40, 1.0 / 3.0  # so many are searched again in such parts of the steps
_SMOOTH, _HIGH_PERCENT = 2, 84.0  # degree of a polynomial in logarithms; a deviation over the median
_COVER = 0.4  # of the map that must lie on the scan: `brighton` reaches beyond its scan by half
_LEAST_ENERGY = 0.3  # of the scan's edges under the map, over the mean
_SHRUNK_SIGMA = 0.4  # of the blur before a picture is made smaller, in pixels of the smaller one
_WHOLE = 0.99  # of a pixel that is shown
_NEAR_MIDDLE = 3.0  # of the median distance: points that tell the ground
# Of the best similarity: half a step of the finer search, what a vertical is good to by photos and by the
# ground, the lean of houses and a cell and a half, and what relief leaves of the height.
_SIZE_SIGMA, _TURN_SIGMA = 0.02, np.radians(2.0)
_TILT_SIGMA, _SLOPE_SIGMA = np.radians(2.0), np.radians(10.0)
_PLAN_SIGMA_M, _PLAN_CELLS, _HEIGHT_SIGMA_M = 2.0, 1.5, 3.0
# The harmonic of the angle doubled; the other one tells little more. Frequencies that are strong in the scan
# count for less: by the root of their power, smoothed over so many frequencies.
_CHANNELS, _POWER_SIGMA, _LEAST_POWER = 2, 3.0, 1e-3
_TINY = 1e-12
_INSIDE = 2  # cells from the border of what is shown that show no edge
_LEAST_SHOWN = 100  # cells inside: fewer agree with anything


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlanTry:
    """A map from above, tried at a place.

    Attributes:
        size: metres of a cell or unit. turn: radians, x to y. middle: (2,) metres, where its middle lies.
        agreeing: with the scan there.
    """

    size: float
    turn: float
    middle: FloatArray
    agreeing: float

    def apart(self, other: "PlanTry") -> tuple[float, float]:
        """Metres and radians between two."""
        turn = abs((self.turn - other.turn + np.pi) % (2.0 * np.pi) - np.pi)
        return float(np.linalg.norm(self.middle - other.middle)), float(turn)

    def similarity(self, picture: OrthoPicture, up: float) -> Sim3:
        """That lays the picture there, the median of its heights at `up`."""
        scale, turn = self.size / picture.cell, so3_exp([0.0, 0.0, self.turn])
        middle = np.array([*picture.middle, float(np.median(picture.height[picture.valid]))])
        there = np.array([*self.middle, up])
        return Sim3(scale=scale, rotation=turn, translation=there - scale * turn @ middle)


_OverChance = Callable[[PlanTry], float]  # deviations


def first_apart(
    tries: Iterable[PlanTry], same: Callable[[PlanTry, PlanTry], bool], most: int
) -> list[PlanTry]:
    """The first of those that are not the same as a better one, at most so many."""
    kept: list[PlanTry] = []
    for one in tries:
        if not any(same(one, other) for other in kept):
            kept.append(one)
        if len(kept) == most:
            break
    return kept


class ScanSearch:
    """The scan's gradients in the frequency domain.

    Args:
        least_cover: share of what a picture shows that must lie on the scan.
    """

    def __init__(self, picture: OrthoPicture, least_cover: float = _COVER) -> None:
        self.picture, self._least_cover = picture, least_cover
        channels = oriented_gradients(picture.gray, picture.valid)[:_CHANNELS]
        self._shape = [fft.next_fast_len(n, real=True) for n in picture.gray.shape]
        spectra = np.array([self._forward(channel) for channel in channels])
        power = gaussian_filter(np.square(np.abs(spectra)).sum(axis=0), _POWER_SIGMA, mode=("wrap", "mirror"))
        self._channels = spectra / np.sqrt(power + _LEAST_POWER * power.mean() + _TINY)
        height, width = picture.gray.shape
        energy = np.square([self._back(of)[:height, :width] for of in self._channels]).sum(axis=0)
        self._energy, self._valid = self._forward(energy), self._forward(picture.valid)
        self._mean = float(energy[picture.valid].mean()) if picture.valid.any() else np.inf

    def best(self, of: OrthoPicture, size: float, turn: float) -> PlanTry | None:
        """The best place of a picture; None where it lies nowhere on the scan."""
        scale = size / self.picture.cell
        gray, valid, matrix = _turned(of, scale, turn)
        inner = inner_part(valid, _INSIDE)
        if np.count_nonzero(inner) < _LEAST_SHOWN:
            return None
        # Corners that show nothing may lie beside the scan.
        held = [np.flatnonzero(inner.any(axis=axis)) for axis in (1, 0)]
        there = tuple(slice(of[0], of[-1] + 1) for of in held)
        mask = inner[there]
        rows, columns = (n - k + 1 for n, k in zip(self.picture.gray.shape, mask.shape, strict=True))
        if rows <= 0 or columns <= 0:
            return None
        channels = oriented_gradients(gray, valid)[:_CHANNELS, *there] * mask
        shown = np.conj(self._forward(mask))
        cells = float(mask.sum())
        agreeing = [a * np.conj(self._forward(b)) for a, b in zip(self._channels, channels, strict=True)]
        found = self._back(np.sum(agreeing, axis=0))[:rows, :columns]
        energy = self._back(self._energy * shown)[:rows, :columns]
        cover = self._back(self._valid * shown)[:rows, :columns] / cells
        usable = (cover > self._least_cover) & (energy > _LEAST_ENERGY * self._mean * cells * cover)
        if not usable.any():
            return None
        own = self._back(self._valid * np.conj(self._forward(np.square(channels).sum(axis=0))))
        own = own[:rows, :columns]  # where the scan shows something; less of it agrees more easily
        share = cover / np.maximum(energy * own, 1e-12)
        score = np.where(usable, found * np.sqrt(share, where=usable, out=np.zeros_like(cover)), -1.0)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        first = np.array([column - held[1][0], row - held[0][0]])
        at = first + matrix @ np.array([of.gray.shape[1] / 2, of.gray.shape[0] / 2, 1.0])
        middle = self.picture.corner + at * self.picture.cell
        return PlanTry(size=size, turn=turn, middle=middle, agreeing=float(score[row, column]))

    def _forward(self, of: NDArray[np.generic]) -> NDArray[np.complex64]:
        return np.asarray(fft.rfft2(np.asarray(of, dtype=np.float32), self._shape))

    def _back(self, of: NDArray[np.complex64]) -> FloatImage:
        return np.asarray(fft.irfft2(of, self._shape))


def found_by_ortho(unplaced: UnplacedMap, cloud: PointCloud, photos: PhotoFiles) -> FoundPlace | None:
    """The best place of a map on all of a scan; None where its mirror image fits as well.

    Its evidence is in deviations, as in `best_place`, and never enough to be sure; its covariance by the
    steps of the search.
    """
    upright = _upright(unplaced)
    there = [image for image in unplaced.images if image.image_id in photos.paths]
    images = [moved_image(image, upright) for image in there]
    picture = picture_of_map(upright.act(unplaced.points.xyz), images, unplaced.cameras, photos.gray)
    if picture is None:
        return None
    found = [
        _found(picture, cloud, source, upright, unplaced.frame.upright) for source in searched_sources(cloud)
    ]
    return max((one for one in found if one is not None), key=lambda one: one.evidence, default=None)


def _found(
    picture: OrthoPicture, cloud: PointCloud, source: RenderSource, upright: Sim3, by_photos: bool
) -> FoundPlace | None:
    """The best place by one property of the scan; `upright` from the own frame, by photos or the ground."""
    extent_m = float(np.ptp(cloud.xyz[:, :2], axis=0).max())
    drawn = picture_of_scan(cloud, source, max(extent_m / _CELLS, plan_spacing_m(cloud)))
    found = best_place(picture, drawn)
    if found is None or found[1] <= found[2]:
        return None
    best, over_chance, elsewhere = found
    up = float(np.nanmedian(_under(drawn, picture, best)))
    tilt = _TILT_SIGMA if by_photos else _SLOPE_SIGMA
    plan_m = float(np.hypot(_PLAN_SIGMA_M, _PLAN_CELLS * drawn.cell))
    sigmas = [_SIZE_SIGMA, tilt, tilt, _TURN_SIGMA, plan_m, plan_m, _HEIGHT_SIGMA_M]
    return FoundPlace(
        local_from_own=best.similarity(picture, up) @ upright,
        covariance=Sim3.shift(np.array([*best.middle, up])).carried(np.diag(np.square(sigmas))),
        evidence=over_chance,
        sure=False,  # chance alone passes in one case of two: it is up to the photos that are registered
        words=f"its photos from above agree with the scan's {source} by {over_chance:.1f} deviations "
        f"more than their mirror images, elsewhere by {elsewhere:.1f}",
    )


def best_place(picture: OrthoPicture, drawn: OrthoPicture) -> tuple[PlanTry, float, float] | None:
    """Where a picture of whatever unit agrees best with one in metres; None where it fits nowhere on it.

    Returns:
        The place; its correlation over those of the mirrored picture, which is nowhere, in deviations; and
        the same of the best with another heading or place, or of the mirrored picture over the picture.
    """
    searched, longer = ScanSearch(drawn), max(picture.gray.shape)
    extent_m = min(drawn.gray.shape) * drawn.cell
    sizes = np.exp(np.arange(np.log(_LEAST_SHARE), 0.0, _SIZE_STEP)) * extent_m / longer
    turns = np.arange(0.0, 2.0 * np.pi, _TURN_STEP)
    tries = _tried(searched, picture, sizes, turns)
    mirrored = _tried(searched, picture.mirrored(), sizes, turns)
    chance, other_chance = (_over_chance(of, len(turns)) for of in (mirrored, tries))
    if chance is None or other_chance is None:
        return None
    again = _again(searched, picture, tries, chance)
    best = max(again, key=chance)
    others = [chance(one) for one in again if _apart(one, best, longer)]
    # A symmetric building agrees with its mirror image, at the size that is right.
    for one in _again(searched, picture.mirrored(), mirrored, other_chance):
        if abs(np.log(one.size / best.size)) > 1.5 * _SIZE_STEP:
            others.append(other_chance(one))
    return best, chance(best), max(others, default=-np.inf)


def _again(
    scan: ScanSearch, picture: OrthoPicture, tries: Sequence[PlanTry], chance: _OverChance
) -> list[PlanTry]:
    """The best of the tries with finer steps around them."""
    steps = np.array([-1.0, 0.0, 1.0]) * _AGAIN_STEP
    found: list[PlanTry] = []
    for one in sorted(tries, key=chance, reverse=True)[:_AGAIN]:
        found += _tried(scan, picture, one.size * np.exp(_SIZE_STEP * steps), one.turn + _TURN_STEP * steps)
    return found


def _tried(scan: ScanSearch, picture: OrthoPicture, sizes: FloatArray, turns: FloatArray) -> list[PlanTry]:
    found = (scan.best(picture, size, turn) for size in sizes.tolist() for turn in turns.tolist())
    return [one for one in found if one is not None]


def _over_chance(tries: Sequence[PlanTry], turns: int) -> _OverChance | None:
    """By how many deviations of `tries` of its size a correlation exceeds their median.

    Both figures are smooth in the size. Sizes at which not all `turns` fit say nothing.
    """
    sizes, fitting = np.unique([one.size for one in tries], return_counts=True)
    sizes = sizes[fitting == turns]
    if len(sizes) <= _SMOOTH:
        return None
    at_size = [[one.agreeing for one in tries if one.size == size] for size in sizes]
    middle, high = np.percentile(at_size, (50.0, _HIGH_PERCENT), axis=1)
    if middle.min() <= 0.0 or (high <= middle).any():
        return None
    middles = np.polyfit(np.log(sizes), np.log(middle), _SMOOTH)
    spreads = np.polyfit(np.log(sizes), np.log(high - middle), 1)
    play = float(np.exp(_SIZE_STEP / 2))

    def over(one: PlanTry) -> float:
        if not sizes[0] / play <= one.size <= sizes[-1] * play:
            return -np.inf
        at, spread = (float(np.exp(np.polyval(of, np.log(one.size)))) for of in (middles, spreads))
        return (one.agreeing - at) / spread

    return over


def _apart(one: PlanTry, other: PlanTry, cells: int) -> bool:
    """Whether two tries lie a tenth of the picture or two steps of the heading apart."""
    away, turn = one.apart(other)
    return turn > 2.0 * _TURN_STEP or away > 0.1 * cells * other.size


def _under(scan: OrthoPicture, picture: OrthoPicture, found: PlanTry) -> FloatArray:
    """Heights of the scan under the map's picture."""
    _, valid, matrix = _turned(picture, found.size / scan.cell, found.turn)
    half = matrix @ np.array([picture.gray.shape[1] / 2, picture.gray.shape[0] / 2, 1.0])
    column, row = np.round((found.middle - scan.corner) / scan.cell - half).astype(np.int64)
    cells = np.argwhere(valid) + np.array([row, column])
    cells = cells[((cells >= 0) & (cells < scan.height.shape)).all(axis=1)]
    return np.asarray(scan.height[tuple(cells.T)])


def _turned(
    picture: OrthoPicture, scale: float, turn: float
) -> tuple[FloatImage, NDArray[np.bool_], FloatArray]:
    """The picture turned and resized, and the (2, 3) that takes its coordinates there."""
    height, width = picture.gray.shape
    cos, sin = scale * np.cos(turn), scale * np.sin(turn)
    matrix = np.array([[cos, -sin], [sin, cos]])
    half = np.array([width, height]) / 2
    size = np.ceil(2.0 * (np.abs(matrix) @ half)).astype(np.int64) + 2
    whole = np.column_stack([matrix, size / 2 - matrix @ half])
    by_pixel = whole.copy()
    by_pixel[:, 2] += matrix @ [0.5, 0.5] - 0.5  # OpenCV's half pixel
    gray = picture.gray
    if scale < 1.0:
        gray = np.asarray(cv2.GaussianBlur(gray, (0, 0), _SHRUNK_SIGMA / scale))
    shape = (int(size[0]), int(size[1]))
    turned = cv2.warpAffine(gray, by_pixel, shape, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    valid = cv2.warpAffine(picture.valid.astype(np.float32), by_pixel, shape, flags=cv2.INTER_LINEAR) > _WHOLE
    return np.asarray(turned, dtype=np.float32), np.asarray(valid), whole


def _upright(unplaced: UnplacedMap) -> Sim3:
    """The map's own frame turned until z is up: by its photos, or else by the ground that it shows."""
    rotation = np.eye(3)
    if not unplaced.frame.upright:
        middle = np.median(unplaced.points.xyz, axis=0)
        xyz = unplaced.points.xyz - middle
        away = np.linalg.norm(xyz, axis=1)
        near = xyz[away < _NEAR_MIDDLE * np.median(away)]
        across = np.linalg.svd(near, full_matrices=False)[2][2]
        above = np.mean([image.cam_from_local.center for image in unplaced.images], axis=0)
        rotation = rotation_to_up(across * np.sign(across @ (above - middle)))
    return Sim3(scale=1.0, rotation=rotation, translation=np.zeros(3))
