"""The tracker live: a thread whose answers come when the test says, measured in frames."""

from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from typing import Any

import numpy as np
import pytest

import reloc.tracking.tracker as tracker_module
from reloc.localise.candidates import IndexedArea
from reloc.tracking.flow_track import RecentFrame, RecentFrames
from reloc.tracking.ground import TrackedFrame
from reloc.tracking.map_ground import MapFinder, MapGround
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import Tracker
from tests.support.live import error_m, field_area, frame
from tests.support.planar_map import CAMERA

_LIVE = TrackOptions(live=True, keyframe_every=8)


class SlowThread:
    """An executor that has the answer so many frames after it was asked; none that is waited for."""

    def __init__(self) -> None:
        self.now = 0
        self.asked: list[tuple[int, str]] = []
        self.delays: dict[str, Callable[..., int]] = {
            "find": lambda *_: 9,
            "match": lambda *_: 5,
        }

    def submit(self, function: Callable[..., Any], *arguments: Any) -> "Later":
        self.asked.append((self.now, function.__name__))
        due = self.now + max(1, self.delays[function.__name__](*arguments))
        return Later(self, due, function(*arguments))

    def shutdown(self, **_: Any) -> None:
        pass


class Later:
    """A future of `SlowThread`."""

    def __init__(self, thread: SlowThread, due: int, value: object) -> None:
        self._thread, self._due, self._value = thread, due, value

    def done(self) -> bool:
        return self._thread.now >= self._due

    def result(self) -> object:
        assert self.done(), "a frame waited for the thread"
        return self._value


@pytest.fixture
def thread(monkeypatch: pytest.MonkeyPatch) -> SlowThread:
    slow = SlowThread()
    monkeypatch.setattr(tracker_module, "ThreadPoolExecutor", lambda *_, **__: slow)
    return slow


def followed(tracker: Tracker, thread: SlowThread, frames: range, texture: int = 1) -> list[TrackedFrame]:
    found = []
    for number in frames:
        thread.now = number
        found.append(tracker.track(frame(number % 60, texture), number / 30.0))
    return found


def runs(found: list[TrackedFrame]) -> list[tuple[str, int]]:
    return [(state, len(list(same))) for state, same in groupby(f.state for f in found)]


def check_poses(found: list[TrackedFrame], first: int = 0) -> None:
    area = field_area().area
    for number, tracked in enumerate(found, start=first):
        if tracked.cam_from_local is not None:
            utm = area.frame.utm_from_enu(tracked.cam_from_local.center, area.maps[0].epsg)
            assert error_m(tuple(utm), number % 60) < 0.3, number


def test_no_frame_waits_and_a_track_that_was_found_is_carried_to_the_frame_at_hand(
    thread: SlowThread,
) -> None:
    with Tracker(MapFinder([field_area()]), CAMERA, _LIVE) as tracker:
        found = followed(tracker, thread, range(60))
        # Found after nine frames, of which five are followed then, and the others with the next frame.
        assert runs(found) == [("lost", 10), ("relocalised", 1), ("tracking", 49)]
        assert [what for _, what in thread.asked[:2]] == ["find", "match"]
        assert not tracker.finish()
    check_poses(found)


def test_an_answer_that_comes_late_is_caught_up_with_by_frames_that_are_kept(thread: SlowThread) -> None:
    thread.delays["find"] = lambda *_: 40
    with Tracker(MapFinder([field_area()]), CAMERA, replace(_LIVE, live_frames=20)) as tracker:
        found = followed(tracker, thread, range(60))
    assert runs(found) == [("lost", 44), ("relocalised", 1), ("tracking", 15)]
    check_poses(found)


def test_maps_that_change_end_a_track_in_them_and_leave_others_alone(thread: SlowThread) -> None:
    old = field_area()
    other = IndexedArea(area=old.area, index=old.index)  # the same area, taken over: not another map
    moved = _rebuilt(old)
    with Tracker(MapFinder([old]), CAMERA, _LIVE) as tracker:
        followed(tracker, thread, range(20))
        tracker.use(MapFinder([other]))
        assert {f.state for f in followed(tracker, thread, range(20, 30))} == {"tracking"}
        tracker.use(MapFinder([moved]))
        again = followed(tracker, thread, range(30, 60))
        assert again[0].detail == "LOST: the maps have changed"
        assert runs(again) == [("lost", 10), ("relocalised", 1), ("tracking", 19)]
        grounds = [f.ground for f in again if f.ground is not None]
        assert all(isinstance(g, MapGround) and g.area is moved.area for g in grounds)
        check_poses(again, 30)
        tracker.use(MapFinder([]))
        gone = followed(tracker, thread, range(60, 90))
        assert {f.state for f in gone} == {"lost"}


def test_what_was_found_in_maps_that_have_gone_is_not_used(thread: SlowThread) -> None:
    old = field_area()
    with Tracker(MapFinder([old]), CAMERA, _LIVE) as tracker:
        followed(tracker, thread, range(5))
        tracker.use(MapFinder([]))
        assert {f.state for f in followed(tracker, thread, range(5, 30))} == {"lost"}


def _rebuilt(indexed: IndexedArea) -> IndexedArea:
    return IndexedArea(area=replace(indexed.area), index=indexed.index)


def test_frames_since_a_keyframe_get_sparser_and_the_keyframe_stays() -> None:
    gray = np.zeros((4, 4), np.uint8)
    recent = RecentFrames(8)
    for index in range(100):
        recent.add(RecentFrame(index=index, time_s=index / 30.0, gray=gray), 10 if index > 10 else None)
        assert len(recent) <= 8
        assert recent.last is not None
        assert recent.last.index == index
        since = [f.index for f in recent.since(10)]
        if index >= 10:
            assert since[0] == 10
            assert since[-1] == index
            assert since == sorted(set(since))
            assert max(np.diff(since), default=0) <= max(1.0, 4.0 * (index - 10) / 8)
    recent.add(RecentFrame(index=100, time_s=4.0, gray=gray), None)
    assert len(recent) == 1
    assert recent.since(10) == []
