"""A film over the test hills, tracked by the map of a survey; the truth is known."""

import numpy as np
import pytest

import reloc.tracking.tracker as tracker_module
from featuredb.geometry.rigid3 import Rigid3
from reloc.candidates import IndexedArea
from reloc.localiser import Localiser
from reloc.tracking.keyframe import Unmatched
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import TrackedFrame, Tracker
from tests.support.hill_photos import CAMERA, FRAME, _render
from tests.support.hill_walk import WEST_M, anchored_database
from tests.support.planar_map import field_texture, view

_OPTIONS = TrackOptions(keyframe_every=4, answer_after=4, lost_answer_after=6, min_matches=20)
_FRAMES, _CUT = 44, range(20, 24)


def pose_at(frame: int) -> Rigid3:
    """Half a metre and a degree a frame."""
    return view(
        WEST_M - 9.0 + 0.4 * frame, -3.0 + 0.1 * frame, 46.0, tilt_deg=8.0, heading_deg=10.0 + 0.7 * frame
    )


@pytest.fixture(scope="module")
def areas(tmp_path_factory: pytest.TempPathFactory) -> tuple[IndexedArea, ...]:
    return Localiser.open(anchored_database(tmp_path_factory.mktemp("anchored"))).areas


@pytest.fixture(scope="module")
def film() -> list[np.ndarray]:
    texture, other = field_texture(1), field_texture(9)
    return [_render(other if i in _CUT else texture, pose_at(i), i) for i in range(_FRAMES)]


def tracked(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], options: TrackOptions = _OPTIONS
) -> list[TrackedFrame]:
    with Tracker(areas, CAMERA, options) as tracker:
        return [tracker.track(gray, i / 30.0) for i, gray in enumerate(film)]


@pytest.fixture(scope="module")
def track(areas: tuple[IndexedArea, ...], film: list[np.ndarray]) -> list[TrackedFrame]:
    return tracked(areas, film)


def test_every_pose_is_right_and_what_is_lost_is_said(
    areas: tuple[IndexedArea, ...], track: list[TrackedFrame]
) -> None:
    area_from_hills = areas[0].area.frame.enu_from(FRAME)
    for frame in track:
        if frame.cam_from_local is None:
            assert frame.state == "lost"
            assert frame.detail
            continue
        true = pose_at(frame.index)
        assert frame.index not in _CUT
        off = frame.cam_from_local.center - area_from_hills.act(true.center)
        assert np.linalg.norm(off) < 0.3, frame.index
        assert (frame.cam_from_local @ area_from_hills).angle_to_deg(true) < 0.3
        assert frame.covariance is not None
        assert frame.inliers >= _OPTIONS.min_landmarks
    states = [frame.state for frame in track]
    # The first answer comes six frames after the first frame, and again six after the first after the cut.
    assert states[:7] == ["lost"] * 6 + ["relocalised"]
    assert states[7:20] == ["tracking"] * 13
    assert states[20:24] == ["lost"] * 4
    found = states.index("relocalised", 20)
    assert found <= 24 + 2 * (_OPTIONS.lost_answer_after + 1)
    assert states[found + 1 :] == ["tracking"] * (_FRAMES - found - 1)


def test_the_same_film_gives_the_same_poses(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], track: list[TrackedFrame]
) -> None:
    """However long the keyframes' thread takes."""
    for first, again in zip(track[:20], tracked(areas, film[:20]), strict=True):
        assert first.state == again.state
        if first.cam_from_local is not None:
            assert again.cam_from_local is not None
            np.testing.assert_array_equal(first.cam_from_local.matrix(), again.cam_from_local.matrix())


def test_a_film_of_elsewhere_stays_lost(areas: tuple[IndexedArea, ...]) -> None:
    other = field_texture(9)
    track = tracked(areas, [_render(other, pose_at(i), i) for i in range(10)])
    assert {frame.state for frame in track} == {"lost"}
    assert any(frame.detail.startswith(("TOO_FEW", "NO_COVERAGE", "AMBIGUOUS")) for frame in track)


def test_without_maps_there_are_no_poses(film: list[np.ndarray]) -> None:
    assert {frame.state for frame in tracked((), film[:8])} == {"lost"}


def test_a_track_that_the_map_does_not_confirm_is_lost(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its landmarks agree with each other still; three keyframes without the map are enough."""
    nothing = Unmatched(reason="TOO_FEW_MATCHES", detail="nothing")
    monkeypatch.setattr(tracker_module, "match_keyframe", lambda *_: nothing)
    track = tracked(areas, film[:20])
    # Keyframes at frames 6, 10 and 14 are answered at 10, 14 and 18.
    assert [frame.state for frame in track[7:18]] == ["tracking"] * 11
    assert [frame.state for frame in track[18:]] == ["lost"] * 2
    assert track[18].detail == "TOO_FEW_MATCHES: nothing"
