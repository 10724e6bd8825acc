"""Keyframes by the picture's motion: evenly spaced by what was seen, sharp, and none across a cut."""

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.video.film import VideoFrame
from ingest.video.keyframes import KeyframeOptions, choose_keyframes
from ingest.video.motion import Motion, measure_motion
from tests.support.films import picture


def _motion(
    shifts: list[float],
    broken: tuple[int, ...] = (),
    sharp: dict[int, float] | None = None,
    cuts: tuple[int, ...] = (),
) -> Motion:
    """A picture that moves right by shares of its side."""
    count = len(shifts)
    step = np.tile(np.eye(2, 3), (count, 1, 1))
    step[:, 0, 2] = shifts
    return Motion(
        index=np.arange(count) + 5,
        time_s=np.arange(count) / 25.0,
        step=step,
        broken=np.isin(np.arange(count), (0, *broken)),
        cut=np.isin(np.arange(count), (0, *cuts)),
        kind=np.zeros(count, dtype=np.int8),
        sharpness=np.array([(sharp or {}).get(k, 1.0) for k in range(count)]),
    )


_EXACT = KeyframeOptions(window=0, least=0)


def test_keyframes_are_a_step_apart() -> None:
    choice = choose_keyframes(_motion([0.03] * 21), _EXACT)
    assert choice.index == tuple(5 + k for k in (0, 4, 8, 12, 16, 20))
    assert choice.step == (0.12,)
    assert choice.time_s[1] == pytest.approx(4 / 25)
    assert set(choice.shot) == {0}


def test_a_shaking_picture_is_not_a_moving_one() -> None:
    """To and fro: each step is half of what makes a keyframe, and the place is always the same."""
    choice = choose_keyframes(_motion([0.06, -0.06] * 40), _EXACT)
    assert choice.index == (5,)


def test_where_the_film_stands_still_there_is_nothing_to_choose() -> None:
    still = [0.0] * 30
    choice = choose_keyframes(_motion([*[0.04] * 7, *still, *[0.04] * 6]), _EXACT)
    rows = [k - 5 for k in choice.index]
    assert rows == [0, 3, 6, 39, 42]


def test_the_sharpest_frame_around_is_taken() -> None:
    motion = _motion([0.03] * 21, sharp={1: 2.0, 7: 3.0, 13: 2.0, 18: 2.0})
    rows = [k - 5 for k in choose_keyframes(motion, KeyframeOptions(window=2, least=0)).index]
    assert rows[:2] == [1, 7]
    assert rows == sorted(set(rows))


def test_a_long_film_has_longer_steps_up_to_a_limit() -> None:
    motion = _motion([0.03] * 401)
    few = choose_keyframes(motion, KeyframeOptions(most=50, window=0, least=0))
    assert 40 <= len(few.index) <= 50
    assert 0.2 < few.step[0] <= 0.3
    # Neighbours must overlap: the limit of the step goes before that of the number.
    many = choose_keyframes(motion, KeyframeOptions(most=10, window=0, least=0))
    assert many.step == (0.3,)
    assert len(many.index) > 10


def test_the_work_grows_with_the_film_and_not_with_its_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """How many frames are composed for each keyframe."""
    seen: list[int] = []
    real = np.vstack

    def counted(*args: object, **more: object) -> object:
        seen.append(1)
        return real(*args, **more)  # type: ignore[call-overload]

    monkeypatch.setattr("ingest.video.keyframes.np.vstack", counted)
    choose_keyframes(_motion([0.03] * 400), KeyframeOptions(window=0, most=200, least=0))
    assert len(seen) <= 2 * 400


def test_nothing_goes_across_a_break() -> None:
    choice = choose_keyframes(_motion([0.03] * 30, broken=(10, 11, 20), cuts=(11,)), _EXACT)
    rows = [k - 5 for k in choice.index]
    # Frame 10 stands alone between two breaks; only the second is a cut.
    assert 10 not in rows
    assert choice.shot == tuple(0 if r < 10 else 1 for r in rows)
    assert {0, 11, 20} <= set(rows)


@pytest.mark.parametrize("bad", [{"step": 0.0}, {"most": 1}, {"step": 0.4}, {"window": -1}])
def test_bad_options_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match="out of range"):
        KeyframeOptions(**bad)  # type: ignore[arg-type]


def _frames(pictures: list[np.ndarray]) -> list[VideoFrame]:
    return [
        VideoFrame(index=k, time_s=k / 25.0, gray=np.ascontiguousarray(p[:, :, 0]), rgb=lambda p=p: p)  # type: ignore[misc]
        for k, p in enumerate(pictures)
    ]


def test_the_motion_of_a_film_is_measured() -> None:
    """The test films' window moves right by four pixels a frame: what is seen moves left."""
    motion = measure_motion(_frames([picture(k, 320, 240) for k in range(6)]))
    assert motion.broken.tolist() == [True] + [False] * 5
    np.testing.assert_allclose(motion.step[1:, 0, 2], -4.0 / 320, atol=2e-4)
    np.testing.assert_allclose(motion.step[1:, :, :2], np.tile(np.eye(2), (5, 1, 1)), atol=2e-3)


def test_text_that_is_burnt_in_does_not_hold_the_picture() -> None:
    pictures = [picture(k, 320, 240).copy() for k in range(4)]
    rng = np.random.default_rng(3)
    text = rng.integers(0, 2, (24, 120, 1), dtype=np.uint8) * 255
    for p in pictures:
        p[8:32, 8:128] = text
    motion = measure_motion(_frames(pictures))
    np.testing.assert_allclose(motion.step[1:, 0, 2], -4.0 / 320, atol=5e-4)


def test_a_cut_and_a_black_frame_are_breaks() -> None:
    rng = np.random.default_rng(7)
    other = np.repeat(
        rng.integers(0, 255, (15, 20), dtype=np.uint8).repeat(16, 0).repeat(16, 1)[..., None], 3, 2
    )
    black = np.zeros_like(other)
    motion = measure_motion(_frames([picture(0, 320, 240), picture(1, 320, 240), other, other, black, black]))
    assert motion.broken.tolist() == [True, False, True, False, True, True]
    np.testing.assert_array_equal(motion.step[2], np.eye(2, 3))


def test_blur_is_less_sharp() -> None:
    import cv2

    sharp = picture(0, 320, 240)
    motion = measure_motion(_frames([sharp, cv2.GaussianBlur(sharp, (9, 9), 2.0)]))
    assert motion.sharpness[1] < 0.5 * motion.sharpness[0]


def test_a_short_film_has_shorter_steps_but_none_below_the_shortest() -> None:
    choice = choose_keyframes(_motion([0.01] * 100), KeyframeOptions(window=0))
    assert 24 <= len(choice.index) <= 30
    assert 0.02 <= choice.step[0] < 0.12
    still = choose_keyframes(_motion([0.001] * 100), KeyframeOptions(window=0))
    assert still.step == (0.02,)
    assert len(still.index) <= 6
