"""A film's frames up to its end, whatever ends it."""

import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from featuredb.errors import VideoError
from featuredb.video.film import VideoFrame


def until_it_ends(film: Iterable[VideoFrame], trouble: list[str]) -> Iterator[VideoFrame]:
    """The frames, up to where the film cannot be read any more or somebody presses Ctrl-C.

    What was tracked until then is not lost with it; without any frame the error is the caller's. A frame that
    the caller has in hand when Ctrl-C comes is the last one; a second Ctrl-C is not waited for.
    """
    frames, read = iter(film), 0
    with _last_frame_by_sigint() as stop:
        while not stop.asked:
            try:
                with stop.at_once():
                    frame = next(frames)
            except StopIteration:
                return
            except (VideoError, KeyboardInterrupt) as error:
                if not read:
                    raise
                trouble.append(str(error) or _BY_HAND)
                return
            read += 1
            yield frame
    trouble.append(_BY_HAND)


_BY_HAND = "stopped by hand"


class _Stop:
    """What Ctrl-C does. Attributes: asked: it was pressed."""

    def __init__(self) -> None:
        self.asked = self._at_once = False

    def __call__(self, *_: object) -> None:
        if self._at_once or self.asked:
            raise KeyboardInterrupt
        self.asked = True

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Within it Ctrl-C interrupts."""
        self._at_once = True
        try:
            yield
        finally:
            self._at_once = False


@contextmanager
def _last_frame_by_sigint() -> Iterator[_Stop]:
    stop = _Stop()
    before = signal.getsignal(signal.SIGINT)
    # Ctrl-C goes to the main thread, and not to what a shell has put into the background.
    if threading.current_thread() is not threading.main_thread() or before == signal.SIG_IGN:
        yield stop
        return
    signal.signal(signal.SIGINT, stop)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
