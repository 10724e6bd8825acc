"""A film's frames up to its end, whatever ends it."""

from collections.abc import Iterable, Iterator

from featuredb.errors import VideoError
from featuredb.video.film import VideoFrame


def until_it_ends(film: Iterable[VideoFrame], trouble: list[str]) -> Iterator[VideoFrame]:
    """The frames, up to where the film cannot be read any more or somebody presses Ctrl-C.

    What was tracked until then is not lost with it; without any frame the error is the caller's.
    """
    frames, read = iter(film), 0
    while True:
        try:
            frame = next(frames)
        except StopIteration:
            return
        except (VideoError, KeyboardInterrupt) as error:
            if not read:
                raise
            trouble.append(str(error) or "stopped by hand")
            return
        read += 1
        yield frame
