"""A film's frames up to its end, whatever ends it."""

import signal
import threading
from collections.abc import Iterable, Iterator
from typing import Self

from featuredb.errors import VideoError
from featuredb.video.film import VideoFrame

_BY_HAND = "stopped by hand"


def until_it_ends(film: Iterable[VideoFrame], trouble: list[str]) -> Iterator[VideoFrame]:
    """The frames, up to where the film cannot be read any more or somebody presses Ctrl-C.

    What was tracked until then is not lost with it; without any frame the error is the caller's. A frame that
    the caller has in hand when Ctrl-C comes is the last one; a second Ctrl-C is not waited for.
    """
    frames, read = iter(film), 0
    with _Stop() as stop:
        while not stop.asked:
            try:
                stop.at_once = True
                frame = next(frames)
                stop.at_once = False
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


class _Stop:
    """Within it Ctrl-C is noted, and interrupts only where it is `at_once`, or `asked` already."""

    def __init__(self) -> None:
        self.asked = self.at_once = False

    def __enter__(self) -> Self:
        self._before = signal.getsignal(signal.SIGINT)
        in_main = threading.current_thread() is threading.main_thread()
        # Ctrl-C goes to the main thread, and not to what a shell has put into the background.
        self._noted = in_main and self._before != signal.SIG_IGN
        if self._noted:
            signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(self, *failed: object) -> None:
        if self._noted:
            signal.signal(signal.SIGINT, self._before)

    def _on_signal(self, *_: object) -> None:
        if self.at_once or self.asked:
            raise KeyboardInterrupt
        self.asked = True
