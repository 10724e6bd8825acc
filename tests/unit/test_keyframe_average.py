"""Registrations averaged along a track: nearer to the truth than each, steady, and begun anew when astray."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from featuredb.geometry.rigid3 import Rigid3
from ingest.track.scan_ground import KeyframeAverage
from tests.support.planar_map import view

_SIGMA = np.array([0.002, 0.002, 0.002, 0.15, 0.15, 0.15])


def flight(count: int) -> list[Rigid3]:
    """Six metres from keyframe to keyframe, turning."""
    return [view(6.0 * i, -3.0, 46.0, tilt_deg=20.0, heading_deg=5.0 * i) for i in range(count)]


def disturbed(pose: Rigid3, rng: np.random.Generator) -> Rigid3:
    return Rigid3.exp(_SIGMA * rng.standard_normal(6)) @ pose


def averaged(
    average: KeyframeAverage, true: list[Rigid3], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of the averaged poses and of the registrations (n,), metres; the track moves without error."""
    covariance = np.diag(_SIGMA**2)
    last, fused_m, registered_m = disturbed(true[0], rng), [], []
    average.begin(last, covariance)
    for before, now in pairwise(true):
        # The error of the last pose is carried along as a rigid motion of everything.
        tracked = now @ before.inverse() @ last
        registered = disturbed(now, rng)
        last = average.add(tracked, registered, covariance)
        fused_m.append(float(np.linalg.norm(last.center - now.center)))
        registered_m.append(float(np.linalg.norm(registered.center - now.center)))
    return np.array(fused_m), np.array(registered_m)


def test_the_average_is_nearer_to_the_truth_than_its_registrations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ingest.track.scan_ground._MAX_CHI2", 40.0)
    rng = np.random.default_rng(3)
    fused, registered = averaged(KeyframeAverage(), flight(400), rng)
    # A window of four: half the error, were the track without any; the old turn moves the camera a little.
    assert fused[5:].mean() < 0.55 * registered[5:].mean()
    assert fused[5:].mean() > 0.25 * registered[5:].mean()


def test_what_does_not_fit_the_track_begins_the_average_anew() -> None:
    covariance = np.diag(_SIGMA**2)
    first, second = flight(2)
    astray = Rigid3.exp(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0])) @ second
    average = KeyframeAverage()
    average.begin(first, covariance)
    np.testing.assert_array_equal(average.add(astray, second, covariance).matrix(), second.matrix())
    near = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])) @ second
    fused = average.add(near, second, covariance)
    assert 0.05 < np.linalg.norm(fused.center - second.center) < 0.15


def test_after_something_else_led_the_track_nothing_older_counts() -> None:
    covariance = np.diag(_SIGMA**2)
    first, second = flight(2)
    near = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0])) @ second
    average = KeyframeAverage()
    average.begin(first, covariance)
    average.end()
    np.testing.assert_array_equal(average.add(near, second, covariance).matrix(), second.matrix())


def test_the_surer_registration_counts_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ingest.track.scan_ground._MAX_CHI2", 1e6)
    rng = np.random.default_rng(1)
    (pose,) = flight(1)
    moved = disturbed(pose, rng)
    towards = []
    for times in (0.25, 1.0, 4.0):
        average = KeyframeAverage()
        average.begin(pose, np.diag(_SIGMA**2))
        fused = average.add(pose, moved, times * np.diag(_SIGMA**2))
        towards.append(
            np.linalg.norm(fused.center - moved.center) / np.linalg.norm(pose.center - moved.center)
        )
    assert towards[0] < towards[1] < towards[2]
    assert abs(towards[1] - 0.75 / 1.75) < 0.02
