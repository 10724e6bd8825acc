"""A film over the test hills, tracked by the map of a survey; the truth is known."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import reloc.tracking.track_video as track_video_module
import reloc.tracking.trajectory.files as trajectory_files_module
from featuredb.cli.main import main
from featuredb.errors import InvalidValueError, VideoError
from featuredb.geo.geopose import geopose_from_camera
from featuredb.maps.feature_map import GeoPrior
from featuredb.store import Database
from featuredb.video.film import Video, VideoFrame
from featuredb.video.writer import VideoWriter
from reloc.localise.candidates import IndexedArea
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from reloc.tracking.ground import EarthPose, Keyframe, TrackedFrame, Unmatched
from reloc.tracking.map_ground import MapFinder, MapGround
from reloc.tracking.options import TrackOptions
from reloc.tracking.tracker import Tracker
from reloc.tracking.trajectory.values import TrajectoryPoint
from tests.support.hill_photos import CAMERA, FRAME, _render
from tests.support.hill_walk import anchored_database
from tests.support.made_once import made_once
from tests.support.planar_map import field_texture
from tests.support.tracked_film import CUT, FRAMES, OPTIONS, film_frames, pose_at, tracked


@pytest.fixture(scope="module")
def anchored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_once("anchored-hills", anchored_database, tmp_path_factory) / "db"


@pytest.fixture(scope="module")
def areas(anchored: Path) -> tuple[IndexedArea, ...]:
    return Localiser.open(Database.open(anchored)).areas


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    return film_frames(tmp_path_factory)


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
        assert frame.index not in CUT
        off = frame.cam_from_local.center - area_from_hills.act(true.center)
        assert np.linalg.norm(off) < 0.3, frame.index
        assert (frame.cam_from_local @ area_from_hills).angle_to_deg(true) < 0.3
        assert frame.covariance is not None
        assert frame.inliers >= OPTIONS.min_landmarks
    states = [frame.state for frame in track]
    # The first answer comes six frames after the first frame, and again six after the first after the cut.
    assert states[:7] == ["lost"] * 6 + ["relocalised"]
    assert states[7:20] == ["tracking"] * 13
    assert states[20:24] == ["lost"] * 4
    found = states.index("relocalised", 20)
    assert found <= 24 + 2 * (OPTIONS.lost_answer_after + 1)
    assert states[found + 1 :] == ["tracking"] * (FRAMES - found - 1)


def test_a_cut_to_a_look_alike_is_a_loss(areas: tuple[IndexedArea, ...], film: list[np.ndarray]) -> None:
    """A fifth of the picture stays as it was: its landmarks agree with a pose, and are too few to believe."""
    alike = [frame.copy() for frame in film[:24]]
    for i in CUT:
        width = alike[i].shape[1] // 5
        alike[i][:, :width] = _render(field_texture(1), pose_at(i), i)[:, :width]
    track = tracked(areas, alike)
    assert [frame.state for frame in track[7:]] == ["tracking"] * 13 + ["lost"] * 4
    assert "should be in view" in track[20].detail
    without = tracked(areas, alike, replace(OPTIONS, least_kept=0.0))
    assert without[20].state == "tracking"


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
    monkeypatch.setattr(MapGround, "match", lambda *_: nothing)
    track = tracked(areas, film[:20])
    # Keyframes at frames 6, 10 and 14 are answered at 10, 14 and 18.
    assert [frame.state for frame in track[7:18]] == ["tracking"] * 11
    assert [frame.state for frame in track[18:]] == ["lost"] * 2
    assert track[18].detail == "TOO_FEW_MATCHES: nothing"


def test_frames_between_a_localised_one_and_its_answer_have_poses_in_the_end(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray]
) -> None:
    area_from_hills = areas[0].area.frame.enu_from(FRAME)
    late: dict[int, TrackedFrame] = {}
    with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
        for i, gray in enumerate(film[:12]):
            tracker.track(gray, i / 30.0)
            late |= {frame.index: frame for frame in tracker.late}
    assert [late[i].state for i in sorted(late)] == ["relocalised", *["tracking"] * 5]
    assert sorted(late) == list(range(6))
    for frame in late.values():
        assert frame.cam_from_local is not None
        off = frame.cam_from_local.center - area_from_hills.act(pose_at(frame.index).center)
        assert np.linalg.norm(off) < 0.3


def test_frames_before_a_localised_one_are_followed_backwards_to_the_cut(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray]
) -> None:
    """Of four frames of elsewhere and twelve of the map the first and the seventh are looked for."""
    area_from_hills = areas[0].area.frame.enu_from(FRAME)
    late: dict[int, TrackedFrame] = {}
    with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
        for i, gray in enumerate(film[CUT.start : CUT.start + 16]):
            tracker.track(gray, i / 30.0)
            late |= {frame.index: frame for frame in tracker.late}
    assert sorted(late) == list(range(len(CUT), 12))
    assert [late[i].state for i in sorted(late)] == ["relocalised", *["tracking"] * 7]
    for i, frame in late.items():
        assert frame.cam_from_local is not None
        off = frame.cam_from_local.center - area_from_hills.act(pose_at(CUT.start + i).center)
        assert np.linalg.norm(off) < 0.3


def test_a_film_that_ends_before_the_answer_has_its_poses(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray]
) -> None:
    for count in (1, 4):
        with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
            now = [tracker.track(gray, i / 30.0).state for i, gray in enumerate(film[:count])]
            late = tracker.finish()
            assert not tracker.finish()
        assert now == ["lost"] * count
        assert [frame.state for frame in late] == ["relocalised", *["tracking"] * (count - 1)]
        assert [frame.index for frame in late] == list(range(count))
    with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
        for i, gray in enumerate(film[:9]):
            tracker.track(gray, i / 30.0)
        assert not tracker.finish()


def test_a_film_that_ends_before_it_is_refused_says_why(areas: tuple[IndexedArea, ...]) -> None:
    with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
        for i in range(3):
            tracker.track(_render(field_texture(9), pose_at(0), 0), i / 30.0)
        (last,) = tracker.finish()
    assert (last.index, last.state) == (2, "lost")
    assert last.detail.startswith("TOO_FEW_")


def test_a_found_track_catches_up_a_few_frames_at_a_time(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray]
) -> None:
    """No frame waits for all of them, and the poses are those of one that does."""
    slowly = replace(OPTIONS, catch_up=3)
    at_once: dict[int, TrackedFrame] = {}
    late: dict[int, TrackedFrame] = {}
    with (
        Tracker(MapFinder(areas), CAMERA, slowly) as slow,
        Tracker(MapFinder(areas), CAMERA, OPTIONS) as fast,
    ):
        for i, gray in enumerate(film[:12]):
            now, then = slow.track(gray, i / 30.0), fast.track(gray, i / 30.0)
            assert len(slow.late) <= 3
            assert now.state == ("lost" if i < 8 else "relocalised" if i == 8 else "tracking")
            at_once |= {frame.index: frame for frame in (*fast.late, then) if frame.cam_from_local}
            late |= {frame.index: frame for frame in (*slow.late, now) if frame.cam_from_local}
    assert sorted(late) == sorted(at_once) == list(range(12))
    for i in range(8):
        found, wanted = late[i].cam_from_local, at_once[i].cam_from_local
        assert found is not None
        assert wanted is not None
        np.testing.assert_array_equal(found.matrix(), wanted.matrix())
    # The film ends, or the maps are taken back, while it catches up.
    with Tracker(MapFinder(areas), CAMERA, slowly) as slow:
        for i, gray in enumerate(film[:8]):
            slow.track(gray, i / 30.0)
        assert [frame.index for frame in slow.finish()] == [6, 7]
    with Tracker(MapFinder(areas), CAMERA, slowly) as slow:
        for i, gray in enumerate(film[:8]):
            slow.track(gray, i / 30.0)
        slow.use(MapFinder(()))
        assert slow.track(film[8], 8 / 30.0).detail == "LOST: the maps have changed"
        assert not slow.late


def test_searches_in_vain_do_not_count_against_the_track_that_is_found(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three keyframes in a row without the map are a loss, whatever was looked for before."""
    monkeypatch.setattr(MapGround, "match", lambda *_: Unmatched(reason="TOO_FEW_MATCHES", detail="nothing"))
    other = _render(field_texture(9), pose_at(0), 0)
    track = tracked(areas, [other] * 18 + film[:16], replace(OPTIONS, catch_up=3))
    # Searches at 0, 6 and 12 are in vain; that of 18 is answered at 24, and caught up with at 26.
    assert [frame.state for frame in track[:27]] == ["lost"] * 26 + ["relocalised"]
    assert [frame.state for frame in track[27:]] == ["tracking"] * 7


def test_pictures_that_come_slowly_are_each_looked_for(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray]
) -> None:
    """Flow does not bridge them; each is found before the next but one comes."""
    rows = list(range(0, 20, 5))
    found: dict[int, TrackedFrame] = {}
    with Tracker(MapFinder(areas), CAMERA, OPTIONS) as tracker:
        for i, row in enumerate(rows):
            now = tracker.track(film[row], 2.0 * i)
            found |= {frame.index: frame for frame in (*tracker.late, now) if frame.cam_from_local}
        found |= {frame.index: frame for frame in tracker.finish()}
    assert sorted(found) == list(range(len(rows)))
    area_from_hills = areas[0].area.frame.enu_from(FRAME)
    for i, frame in found.items():
        assert frame.cam_from_local is not None
        off = frame.cam_from_local.center - area_from_hills.act(pose_at(rows[i]).center)
        assert np.linalg.norm(off) < 0.3


def test_where_the_film_begins_says_nothing_after_a_loss(
    areas: tuple[IndexedArea, ...], film: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    latitude, longitude, _ = FRAME.geodetic_from_enu(pose_at(0).center)
    prior = GeoPrior(
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        height_m=None,
        sigma_horizontal_m=20.0,
        sigma_vertical_m=100.0,
    )
    asked: list[GeoPrior | None] = []
    real = MapFinder.find

    def noted(
        self: MapFinder, gray: np.ndarray, request: LocaliseRequest, options: TrackOptions
    ) -> Keyframe | Unmatched:
        asked.append(request.prior)
        return real(self, gray, request, options)

    monkeypatch.setattr(MapFinder, "find", noted)
    with Tracker(MapFinder(areas), CAMERA, OPTIONS, LocaliseRequest(prior=prior)) as tracker:
        for i, gray in enumerate(film[:32]):
            tracker.track(gray, i / 30.0)
    assert asked[0] is prior
    assert len(asked) > 1
    assert set(asked[1:]) == {None}


def test_frames_that_were_tracked_stay_as_they_were(film: list[np.ndarray]) -> None:
    """The answer to a keyframe of before the loss comes after it."""
    known = EarthPose(
        epsg=32632,
        utm=np.zeros(3),
        height_datum="unknown",
        cam_from_utm_xyzw=np.array([0.0, 0.0, 0.0, 1.0]),
        geopose=geopose_from_camera(pose_at(0), FRAME),
        covariance=np.eye(6),
        map_id="m",
    )
    points = [
        TrajectoryPoint(index=i, time_s=i / 30.0, state=state, pose=None if state == "lost" else known)
        for i, state in enumerate(["relocalised", "tracking", "lost", "lost", "relocalised"])
    ]
    late = [
        TrackedFrame(index=i, time_s=i / 30.0, state="relocalised" if i == 1 else "tracking") for i in (1, 2)
    ]
    track_video_module._filled(points, late)
    assert points[1].state == "tracking"
    assert points[1].pose is known
    assert points[2].state == "tracking"
    assert [p.state for p in points[3:]] == ["lost", "relocalised"]


def test_a_film_that_breaks_off_keeps_what_was_tracked(
    areas: tuple[IndexedArea, ...], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = track_video_module.open_video

    class Breaking:
        def __init__(self, video: Video) -> None:
            self._video = video
            self.info, self.report = video.info, video.report

        def __enter__(self) -> "Breaking":
            self._video.__enter__()
            return self

        def __exit__(self, *error: object) -> None:
            self._video.__exit__(*error)  # type: ignore[arg-type]

        def __iter__(self) -> Iterator[VideoFrame]:
            for k, frame in enumerate(self._video):
                if k == 12:
                    raise VideoError("film.mp4: reading failed after the frame at 0.37 s")
                yield frame

    monkeypatch.setattr(track_video_module, "open_video", lambda *args: Breaking(real(*args)))
    found = track_video_module.track_video(folder / "film.mp4", MapFinder(areas), camera=CAMERA)
    assert len(found.trajectory.points) == 12
    assert "reading failed" in found.complaints[0]


def test_one_file_that_cannot_be_written_does_not_cost_the_others(
    anchored: Path,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(trajectory: object) -> str:
        raise InvalidValueError("crosses a zone")

    monkeypatch.setitem(trajectory_files_module._FORMATS, ".tum", refuse)
    outs = ["--out", str(tmp_path / "t.tum"), "--out", str(tmp_path / "t.csv")]
    assert main(["track", str(anchored), str(folder / "film.mp4"), *outs, "--end", "0.5"]) == 2
    assert "t.tum: crosses a zone" in capsys.readouterr().err
    assert (tmp_path / "t.csv").exists()
    (tmp_path / "file").write_text("")
    nowhere = ["--out", str(tmp_path / "file" / "t.csv")]
    assert main(["track", str(anchored), str(folder / "film.mp4"), *nowhere]) not in (0, 1)
    assert "a folder that can be written" in capsys.readouterr().err


@pytest.fixture(scope="module")
def folder(anchored: Path, film: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The database, and the film as an mp4."""
    folder = tmp_path_factory.mktemp("film")
    with VideoWriter(folder / "film.mp4", width=CAMERA.width, height=CAMERA.height, fps=30.0) as writer:
        for gray in film:
            writer.write(gray)
    return folder
