"""Step: localised photos of one camera have one lens.

A photo that names no camera is localised with a lens of its own. Looking straight down at a street it found a
focal length 26 % too long and stood 9 m too high, with the map's points within a fifth of a pixel: over flat
ground height and focal length are one. The other photos of its owner from that day knew better.
"""

from collections.abc import Mapping

import numpy as np

from featuredb.geometry.camera import Camera
from ingest.growth.localised import LocaliseEachOptions, with_lens
from ingest.growth.values import LocalisedPhoto

_MOST_LENSES = 5  # that are tried; those of the photos with most matches


def with_shared_lenses(
    localised: Mapping[int, LocalisedPhoto], keys: Mapping[int, str], options: LocaliseEachOptions
) -> dict[int, LocalisedPhoto]:
    """The photos by row; those of one camera with the lens under which most of their matches fit.

    A photo that this lens does not fit keeps its own (`with_lens`).

    Args:
        keys: of the cameras, by row (`ingest.photo_cameras.shared_key`).
    """
    found = dict(localised)
    cameras: dict[str, list[int]] = {}
    for row in sorted(localised):
        cameras.setdefault(keys[row], []).append(row)
    for rows in cameras.values():
        by_matches = sorted(rows, key=lambda r: -len(localised[r].pixels))
        lenses = list(dict.fromkeys(localised[r].camera for r in by_matches))[:_MOST_LENSES]
        if len(lenses) < 2:
            continue
        tries = [{r: with_lens(localised[r], lens, options) for r in rows} for lens in lenses]
        fits = [
            sum(_fitting(photo, lens, options) for photo in posed.values())
            for posed, lens in zip(tries, lenses, strict=True)
        ]
        found.update(tries[int(np.argmax(fits))])
    return found


def _fitting(photo: LocalisedPhoto, lens: Camera, options: LocaliseEachOptions) -> int:
    """Matches of the photo that fit its pose, if it has that lens."""
    if photo.camera != lens:
        return 0
    tolerance_px = options.localise.pose.tolerance_rel * max(lens.width, lens.height)
    error = lens.project(photo.cam_from_local.act(photo.points)) - photo.pixels
    return int((np.linalg.norm(error, axis=1) < tolerance_px).sum())
