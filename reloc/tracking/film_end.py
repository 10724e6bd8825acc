"""A film's frames up to its end, whatever ends it."""

import signal
import threading
from collections.abc import Iterable, Iterator

from featuredb.errors import VideoError
from featuredb.video.film import VideoFrame

STOPPED = "stopped by hand"


def until_it_ends(film: Iterable[VideoFrame], trouble: list[str]) -> Iterator[VideoFrame]:
    """The frames, up to where the film cannot be read any more or somebody presses Ctrl-C.

    So does SIGTERM where it is handled (`sigterm_as_ctrl_c`).

    What was tracked until then is not lost with it; without any frame the error is the caller's. A frame that
    the caller has in hand when Ctrl-C comes is the last one; a second Ctrl-C is not waited for.
    """
    asked = at_once = False

    def on_signal(*_: object) -> None:
        nonlocal asked
        if at_once or asked:
            raise KeyboardInterrupt
        asked = True

    frames, read = iter(film), 0
    # Ctrl-C goes to the main thread, and not to what a shell has put into the background.
    main = threading.current_thread() is threading.main_thread()
    handled = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM) if main}
    before = {number: handler for number, handler in handled.items() if callable(handler)}
    for number in before:
        signal.signal(number, on_signal)
    try:
        while not asked:
            try:
                at_once = True
                frame = next(frames)
                at_once = False
            except StopIteration:
                return
            except (VideoError, KeyboardInterrupt) as error:
                if not read:
                    raise
                trouble.append(str(error) or STOPPED)
                return
            read += 1
            yield frame
        trouble.append(STOPPED)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
