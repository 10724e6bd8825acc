"""Which photos of one lens have another focal length than the rest: a film's lens that zooms.

A reconstruction with one lens for all of a shot takes a zoom for a movement. Adjusted with a focal length for
each photo, it says itself whether they are equal: their differences are tested against their covariance.
"""

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtri

from featuredb.adjust.problem import Problem
from featuredb.adjust.terms import Block, LensWidths, lens_prior, whole_lens
from featuredb.geometry.arrays import FloatArray
from ingest.colmap.adjust import AdjustOptions
from ingest.colmap.bridge import Model
from ingest.colmap.map_errors import terms_of_map
from ingest.photos.photo import Photo
from ingest.sfm.extract import PhotoFeatures

logger = logging.getLogger(__name__)

_RATE = 1e-3  # of lenses that do not zoom and are found to
_LEAST_PHOTOS = 3
_OBSERVATIONS = 200  # of a photo, at most about so many take part: all of them would say it no clearer
_OTHERS = 50  # photos by other lenses that take part, those that share most points
# The same lens but for its focal length, which is anywhere.
_ZOOMS = LensWidths(focal_rel=0.3, aspect_rel=0.0005, center_rel=0.001, radial=0.0005, tangential=0.0005)


def zoomed_keys(
    models: Iterable[Model], photos: Sequence[Photo], features: Sequence[PhotoFeatures]
) -> dict[str, str]:
    """Camera keys, by name, of keyframes that have another focal length than others of their shot.

    Args:
        models: their rows count `photos`, and the features of these.
    """
    keys: dict[str, str] = {}
    if not any(_may_zoom(photo) for photo in photos):
        return keys
    numbers: Counter[str] = Counter()  # focal lengths of a key so far
    for model in models:
        rows = model.rows.tolist()
        unknown = {
            camera
            for row, camera in zip(rows, model.camera_of.tolist(), strict=True)
            if _may_zoom(photos[row])
        }
        if not unknown:
            continue
        block = model.block(model.pixels([features[row].features.xy for row in rows]))
        block = replace(block, names=tuple(photos[row].name for row in rows))
        for camera in sorted(unknown):
            runs = focal_runs(block, camera)
            if runs is None:
                continue
            names = sorted(block.names[k] for k in np.flatnonzero(block.camera_of == camera))
            key = photos[rows[block.names.index(names[0])]].camera_key
            lenses = (numbers[key] + runs).tolist()
            numbers[key] += int(runs.max()) + 1
            keys |= {name: f"{key} zoom {lens}" for name, lens in zip(names, lenses, strict=True)}
    return keys


def _may_zoom(photo: Photo) -> bool:
    return bool(photo.film) and photo.focal_px is None


def focal_runs(block: Block, camera: int) -> NDArray[np.int64] | None:
    """(k,) number of the focal length of each photo of a camera, from 0, in the order of their names.

    Photos that follow each other keep one while no difference is significant. None: one for all.

    Observations count with their dilution where it is asked whether a lens zooms, and in full where it does:
    what a lens model leaves over is common to its photos.

    Args:
        camera: its row in the block, of a shot whose photos' names are in the order of time.
    """
    options = AdjustOptions()
    rows = np.flatnonzero(block.camera_of == camera)
    if len(rows) < _LEAST_PHOTOS:
        return None
    rows = rows[np.argsort([block.names[k] for k in rows], kind="stable")]
    part, own = _part(block, rows)
    try:
        focal, covariance = _focal_lengths(part, own, options)
    except np.linalg.LinAlgError as error:
        logger.warning("%s: nothing determines whether the lens zooms (%s)", part.names[0], error)
        return None
    if focal is None or _equal(focal, covariance):
        return None
    return _runs(focal, covariance / options.dilution)


def _part(block: Block, rows: NDArray[np.int64]) -> tuple[Block, NDArray[np.int64]]:
    """The photos of `rows`, those that share most points with them, and points that the first see.

    Returns:
        The part, in which each photo has a camera of its own, and the photos of `rows` in it, the first ones.
    """
    mine = np.isin(block.photo_of, rows)
    keep = np.zeros(len(block.xyz), dtype=np.bool_)
    keep[block.point_of[mine]] = True
    share = min(1.0, _OBSERVATIONS * len(rows) / max(int(mine.sum()), 1))
    keep &= np.random.default_rng(0).random(len(keep)) < share
    seen = keep[block.point_of]
    counts = np.bincount(block.photo_of[seen & ~mine], minlength=len(block.names))
    others = np.argsort(-counts, kind="stable")[:_OTHERS]
    photos = np.concatenate([rows, np.sort(others[counts[others] > 0])])
    number = np.full(len(block.names), -1)
    number[photos] = np.arange(len(photos))
    seen &= number[block.photo_of] >= 0
    tracks = np.bincount(block.point_of[seen], minlength=len(block.xyz))
    seen &= tracks[block.point_of] >= 2
    points, point_of = np.unique(block.point_of[seen], return_inverse=True)
    cameras = [block.cameras[int(block.camera_of[k])] for k in photos]
    part = Block(
        names=tuple(block.names[k] for k in photos),
        cameras=tuple(cameras),
        camera_of=np.arange(len(photos)),
        cam_from_block=tuple(block.cam_from_block[k] for k in photos),
        xyz=block.xyz[points],
        point_of=point_of.reshape(-1).astype(np.int64),
        photo_of=number[block.photo_of[seen]],
        xy=block.xy[seen],
    )
    return whole_lens(part), np.arange(len(rows))


def _focal_lengths(
    part: Block, own: NDArray[np.int64], options: AdjustOptions
) -> tuple[FloatArray | None, FloatArray]:
    """Logarithms (k,) of the focal lengths of the photos `own`, and their covariance; None for none."""
    count = len(part.names)
    held = tuple(range(len(own), count))
    lenses = tuple(lens_prior(lens, _ZOOMS) if c < len(own) else None for c, lens in enumerate(part.cameras))
    terms = replace(terms_of_map(part, {}, None, options), lenses=lenses)
    if len(held) >= 2:
        terms = replace(terms, held_photos=held, centers=None, orientations=None)
    problem = Problem(part, terms, options.threads)
    problem.solve(options.max_iterations, 1e-6)
    found = problem.marginals()
    starts = found.lens_start[own]
    if (starts < 0).any():
        return None, np.zeros((0, 0))
    focal = np.array([lens.params[0] for lens in problem.block().cameras[: len(own)]])
    covariance = options.dilution * found.shared[np.ix_(starts, starts)] / np.outer(focal, focal)
    return np.log(focal), covariance


def _equal(values: FloatArray, covariance: FloatArray) -> bool:
    """Whether chance explains how values (k,) differ."""
    differences = np.diff(np.eye(len(values)), axis=0)
    off = differences @ values
    squared = off @ np.linalg.solve(differences @ covariance @ differences.T, off)
    return bool(chdtrc(len(off), squared) >= _RATE)


def _runs(values: FloatArray, covariance: FloatArray) -> NDArray[np.int64]:
    """(k,) a number for each value; a new one where it differs from the mean of those with the last one."""
    runs, first = np.zeros(len(values), dtype=np.int64), 0
    limit = float(-ndtri(0.5 * _RATE))
    for k in range(1, len(values)):
        weights = np.zeros(len(values))
        weights[first:k], weights[k] = -1.0 / (k - first), 1.0
        runs[k] = runs[k - 1]
        if abs(weights @ values) > limit * np.sqrt(weights @ covariance @ weights):
            runs[k] += 1
            first = k
    return runs
