"""A film over a textured field and its true poses, for tests of tracking."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.rigid3 import Rigid3
from reloc.localise.candidates import IndexedArea
from reloc.tracking.ground import TrackedFrame
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import Tracker
from tests.support.hill_photos import CAMERA, _render
from tests.support.hill_walk import WEST_M
from tests.support.made_once import made_once
from tests.support.planar_map import field_texture, view

OPTIONS = TrackOptions(keyframe_every=4, answer_after=4, lost_answer_after=6, catch_up=6, min_matches=20)
FRAMES, CUT = 44, range(20, 24)


def pose_at(frame: int) -> Rigid3:
    """Half a metre and a degree a frame."""
    return view(
        WEST_M - 9.0 + 0.4 * frame, -3.0 + 0.1 * frame, 46.0, tilt_deg=8.0, heading_deg=10.0 + 0.7 * frame
    )


def film_frames(tmp_path_factory: pytest.TempPathFactory) -> list[NDArray[np.uint8]]:
    """Grey frames (h, w), made once in a run of the tests; those of CUT show another field."""
    return list(np.load(made_once("tracked-film", _make, tmp_path_factory) / "frames.npy"))


def _make(folder: Path) -> None:
    texture, other = field_texture(1), field_texture(9)
    frames = [_render(other if i in CUT else texture, pose_at(i), i) for i in range(FRAMES)]
    np.save(folder / "frames.npy", np.stack(frames))


def tracked(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], options: TrackOptions = OPTIONS
) -> list[TrackedFrame]:
    with Tracker(MapFinder(areas), CAMERA, options) as tracker:
        return [tracker.track(gray, i / 30.0) for i, gray in enumerate(film)]
