"""A film ends at its end, at a frame that cannot be read, or by Ctrl-C; what came before is kept."""

import signal
from collections.abc import Iterator

import pytest

from featuredb.errors import VideoError
from featuredb.stop_signals import sigterm_as_ctrl_c
from reloc.tracking.film_end import until_it_ends


@pytest.fixture(autouse=True)
def foreground() -> Iterator[None]:
    """As in a terminal, wherever the tests run."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def film(end: BaseException | None = None) -> Iterator[int]:
    yield from range(3)
    if end is not None:
        raise end


def test_a_film_ends_at_its_end() -> None:
    trouble: list[str] = []
    assert list(until_it_ends(film(), trouble)) == [0, 1, 2]
    assert trouble == []


@pytest.mark.parametrize(
    ("end", "said"), [(VideoError("torn"), "torn"), (KeyboardInterrupt(), "stopped by hand")]
)
def test_frames_before_the_end_are_kept(end: BaseException, said: str) -> None:
    trouble: list[str] = []
    assert list(until_it_ends(film(end), trouble)) == [0, 1, 2]
    assert trouble == [said]


def test_without_a_frame_the_error_is_the_callers() -> None:
    with pytest.raises(VideoError, match="torn"):
        list(until_it_ends((frame for frame in _raising()), []))


def _raising() -> Iterator[int]:
    raise VideoError("torn")
    yield 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_frame_in_hand_is_the_last_one_after_ctrl_c(number: signal.Signals) -> None:
    trouble: list[str] = []
    worked = []
    with sigterm_as_ctrl_c():
        for frame in until_it_ends(film(), trouble):
            if frame == 1:
                signal.raise_signal(number)
            worked.append(frame)
    assert (worked, trouble) == ([0, 1], ["stopped by hand"])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_does_not_wait_for_the_frame_in_hand() -> None:
    frames = until_it_ends(film(), [])
    next(frames)
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    frames.close()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_where_ctrl_c_is_ignored_it_stays_so() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for _ in until_it_ends(film(), []):
        signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_ctrl_c_ends_a_wait_for_a_frame() -> None:
    def camera() -> Iterator[int]:
        yield 0
        signal.raise_signal(signal.SIGINT)
        yield 1

    trouble: list[str] = []
    assert list(until_it_ends(camera(), trouble)) == [0]
    assert trouble == ["stopped by hand"]
