"""A map placed by registered frames: projected and adjusted, in rounds while its lens changes."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from featuredb.maps.feature_map import FeatureMap
from featuredb.render.cloud import PointCloud
from ingest.executor import Progress
from ingest.register.anchor.frames import TriedFrame, register_again
from ingest.register.anchor.proposals import PhotoReader
from ingest.register.structure.adjustment import adjust_to_scan, placed_map
from ingest.register.structure.projection import project_structure

_LOG = logging.getLogger(__name__)

# A map's lens is adjusted with its placement; while it changes, frames are registered again with the better
# one, so many times at most.
_LENS_ROUNDS = 4
# Relative change of the focal length that needs no further round: 0.3 % is 0.15 m of height from 50 m.
_LENS_SETTLED = 0.003


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlaceRound:
    """One round of projecting the structure, by frames registered for it, and adjusting the map.

    Attributes:
        structure_s, adjust_s: wall time of the two steps. structure_cpu_s: processor time of the first.
        focal_px: of the map's cameras after it.
        figures: of both steps, JSON-able.
    """

    frames: tuple[TriedFrame, ...]
    structure_s: float
    structure_cpu_s: float
    adjust_s: float
    focal_px: tuple[float, ...]
    figures: dict[str, Any]


def place_in_rounds(
    feature_map: FeatureMap,
    frames: Sequence[TriedFrame],
    cloud: PointCloud,
    read_gray: PhotoReader,
    progress: Progress,
) -> tuple[FeatureMap | None, list[PlaceRound], str]:
    """The map by structure projection and adjustment, again with a better lens while that changes.

    A frame registered with a wrong lens finds matches that fit the wrong lens: the adjustment moves it part
    of the way, and the next registration finds others. Each round places the map as it was. A map of which no
    adjustment is accepted has no place. Frames may contradict the map until its lens is found.
    """
    placed: FeatureMap | None = None
    latest: FeatureMap | None = None
    words = ""
    rounds: list[PlaceRound] = []
    for number in range(_LENS_ROUNDS):
        lens = (latest or feature_map).cameras
        registered = {frame.image.image_id: frame.registration for frame in frames}
        start, cpu = time.perf_counter(), time.process_time()
        structure = project_structure(feature_map, registered, cloud)
        structure_s, structure_cpu_s = time.perf_counter() - start, time.process_time() - cpu
        if not structure.accepted:
            words = f"{structure.reason}: {structure.message}"
            break
        start = time.perf_counter()
        adjustment = adjust_to_scan(feature_map, structure, registered, cloud, latest)
        adjust_s = time.perf_counter() - start
        words = "" if adjustment.accepted else f"{adjustment.reason}: {adjustment.message}"
        if adjustment.block is None:
            break
        latest = placed_map(feature_map, structure, cloud, adjustment)
        placed = latest if adjustment.accepted else None
        adjusted = adjustment.figures | {"reason": adjustment.reason}
        rounds.append(
            PlaceRound(
                frames=tuple(frames),
                structure_s=structure_s,
                structure_cpu_s=structure_cpu_s,
                adjust_s=adjust_s,
                focal_px=tuple(camera.focal_px for camera in latest.cameras),
                figures={"structure": structure.figures, "adjustment": adjusted},
            )
        )
        progress("place", number + 1, _LENS_ROUNDS)
        both = zip(latest.cameras, lens, strict=True)
        change = max(abs(new.focal_px / old.focal_px - 1.0) for new, old in both)
        if change < _LENS_SETTLED or number + 1 == _LENS_ROUNDS:
            break
        again = register_again(latest, cloud, frames, read_gray)
        kept = [frame for frame in again if frame.registration.accepted]
        if len(kept) < len(frames):
            lost = [f.image.name for f in again if not f.registration.accepted]
            _LOG.warning("not registered again with the adjusted lens: %s", ", ".join(lost))
        if not kept:
            break
        frames = kept
    if words and placed is not None:
        _LOG.warning("round %d: %s; the map stays as an earlier round placed it", len(rounds), words)
    return placed, rounds, words
