"""Reconstructions of several places that look alike, taken apart where they hang together by little."""

from collections.abc import Sequence

from ingest.colmap_bridge import Model
from ingest.links import firm_parts
from ingest.submodel import keep_photos

# What a reconstruction is refused for whose photos are at several places. Not CONTRADICTS_GPS: to cut until
# the geotags of a part agree is to choose the photos of whoever lies. Of a block copied elsewhere, half of
# whose tags were at its twin, the parts with those tags were left over, small enough for one forged photo to
# confirm them: twelve photos promoted 277 m off.
AT_SEVERAL_PLACES = ("PHOTOS_DISAGREE", "AMBIGUOUS", "RESIDUALS", "NOT_VISIBLE")
_LEAST_PHOTOS = 3


def taken_apart(model: Model, links: Sequence[float]) -> tuple[float, list[Model]] | None:
    """The parts of a reconstruction at the weakest of the links at which it falls apart, and that link.

    Photos that hang on nothing any more are in no part: they are localised by themselves, or wait.
    """
    for level in links:
        parts = firm_parts(model, level)
        if len(parts) > 1:
            kept = [
                keep_photos(model, rows, least=_LEAST_PHOTOS) for rows in parts if len(rows) >= _LEAST_PHOTOS
            ]
            return level, [part for part in kept if part is not None]
    return None
