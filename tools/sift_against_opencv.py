"""Our SIFT beside OpenCV's: time, and matches of neighbouring photos with ours, with OpenCV's, and across.

Of each folder's photos, by name, every eighth and the one after it. Both extractors have the same thresholds
and number of features, and choose them alike; matches are mutual and pass a ratio test of 0.85; inliers are
those of a fundamental matrix to one pixel of the shrunk photos. Times are of one thread, without decoding.
"""

import time
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from featuredb.features.decode import decode_gray
from featuredb.features.extractor import ExtractorOptions, extract, rootsift_8bit, spread_strongest
from featuredb.features.scale_space import LAYERS, SIGMA
from featuredb.features.shrink import shrunk
from featuredb.index.nearest import nearest
from tools.figures import median, study_parser, write_figures
from tools.photo_files import photo_names

_EVERY, _RATIO, _TOLERANCE_PX = 8, 0.85, 1.0
_SIDE_PX, _FEATURES = 1000, 3000


class TimedFeatures(NamedTuple):
    """Places (n, 2) in pixels of the shrunk photo, descriptors (n, 128), and seconds that they took."""

    xy: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    seconds: float


def main() -> None:
    args = study_parser(__doc__, "folders").parse_args()
    options = ExtractorOptions(first_octave_px=2 * _SIDE_PX, max_features=_FEATURES, oversample=1.25)
    cv2.setNumThreads(1)
    own = opencv = across = 0
    ours_s, opencv_s = [], []
    for folder in args.folders:
        names = photo_names(folder)
        for pair in zip(names[::_EVERY], names[1::_EVERY], strict=False):
            photos = [shrunk(decode_gray(folder / name), _SIDE_PX) for name in pair]
            ours = [by_us(photo, options) for photo in photos]
            theirs = [by_opencv(photo, options) for photo in photos]
            own += inliers(*ours)
            opencv += inliers(*theirs)
            across += inliers(ours[0], theirs[1])
            ours_s += [one.seconds for one in ours]
            opencv_s += [one.seconds for one in theirs]
    ratios = np.divide(ours_s, opencv_s)
    figures = {
        "photos": len(ratios),
        "time_ratio": median(ratios),
        "ours_ms": 1e3 * median(ours_s),
        "opencv_inliers": opencv,
        "inliers_ratio": own / opencv,
        "across_ratio": across / opencv,
    }
    write_figures(args.json, figures)


def by_us(photo: NDArray[np.uint8], options: ExtractorOptions) -> TimedFeatures:
    start = time.thread_time()
    found = extract(photo, options)
    return TimedFeatures(found.xy, found.descriptors, time.thread_time() - start)


def by_opencv(photo: NDArray[np.uint8], options: ExtractorOptions) -> TimedFeatures:
    start = time.thread_time()
    sift = cv2.SIFT_create(
        int(options.oversample * options.max_features),
        LAYERS,
        options.contrast_threshold,
        options.edge_threshold,
        SIGMA,
        enable_precise_upscale=True,
    )
    keypoints, raw = sift.detectAndCompute(photo, None)
    xy = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float32)
    response = np.array([keypoint.response for keypoint in keypoints], dtype=np.float32)
    rows = spread_strongest(xy, response, photo.shape[1], photo.shape[0], options.max_features)
    descriptors = rootsift_8bit(raw[rows])
    return TimedFeatures(xy[rows] + np.float32(0.5), descriptors, time.thread_time() - start)


def inliers(first: TimedFeatures, second: TimedFeatures) -> int:
    """Matches of two photos that agree with one fundamental matrix."""
    squared, row = nearest(first.descriptors, second.descriptors, 2)
    _, back = nearest(second.descriptors, first.descriptors, 1)
    good = np.sqrt(squared[:, 0]) < _RATIO * np.sqrt(squared[:, 1])
    good &= back[row[:, 0], 0] == np.arange(len(row))
    places = [first.xy[good].astype(np.float64), second.xy[row[good, 0]].astype(np.float64)]
    if len(places[0]) < 8:
        return 0
    _, mask = cv2.findFundamentalMat(*places, cv2.USAC_MAGSAC, _TOLERANCE_PX, 0.999, 5000)
    return 0 if mask is None else int(mask.sum())


if __name__ == "__main__":
    main()
