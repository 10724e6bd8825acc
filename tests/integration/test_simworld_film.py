"""Films of the simulated town: frames, truth and telemetry belong together."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.simworld.camera.photograph import render_depth
from featuredb.simworld.world import WorldOptions, town_of
from featuredb.video.frames import VideoOptions, open_video
from featuredb.video.telemetry.read import read_telemetry
from tools.worlds.film_world import (
    FILM_FILE,
    GPS_SIGMA_M,
    TELEMETRY_FILE,
    TELEMETRY_LATE_S,
    FilmOptions,
    FlightPath,
    PathOptions,
    film_frame,
    film_truth,
    write_film,
)

pytestmark = pytest.mark.evaluation  # worlds of studies

_WORLD = replace(WorldOptions.short(1), town_size_m=(180.0, 160.0))
_OPTIONS = FilmOptions(
    world=_WORLD,
    path=PathOptions(half_extent_m=(30.0, 25.0)),
    frames=10,
    width=320,
    height=180,
    cut=(4, 6),
    samples=2,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_film(tmp_path_factory.mktemp("film"), _OPTIONS, workers=2)


def test_the_film_has_the_frames_and_the_truth_their_poses(folder: Path) -> None:
    truth = film_truth(_OPTIONS)
    with open_video(folder / FILM_FILE, VideoOptions()) as video:
        frames = [(f.time_s, f.gray.copy()) for f in video]
    assert len(frames) == len(truth.times_s) == _OPTIONS.frames
    np.testing.assert_allclose([t for t, _ in frames], truth.times_s, atol=1e-3)
    assert truth.at_home.tolist() == [not 4 <= i < 6 for i in range(10)]
    assert [p is None for p in truth.cam_from_local] == (~truth.at_home).tolist()
    # Encoded, a frame is still the one that this process draws: processes agree, and so do their orders.
    for i in (0, 5, 9):
        drawn = cv2.cvtColor(film_frame(_OPTIONS, i), cv2.COLOR_RGB2GRAY).astype(float)
        assert np.abs(drawn - frames[i][1]).mean() < 6.0
    assert np.abs(frames[3][1].astype(float) - frames[4][1]).mean() > 15.0  # the cut


def test_a_finished_film_is_left_as_it_is(folder: Path) -> None:
    before = (folder / FILM_FILE).stat().st_mtime_ns
    write_film(folder, _OPTIONS, workers=1)
    assert (folder / FILM_FILE).stat().st_mtime_ns == before


def test_frames_show_the_town_from_where_the_truth_says(folder: Path) -> None:
    """A frame, carried by true depth and poses into one ten frames later, fits it; by wrong poses not."""
    options = replace(_OPTIONS, frames=40, cut=None, ev_range=0.0, width=640, height=360)
    path = FlightPath(town_of(_WORLD), replace(options.path, duration_s=40 / 30))
    a, b = path.pose(options.time_s(20)), path.pose(options.time_s(30))
    first, second = (
        cv2.GaussianBlur(cv2.cvtColor(film_frame(options, i), cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        for i in (20, 30)
    )
    depth = render_depth(town_of(_WORLD), options.camera, b).depth
    v, u = np.indices(depth.shape)
    pixels = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=1)
    rays = np.concatenate([options.camera.unproject(pixels), np.ones((len(pixels), 1))], axis=1)
    points = b.inverse().act(rays * depth.reshape(-1, 1))

    def misfit(shift_m: float) -> float:
        moved = a.act(points) + np.array([shift_m, 0.0, 0.0])
        where = options.camera.project(moved).astype(np.float32).reshape(*depth.shape, 2) - 0.5
        carried = cv2.remap(first, where, None, cv2.INTER_LINEAR, borderValue=0).astype(float)
        inside = carried > 0
        return float(np.median(np.abs(carried - second)[inside]))

    assert misfit(0.0) < 0.6 * min(misfit(0.3), misfit(-0.3))


def test_a_rolling_shutter_shows_its_rows_one_after_the_other() -> None:
    """The first rows are those of half a frame before, the middle ones those of the frame's own time."""
    still = replace(_OPTIONS, frames=20, cut=None, ev_range=0.0, rate_hz=10.0)
    between = replace(still, frames=40, rate_hz=20.0)
    rolling = replace(still, readout_s=0.1)

    def grey(options: FilmOptions, frame: int) -> np.ndarray:
        picture = cv2.cvtColor(film_frame(options, frame), cv2.COLOR_RGB2GRAY)
        return cv2.GaussianBlur(picture, (0, 0), 1.0).astype(float)

    def apart(a: np.ndarray, b: np.ndarray, rows: slice) -> float:
        return float(np.abs(a[rows] - b[rows]).mean())

    rolled, now, before, after = grey(rolling, 8), grey(still, 8), grey(between, 15), grey(between, 17)
    top, middle, bottom = slice(0, 8), slice(86, 94), slice(172, 180)
    assert apart(rolled, before, top) < 0.8 * apart(rolled, now, top) < 0.8 * apart(rolled, after, top)
    assert apart(rolled, now, middle) < 0.7 * min(apart(rolled, before, middle), apart(rolled, after, middle))
    assert apart(rolled, after, bottom) < 0.7 * apart(rolled, now, bottom)


def test_telemetry_lies_where_the_camera_was_a_moment_before(folder: Path) -> None:
    telemetry = read_telemetry(folder / TELEMETRY_FILE)
    truth = film_truth(_OPTIONS)
    assert len(telemetry) == _OPTIONS.frames
    path = FlightPath(town_of(_WORLD), replace(_OPTIONS.path, duration_s=_OPTIONS.frames / 30.0))
    for i in np.flatnonzero(truth.at_home):
        place = truth.frame.enu_from_geodetic(
            np.array(
                [
                    telemetry.latitude_deg[i],
                    telemetry.longitude_deg[i],
                    truth.frame.height_m,
                ]
            )
        )
        then = path.pose(float(truth.times_s[i]) - TELEMETRY_LATE_S).center
        assert np.linalg.norm(place[:2] - then[:2]) < 5.0 * GPS_SIGMA_M


def test_jerky_flights_turn_faster_and_both_keep_to_their_place() -> None:
    scene = town_of(_WORLD)
    turns = {}
    for style in ("smooth", "jerky"):
        path = FlightPath(scene, PathOptions(style=style))
        poses = [path.pose(t) for t in np.arange(0.0, 40.0, 1 / 30)]
        steps = [(a.rotation @ b.rotation.T, b.center - a.center) for a, b in pairwise(poses)]
        degrees = 30 * np.degrees([np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)) for r, _ in steps])
        speeds = 30 * np.linalg.norm([d for _, d in steps], axis=1)
        turns[style] = float(np.percentile(degrees, 95))
        assert speeds.max() < 25.0
        assert min(p.center[2] for p in poses) > 30.0
    assert turns["smooth"] < 60.0 < turns["jerky"]


def test_flights_through_roofs_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="heights_m"):
        PathOptions(heights_m=(5.0, 10.0))
