"""RootSIFT as 8-bit integers: the one extractor of ingest and queries.

Descriptors and orientations at keypoints that another program has found: this extractor's.

The photo is shrunk as for extraction, unless a keypoint is finer than what then is left of it. A diameter
says in which octave and layer of the scale space the extractor would have found the keypoint.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features.features import Features
from featuredb.features.scale_space import LAYERS, SIGMA, ScaleSpace, ScaleSpacePoints

# Raise when a change to this module makes descriptors that older maps cannot be compared with.
_DESCRIPTOR_VERSION = "rootsift8-opencv-1"
# 24 x 18 cells: a cell of a 4:3 photo is about square, and 4,000 features are about nine a cell, so that
# a textured corner cannot take all the places while a cell still has a choice.
_COLUMNS, _ROWS = 24, 18


@dataclass(frozen=True, slots=True, kw_only=True)
class ExtractorOptions:
    """How features are extracted.

    Attributes:
        first_octave_px: longer side of the scale space's first octave; larger images are area-averaged
            down to it first, smaller ones enlarged, at most twice. SIFT is scale-invariant, so maps and
            queries may differ in it.
        max_features: the strongest, spatially spread, are kept. For maps many: on `brighton` 12,000 instead
            of 6,000 double the observations and halve what poses move by between subsets of the photos.
        oversample: the spread selection chooses among this many times as many of the strongest keypoints.
        contrast_threshold: SIFT's; half of OpenCV's 0.04, so that asphalt and lawn still give keypoints.
        edge_threshold: SIFT's (Lowe's 10).
        upright: angles are set to zero, for image pairs whose rotation is known; more distinctive.
    """

    first_octave_px: int = 2400
    max_features: int = 12_000
    oversample: float = 2.5
    contrast_threshold: float = 0.02
    edge_threshold: float = 10.0
    upright: bool = False

    def __post_init__(self) -> None:
        if not 64 <= self.first_octave_px <= 64_000:
            raise InvalidValueError(
                f"ExtractorOptions.first_octave_px: expected 64..64000 px, found {self.first_octave_px}"
            )
        if not 1 <= self.max_features <= 1_000_000:
            raise InvalidValueError(
                f"ExtractorOptions.max_features: expected 1..1000000, found {self.max_features}"
            )

        if not 1.0 <= self.oversample <= 100.0:
            raise InvalidValueError(f"ExtractorOptions.oversample: expected 1..100, found {self.oversample}")

    @property
    def fingerprint(self) -> str:
        """Names the space of the descriptors. Equal fingerprints can be compared, others never.

        Size and number of features are not part of it: they change how many keypoints there are,
        not what a descriptor means.
        """
        text = f"{_DESCRIPTOR_VERSION};upright={self.upright};layers={LAYERS};sigma={SIGMA}"
        return (
            f"{_DESCRIPTOR_VERSION}{'-upright' if self.upright else ''}-"
            + (hashlib.sha256(text.encode()).hexdigest()[:12])
        )


def extract(
    gray: NDArray[np.uint8], options: ExtractorOptions | None = None, size: tuple[int, int] | None = None
) -> Features:
    """Detect and describe the features of one image.

    Args:
        gray: (h, w) uint8, pixels as stored in the file (EXIF orientation not applied).
        size: width and height of the image, of which `gray` is every second, fourth or eighth pixel (as
            `decode_gray` makes it).

    Returns:
        Features in full-size pixels, strongest and best-spread first.

    Raises:
        ImageError: not a two-dimensional uint8 array, or smaller than 32 pixels.
    """
    options = options or ExtractorOptions()
    if gray.ndim != 2 or gray.dtype != np.uint8:
        raise ImageError(f"extract: expected a (h, w) uint8 image, found {gray.shape} {gray.dtype}")
    width, height = size or gray.shape[::-1]
    if min(height, width) < 32:
        raise ImageError(f"extract: expected at least 32x32 pixels, found {width}x{height}")
    space = ScaleSpace(gray, options.first_octave_px)
    points = space.keypoints(options.contrast_threshold, options.edge_threshold)
    points = points.take(np.arange(min(len(points), int(options.oversample * options.max_features))))
    points = points.take(
        spread_strongest(points.xy, points.response, space.width, space.height, options.max_features)
    )
    if options.upright:
        angle = np.zeros(len(points), np.float32)
    else:
        angles, counts = space.orientations(points)
        rows = np.repeat(np.arange(len(points)), counts)[: options.max_features]
        angle = angles[rows, np.arange(len(rows)) - (np.cumsum(counts) - counts)[rows]]
        points = points.take(rows)
    reduced = round(width / gray.shape[1])  # whose last pixels may reach beyond the image
    ratio = reduced * np.array([gray.shape[1] / space.width, gray.shape[0] / space.height])
    return Features(
        xy=(points.xy * ratio).astype(np.float32),
        scale=points.diameter * np.float32(ratio.mean()),
        angle=angle,
        response=points.response,
        descriptors=rootsift_8bit(space.descriptors(points, angle)),
        width=width,
        height=height,
        fingerprint=options.fingerprint,
    )


def warm_up() -> None:
    """Load the extractor's compiled loops, or compile them, now: processes that are forked then have them."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)
    extract(noise, ExtractorOptions(contrast_threshold=0.0))


def rootsift_8bit(sift: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RootSIFT (Arandjelovic and Zisserman 2012) of SIFT descriptors (n, 128), as 8-bit integers.

    round(512 sqrt(d / |d|_1)) clipped to 255, as COLMAP has it: length 512 up to clipping and rounding.
    """
    total = np.maximum(sift.sum(axis=1, keepdims=True), np.float32(1e-9))
    return np.asarray(np.clip(np.rint(512.0 * np.sqrt(sift / total)), 0, 255), dtype=np.uint8)


def spread_strongest(
    xy: NDArray[np.float32], response: NDArray[np.float32], width: int, height: int, count: int
) -> NDArray[np.intp]:
    """Rows of at most `count` keypoints, best first.

    Keypoints are ranked inside the cells of a grid by response; the strongest of every cell come first,
    then the second of every cell, and so on, stronger ones first within a round.

    Args:
        xy: (n, 2) pixels. response: (n,). width, height: image size in the same pixels.
    """
    n = len(xy)
    column = np.clip((xy[:, 0] * (_COLUMNS / width)).astype(np.intp), 0, _COLUMNS - 1)
    row = np.clip((xy[:, 1] * (_ROWS / height)).astype(np.intp), 0, _ROWS - 1)
    cell = row * _COLUMNS + column
    by_cell = np.lexsort((-response, cell))
    starts = np.searchsorted(cell[by_cell], np.arange(_COLUMNS * _ROWS))
    rank = np.empty(n, dtype=np.intp)
    rank[by_cell] = np.arange(n) - starts[cell[by_cell]]
    return np.lexsort((-response, rank))[:count]


# The smallest diameter that the extractor finds: half a layer above the first octave's first image.
_FINEST_PX = 0.999 * 2.0 * SIGMA * 2.0 ** (0.5 / LAYERS)


def describe_at(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32], angle: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """RootSIFT (n, 128) at given keypoints.

    Args:
        gray: (h, w) uint8.
        xy: (n, 2) full-size pixels, centre of the top-left pixel (0.5, 0.5). scale: (n,) diameters in pixels.
        angle: (n,) degrees clockwise from the x axis.

    Raises:
        ImageError: a place or diameter is no finite number, or a diameter is not above zero.
    """
    if not len(xy):
        return np.zeros((0, 128), np.uint8)
    space, points = _placed(gray, xy, scale)
    return rootsift_8bit(space.descriptors(points, angle))


def orientations_at(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Orientation (n,) of given keypoints, degrees in [0, 360), clockwise from the x axis: the strongest; 0
    where there is none.

    Args:
        gray, xy, scale: as for `describe_at`.
    """
    if not len(xy):
        return np.zeros(0, np.float32)
    space, points = _placed(gray, xy, scale)
    angles, counts = space.orientations(points)
    return np.where(counts > 0, angles[:, 0], np.float32(0.0))


def _placed(
    gray: NDArray[np.uint8], xy: NDArray[np.float32], scale: NDArray[np.float32]
) -> tuple[ScaleSpace, ScaleSpacePoints]:
    space = ScaleSpace(gray, ExtractorOptions().first_octave_px)
    if float(scale.min()) * max(space.width, space.height) / max(gray.shape) < _FINEST_PX:
        space = ScaleSpace(gray, 2 * max(gray.shape))
    ratio = np.array([space.width, space.height]) / gray.shape[::-1]
    places, diameters = xy.astype(np.float64) * ratio, scale.astype(np.float64) * ratio.mean()
    return space, ScaleSpacePoints.at(places, diameters, len(space.octaves))
