"""The extractor against known blob centres and a float formula."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from featuredb.errors import ImageError, InvalidValueError
from featuredb.features import scale_space, sift_loops
from featuredb.features.extractor import (
    ExtractorOptions,
    describe_at,
    extract,
    orientations_at,
    rootsift_8bit,
)


def blobs(width: int, height: int, centers: np.ndarray, sigma: float) -> np.ndarray:
    """Bright Gaussian blobs at centres (n, 2) in pixels, the top-left pixel's centre being (0.5, 0.5)."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    image = np.full((height, width), 60.0)
    for cx, cy in centers:
        image += 150.0 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.rint(image).astype(np.uint8)


def texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0) + 2 * cv2.GaussianBlur(noise, (0, 0), 5.0)
    return np.clip(128 + 300 * smooth, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("factor", "sigma"), [(1.0, 4.0), (1.0, 6.0), (2.0, 8.0), (2.5, 10.0), (3.0, 9.0)])
def test_centres_of_blobs_within_a_twentieth_of_a_pixel(factor: float, sigma: float) -> None:
    """Also when the image is shrunk first: there a forgotten half pixel would be `factor / 2` off."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(3), np.arange(2)), axis=-1).reshape(-1, 2)
    centers = (grid * [90, 90] + [70, 70]) * factor + rng.uniform(-3, 3, (6, 2))
    width, height = round(320 * factor), round(240 * factor)
    found = extract(
        blobs(width, height, centers, sigma), ExtractorOptions(first_octave_px=640, contrast_threshold=0.01)
    )
    assert (found.width, found.height) == (width, height)
    errors = []
    for center in centers:
        distance = np.linalg.norm(found.xy - center, axis=1)
        errors.append(found.xy[np.argmin(distance)] - center)
    # The mean is where a wrong convention would show; single blobs also suffer from 8-bit rounding.
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05 * factor**0.5
    assert np.linalg.norm(errors, axis=1).max() < 0.1 * factor


@pytest.mark.parametrize("by", [2, 4])
def test_centres_of_blobs_in_a_smaller_copy_of_odd_sides(by: int) -> None:
    """Its last pixels reach beyond the image: who stretches them to its sides is off by pixels there."""
    width, height = by * 330 + 1, by * 250 + 1
    centers = by * np.array([[60.0, 60.0], [290.0, 60.0], [290.0, 210.0], [60.0, 210.0]]) + 0.3
    image = blobs(width, height, centers, 6.0 * by).astype(float)
    padded = np.pad(image, ((0, by - 1), (0, by - 1)), mode="edge")
    small = padded.reshape(len(padded) // by, by, -1, by).mean((1, 3)).astype(np.uint8)
    found = extract(small, ExtractorOptions(first_octave_px=640, contrast_threshold=0.01), (width, height))
    assert (found.width, found.height) == (width, height)
    for center in centers:
        assert np.linalg.norm(found.xy - center, axis=1).min() < 0.15 * by


@pytest.mark.parametrize("shape", [(64, 65_500), (65_500, 64)])
def test_a_picture_like_a_thread_has_no_features(shape: tuple[int, int]) -> None:
    """Made as small as it has to be it is a line of pixels."""
    image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    assert len(extract(image, ExtractorOptions(first_octave_px=1400))) == 0


def test_scale_is_in_full_size_pixels() -> None:
    """A blob twice as large in an image twice as large, shrunk by two, has twice the diameter."""
    center = np.array([[100.3, 99.6]])
    options = ExtractorOptions(first_octave_px=400, contrast_threshold=0.01)
    small = extract(blobs(200, 200, center, 6.0), options)
    large = extract(blobs(400, 400, 2 * center, 12.0), options)
    strongest = [float(f.scale[np.argmax(f.response)]) for f in (small, large)]
    assert strongest[1] / strongest[0] == pytest.approx(2.0, rel=0.03)


def test_rootsift_is_the_float_formula() -> None:
    rng = np.random.default_rng(0)
    raw = np.floor(rng.gamma(0.5, 40.0, (200, 128))).astype(np.float32)
    expected = np.minimum(np.rint(512.0 * np.sqrt(raw.astype(np.float64) / raw.sum(1, keepdims=True))), 255)
    # Ties of rounding may fall either way between float32 and float64.
    assert np.abs(rootsift_8bit(raw).astype(int) - expected).max() <= 1
    assert np.mean(rootsift_8bit(raw) != expected) < 1e-3
    np.testing.assert_array_equal(rootsift_8bit(np.zeros((1, 128), np.float32)), 0)


def test_keypoints_and_descriptors_are_opencvs() -> None:
    """All but a few of OpenCV's keypoints, and descriptors that are nearer to it than any other is by far."""
    gray = texture(300, 240)
    options = ExtractorOptions(max_features=100_000)
    found = extract(gray, options)
    sift = cv2.SIFT_create(
        0, 3, options.contrast_threshold, options.edge_threshold, 1.6, enable_precise_upscale=True
    )
    keypoints, raw = sift.detectAndCompute(gray, None)
    theirs = np.array([(k.pt[0] + 0.5, k.pt[1] + 0.5, k.size, k.angle) for k in keypoints])
    apart = theirs[:, None, :] - np.column_stack([found.xy, found.scale, found.angle])
    turned = np.abs((apart[..., 3] + 180.0) % 360.0 - 180.0)
    same = np.linalg.norm(apart[..., :2], axis=2) < 0.1 * theirs[:, 2:3]
    same &= (np.abs(apart[..., 2]) < 0.1 * theirs[:, 2:3]) & (turned < 10.0)
    rows = same.argmax(axis=1)[same.any(axis=1)]
    assert len(theirs) > 500
    assert 0.97 * len(theirs) < len(found) < 1.03 * len(theirs)
    assert len(rows) > 0.8 * len(theirs)  # OpenCV doubles the image with other weights
    expected = rootsift_8bit(raw[same.any(axis=1)]).astype(np.float64)
    distance = np.linalg.norm(found.descriptors[rows] - expected, axis=1)
    assert np.median(distance) < 45.0
    assert np.percentile(distance, 99) < 110.0
    other = np.linalg.norm(found.descriptors[rows] - np.roll(expected, 1, axis=0), axis=1)
    assert np.median(other) > 250.0
    lengths = np.linalg.norm(found.descriptors.astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 12  # clipping at 255 and rounding


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_turned_image_has_the_same_fine_features_turned(quarters: int) -> None:
    gray = texture(300, 220, seed=2)
    found, turned = extract(gray), extract(np.ascontiguousarray(np.rot90(gray, -quarters)))
    xy, size = found.xy.astype(np.float64), np.array([300.0, 220.0])
    for _ in range(quarters):
        xy, size = np.column_stack([size[1] - xy[:, 1], xy[:, 0]]), size[::-1]
    apart = np.linalg.norm(xy[:, None] - turned.xy, axis=2)
    turn = (turned.angle - found.angle[:, None] - 90.0 * quarters + 180.0) % 360.0 - 180.0
    same = (apart < 0.01) & (np.abs(turn) < 0.1) & (np.abs(turned.scale - found.scale[:, None]) < 0.01)
    first = found.scale < 3.5  # of the others pixels are left out: others in the turned image
    assert first.sum() > 300
    assert same[first].any(axis=1).mean() > 0.99
    rows = np.flatnonzero(first & same.any(axis=1))
    difference = found.descriptors[rows].astype(float) - turned.descriptors[same[rows].argmax(axis=1)]
    assert np.median(np.linalg.norm(difference, axis=1)) < 20.0


def test_features_of_a_window_are_those_of_the_whole() -> None:
    """Even sizes and offsets keep the pixels of all octaves but the coarsest where they are."""
    gray = texture(420, 360, seed=4)
    window = np.ascontiguousarray(gray[64:296, 96:352])
    whole, part = extract(gray), extract(window)
    inside = (np.abs(part.xy - [128.0, 116.0]) < [60.0, 50.0]).all(axis=1) & (part.scale < 6.0)
    assert inside.sum() > 50
    for row in np.flatnonzero(inside):
        at = np.linalg.norm(whole.xy - part.xy[row] - [96.0, 64.0], axis=1)
        at += np.abs(whole.angle - part.angle[row])
        assert at.min() < 0.01
        np.testing.assert_allclose(
            part.descriptors[row].astype(int), whole.descriptors[at.argmin()].astype(int), atol=3
        )


# Numbers of rows that no octave's halves share, and octaves of less than a border.
@pytest.mark.parametrize("shape", [(900, 700), (70, 700), (33, 1600), (64, 37)])
def test_any_number_of_threads_gives_the_same(shape: tuple[int, int]) -> None:
    gray = texture(shape[1], shape[0], seed=6)
    before, found = cv2.getNumThreads(), []
    try:
        for threads in (1, 2, 3):
            cv2.setNumThreads(threads)
            found.append(extract(gray, ExtractorOptions(max_features=2000, contrast_threshold=0.001)))
    finally:
        cv2.setNumThreads(before)
    assert len(found[0]) > 20
    for other in found[1:]:
        for name in ("xy", "scale", "angle", "response", "descriptors"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name))


def test_columns_of_keypoints_are_those_of_the_loops() -> None:
    for name in ("X", "Y", "SCALE", "OCTAVE", "LAYER", "RESPONSE"):
        assert getattr(scale_space, name) == getattr(sift_loops, name)


def test_no_feature_is_there_twice() -> None:
    """Also where many are equally strong: a tile over and over."""
    gray = np.tile(texture(64, 64, seed=8), (5, 6))
    found = extract(gray, ExtractorOptions(max_features=20_000, contrast_threshold=0.002))
    rows = np.column_stack([found.xy, found.scale, found.angle])
    assert len(rows) > 1000
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_the_fingerprint_names_the_space_of_descriptors() -> None:
    plain = ExtractorOptions()
    assert ExtractorOptions(upright=True).fingerprint != plain.fingerprint
    assert ExtractorOptions(max_features=10, first_octave_px=640).fingerprint == plain.fingerprint
    assert extract(texture(64, 64), plain).fingerprint == plain.fingerprint


def test_upright_gives_angle_zero_and_one_keypoint_per_place_and_scale() -> None:
    gray = texture(300, 220, seed=5)
    turned = extract(gray, ExtractorOptions(contrast_threshold=0.01))
    upright = extract(gray, ExtractorOptions(contrast_threshold=0.01, upright=True))
    keys = np.column_stack([upright.xy, upright.scale])
    assert len(upright) > 100
    assert (upright.angle == 0).all()
    assert len(np.unique(keys, axis=0)) == len(keys)
    turned_keys = np.column_stack([turned.xy, turned.scale])
    assert len(np.unique(turned_keys, axis=0)) < len(turned_keys)  # it has something to leave out
    np.testing.assert_allclose(
        np.unique(turned_keys.round(2), axis=0), np.unique(keys.round(2), axis=0), atol=0.011
    )


def test_no_more_than_max_features_and_always_the_same() -> None:
    gray = texture(400, 300)
    first, second = (extract(gray, ExtractorOptions(max_features=150)) for _ in range(2))
    assert len(first) == 150
    np.testing.assert_array_equal(first.xy, second.xy)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)
    more = extract(gray, ExtractorOptions(max_features=400))
    assert len(more) > 150


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("shape", [(100, 100), (32, 32), (32, 20_000), (20_000, 32)])
def test_a_blank_image_has_no_features(shape: tuple[int, int], upright: bool) -> None:
    found = extract(np.full(shape, 128, np.uint8), ExtractorOptions(upright=upright))
    assert len(found) == 0
    assert found.descriptors.shape == (0, 128)
    assert (found.height, found.width) == shape


def test_odd_images_and_other_programs_keypoints_are_survived() -> None:
    rng = np.random.default_rng(0)
    for shape in ((32, 32), (33, 1600), (1600, 33), (33, 30_000), (101, 67), (64, 203)):
        gray = rng.integers(0, 256, shape, dtype=np.uint8)
        found = extract(gray, ExtractorOptions(contrast_threshold=0.0, edge_threshold=1e6))
        assert len(found) > 0 or shape == (33, 30_000)
        size = [shape[1], shape[0]]
        assert ((found.xy >= 0) & (found.xy <= size)).all()
        assert ((found.angle >= 0) & (found.angle < 360)).all()
        for _ in range(3):
            xy = (rng.uniform(-2.0, 3.0, (30, 2)) * size).astype(np.float32)
            scale = np.exp(rng.uniform(-3, 9, 30)).astype(np.float32)
            angle = orientations_at(gray, xy, scale)
            assert describe_at(gray, xy, scale, angle).shape == (30, 128)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("of", [0, 1, 2])
def test_keypoints_that_are_no_numbers_are_refused(of: int, wrong: float) -> None:
    x, y, scale = (
        np.array([[5.0], [5.0], [4.0]], np.float32) * np.where(np.arange(3) == of, wrong, 1.0)[:, None]
    )
    gray, xy, scale = texture(64, 64), np.column_stack([x, y]).astype(np.float32), scale.astype(np.float32)
    with pytest.raises(ImageError, match="finite"):
        orientations_at(gray, xy, scale)
    with pytest.raises(ImageError, match="finite"):
        describe_at(gray, xy, scale, np.zeros(1, np.float32))


@pytest.mark.evaluation  # compiles for twelve seconds
def test_no_loop_leaves_its_arrays(tmp_path: Path) -> None:
    """With Numba's check of each index."""
    environment = os.environ | {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    code = (
        "import tests.unit.test_extractor as tests\n"
        "tests.test_odd_images_and_other_programs_keypoints_are_survived()"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False, timeout=300.0)
    assert done.returncode == 0


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((31, 100), np.uint8),
        np.zeros((100, 31), np.uint8),
        np.zeros((1, 3000), np.uint8),
        np.zeros((0, 0), np.uint8),
        np.zeros((100, 100, 3), np.uint8),
        np.zeros((100, 100), np.float32),
        np.zeros((100, 100), np.uint16),
    ],
)
def test_what_is_no_gray_image_is_refused(image: np.ndarray) -> None:
    with pytest.raises(ImageError, match="expected"):
        extract(image)


@pytest.mark.parametrize("wrong", [{"first_octave_px": 10}, {"first_octave_px": 10**6}, {"max_features": 0}])
def test_options_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(InvalidValueError, match="expected"):
        ExtractorOptions(**wrong)
