"""SIFT's scale space of one image: keypoints are found in it, turned and described.

In half of OpenCV's time, and with as many matches (row `sift` of docs/measurements.md; decision 0015).
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from types import ModuleType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.compiled import compiled_module, mapped, opencv_threads
from featuredb.errors import ImageError
from featuredb.features.shrink import fitted_size, shrunk
from featuredb.geometry.arrays import FloatArray

LAYERS, SIGMA = 3, 1.6
X, Y, SCALE, OCTAVE, LAYER, RESPONSE = range(6)  # of a keypoint's row, as the loops have them
_CAMERA_BLUR = 0.5  # of any photo, in its pixels
_LEAST_PX = 12  # a side of an octave: less has no extrema
_BAND_ROWS = 200  # for a thread at least
_AT_ONCE = 500  # keypoints for a thread
_MOST_ORIENTATIONS = 18  # of a keypoint: each second direction can be a peak

_Part = tuple[NDArray[np.float32], NDArray[np.intp]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScaleSpacePoints:
    """Keypoints in the scale space of an image.

    Attributes:
        rows: (n, 6) float32: x, y and scale in the octave's pixels, octave, layer, response (`sift_loops`).
    """

    rows: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: NDArray[Any]) -> "ScaleSpacePoints":
        """Those of the given rows (index or boolean array), in that order."""
        return ScaleSpacePoints(rows=self.rows[chosen])

    @property
    def _pixels(self) -> NDArray[np.float32]:
        """(n,) pixels of the first octave in one of the keypoint's."""
        return np.asarray(2.0 ** self.rows[:, OCTAVE], dtype=np.float32)

    @property
    def xy(self) -> NDArray[np.float32]:
        """(n, 2) pixels of the first octave; centre of the top-left pixel (0.5, 0.5), as in each octave."""
        return (self.rows[:, :2] * self._pixels[:, None] + np.float32(0.5)).astype(np.float32)

    @property
    def diameter(self) -> NDArray[np.float32]:
        """(n,) pixels of the first octave: twice the scale."""
        return 2.0 * self.rows[:, SCALE] * self._pixels

    @property
    def response(self) -> NDArray[np.float32]:
        """(n,) contrast of the extremum, in grey levels from 0 to 1."""
        return self.rows[:, RESPONSE]

    @classmethod
    def at(cls, xy: FloatArray, diameter: FloatArray, octaves: int) -> Self:
        """Where the scale space would have found keypoints of these places (n, 2) and diameters (n,).

        Both in pixels of the first octave. One between two layers may get the other one. Those too large for
        its octaves are in the last.

        Raises:
            ImageError: a place or diameter is no finite number, or a diameter is not above zero.
        """
        if not (np.isfinite(xy).all() and np.isfinite(diameter).all() and (diameter > 0.0).all()):
            raise ImageError("expected keypoints with finite places and diameters above 0 px, found others")
        step = np.rint(LAYERS * np.log2(diameter / (2.0 * SIGMA)))
        octave = np.clip((step - 1) // LAYERS, 0, octaves - 1)
        layer = np.clip(step - LAYERS * octave, 0, LAYERS)
        pixels = 2.0**octave
        rows = [
            (xy[:, 0] - 0.5) / pixels,
            (xy[:, 1] - 0.5) / pixels,
            0.5 * diameter / pixels,
            octave,
            layer,
            np.ones(len(xy)),
        ]
        return cls(rows=np.column_stack(rows).astype(np.float32))


class ScaleSpace:
    """Octaves of an image.

    On as many threads as OpenCV may use in this process, up to four; results are the same for any number.

    Attributes:
        width, height: of the first octave.
    """

    def __init__(self, gray: NDArray[np.uint8], side_px: int) -> None:
        """
        Args:
            gray: (h, w) uint8.
            side_px: longer side of the first octave; of a small image at most twice its own.
        """
        self._gray = gray
        longer = max(gray.shape)
        self._enlarged = min(max(side_px / longer, 1.0), 2.0)
        height, width = gray.shape
        if self._enlarged == 1.0:
            self.width, self.height = fitted_size(width, height, side_px)
        else:
            self.width, self.height = round(width * self._enlarged), round(height * self._enlarged)
        self._threads = opencv_threads()

    @cached_property
    def octaves(self) -> list[NDArray[np.float32]]:
        """(6, h, w) each: blurred by 1.6 pixels and by a third of an octave more each time."""
        camera_blur = self._enlarged * _CAMERA_BLUR
        first = self._blurred(self._resized, (SIGMA**2 - camera_blur**2) ** 0.5)
        octaves: list[NDArray[np.float32]] = []
        while not octaves or min(first.shape) >= _LEAST_PX:
            octave = np.empty((LAYERS + 3, *first.shape), np.float32)
            octave[0] = first
            for layer in range(1, LAYERS + 3):
                more = SIGMA * (4.0 ** (layer / LAYERS) - 4.0 ** ((layer - 1) / LAYERS)) ** 0.5
                self._blurred(octave[layer - 1], more, octave[layer])
            octaves.append(octave)
            first = octave[LAYERS, ::2, ::2]
        return octaves

    @property
    def _resized(self) -> NDArray[np.float32]:
        # Whole grey levels would be too coarse between the pixels.
        if self._enlarged == 1.0:
            return shrunk(self._gray, max(self.width, self.height)).astype(np.float32, order="C")
        size = (self.width, self.height)
        enlarged = cv2.resize(self._gray.astype(np.float32, order="C"), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(enlarged, dtype=np.float32)

    def _blurred(
        self, image: NDArray[np.float32], sigma_px: float, out: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """The image (h, w) blurred by a Gaussian, cut at four standard deviations as in OpenCV's SIFT."""
        out = np.empty_like(image) if out is None else out
        kernel = cv2.getGaussianKernel(round(8.0 * sigma_px + 1.0) | 1, sigma_px, cv2.CV_32F)
        weights = np.ascontiguousarray(kernel[len(kernel) // 2 :, 0])
        pyramid = compiled_module("featuredb.features.pyramid_loops")
        mapped(lambda rows: pyramid.blur(image, weights, *rows, out), self._bands(len(image)), self._threads)
        return out

    def keypoints(self, contrast_threshold: float, edge_threshold: float) -> ScaleSpacePoints:
        """All extrema of at least this contrast that are no edges (OpenCV's thresholds), strongest first."""

        def found(where: tuple[int, tuple[int, int]]) -> NDArray[np.float32]:
            number, rows = where
            extrema: NDArray[np.float32] = _loops().extrema(
                self.octaves[number], number, SIGMA, *rows, contrast_threshold, edge_threshold
            )
            return extrema

        bands = [(n, rows) for n, one in enumerate(self.octaves) for rows in self._bands(one.shape[1])]
        rows = np.concatenate(mapped(found, bands, self._threads))
        # Neighbouring pixels may be refined to one place.
        rows = rows[np.lexsort((rows[:, Y], rows[:, X], -rows[:, RESPONSE]))]
        new = (np.diff(rows, axis=0) != 0).any(axis=1)
        return ScaleSpacePoints(rows=rows[np.append(np.ones(min(len(rows), 1), np.bool_), new)])

    def orientations(self, points: ScaleSpacePoints) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Angles (n, 18), degrees in [0, 360) clockwise from the x axis, of each the strongest first, and
        how many of them (n,) each keypoint has.
        """
        angles = np.zeros((len(points), _MOST_ORIENTATIONS), np.float32)
        counts = np.zeros(len(points), np.int64)

        def turn(part: _Part) -> None:
            octave, mine = part
            own = np.zeros((len(mine), _MOST_ORIENTATIONS), np.float32)
            counts[mine] = _loops().orientations(octave, points.rows[mine], own)
            angles[mine] = own

        mapped(turn, self._parts(points), self._threads)
        return angles % np.float32(360.0), counts

    def descriptors(self, points: ScaleSpacePoints, angle: NDArray[np.float32]) -> NDArray[np.float32]:
        """SIFT (n, 128) of keypoints turned by angles (n,), of any length."""
        found = np.zeros((len(points), 128), np.float32)

        def describe(part: _Part) -> None:
            octave, mine = part
            found[mine] = _loops().descriptors(octave, points.rows[mine], angle[mine], *_samples())

        mapped(describe, self._parts(points), self._threads)
        return found

    def _bands(self, height: int) -> list[tuple[int, int]]:
        """Rows from and to, for a thread each."""
        count = 1 if height < _BAND_ROWS * self._threads else self._threads
        ends = np.linspace(0, height, count + 1).astype(int).tolist()
        return list(pairwise(ends))

    def _parts(self, points: ScaleSpacePoints) -> "list[_Part]":
        """Octaves, and rows of keypoints in each, some at a time."""
        parts = []
        for number, octave in enumerate(self.octaves):
            mine = np.flatnonzero(points.rows[:, OCTAVE] == number)
            parts += [(octave, mine[k : k + _AT_ONCE]) for k in range(0, len(mine), _AT_ONCE)]
        return parts


def _loops() -> ModuleType:
    return compiled_module("featuredb.features.sift_loops")


@cache
def _samples() -> tuple[NDArray[Any], ...]:
    table: tuple[NDArray[Any], ...] = _loops().sample_table()
    return table
