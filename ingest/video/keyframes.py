"""Which frames of a film become photos: by how far the picture has moved, and the sharpest around there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from featuredb.errors import InvalidValueError
from featuredb.geometry.arrays import FloatArray
from ingest.video.motion import Motion


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeOptions:
    """How dense keyframes are.

    Attributes:
        step: the picture has moved by so much from one to the next, a share of its longer side: the mean way
            of the corners of its inner half. 0.12 leaves seven eighths in common; structure from motion wants
            each point in three photos, and light enough that matching stays quick.
        most: keyframes of a film at most; a longer one has longer steps, up to `max_step`, and more keyframes
            beyond. Each shot has its share, `least` if need be.
        max_step: neighbours must overlap.
        least: a shot that has fewer keyframes has shorter steps, down to `min_step`: so many are matched all
            with all anyway, and a shot of a few seconds gives too few photos otherwise (seven of
            12 s of a flight straight ahead, of which no map came; of 25 one came).
        min_step: below it neighbours are the same photo.
        window: frames before and after the one that is due among which the sharpest is taken; fewer where the
            last keyframe is near.
    """

    step: float = 0.12
    most: int = 60
    max_step: float = 0.3
    least: int = 24
    min_step: float = 0.02
    window: int = 4

    def __post_init__(self) -> None:
        steps = 0.0 < self.min_step <= self.step <= self.max_step < 1.0
        if not (steps and self.most >= 2 and 0 <= self.least <= self.most and self.window >= 0):
            raise InvalidValueError(f"KeyframeOptions: value out of range in {self}")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframeChoice:
    """The chosen frames.

    Attributes:
        shot: number of the one that each lies in.
        step: that was used for each shot.
    """

    index: tuple[int, ...]
    time_s: tuple[float, ...]
    shot: tuple[int, ...]
    step: tuple[float, ...]


def choose_keyframes(motion: Motion, options: KeyframeOptions | None = None) -> KeyframeChoice:
    """Choose keyframes of every shot, none where the picture stands still, none twice."""
    options = options or KeyframeOptions()
    shots = shots_of(motion)
    most = max(options.most // max(1, len(shots)), options.least, 2)
    chosen = [_of_shot(motion, shot, most, options) for shot in shots]
    rows = [row for of_shot, _ in chosen for row in of_shot]
    return KeyframeChoice(
        index=tuple(motion.index[rows].tolist()),
        time_s=tuple(motion.time_s[rows].tolist()),
        shot=tuple(number for number, (of_shot, _) in enumerate(chosen) for _ in of_shot),
        step=tuple(step for _, step in chosen),
    )


def shots_of(motion: Motion) -> tuple[NDArray[np.int64], ...]:
    """Rows of the frames of every shot; frames that show no place are with the shot before them."""
    begins = np.flatnonzero(motion.cut)[1:]
    return tuple(part for part in np.split(np.arange(len(motion)), begins) if len(part))


def _of_shot(
    motion: Motion, shot: NDArray[np.int64], most: int, options: KeyframeOptions
) -> tuple[list[int], float]:
    """Rows of a shot's keyframes, and the step between them."""
    step = options.step
    rows = _rows(motion, shot, step, options.window)
    while len(rows) > most and step < options.max_step:
        step = min(options.max_step, step * max(1.05, 0.98 * len(rows) / most))
        rows = _rows(motion, shot, step, options.window)
    while len(rows) < options.least and step > options.min_step:
        step = max(options.min_step, step * min(0.95, max(0.5, len(rows) / options.least)))
        rows = _rows(motion, shot, step, options.window)
    return rows, step


# The corners of the picture's inner half, homogeneous, in shares of the longer side.
_INNER: FloatArray = np.array([[x, y, 1.0] for x in (-0.25, 0.25) for y in (-0.15, 0.15)], dtype=np.float64)


def _rows(motion: Motion, shot: NDArray[np.int64], step: float, window: int) -> list[int]:
    """Rows of a shot's frames at which the picture has moved by a step since the last one, and the ends."""
    chosen: list[int] = []
    for segment in np.split(shot, np.flatnonzero(motion.broken[shot])):
        if len(segment) < 2:
            continue  # a single frame between two breaks: a blink
        picked = [_sharpest(motion, segment, 0, None, window)]
        place, moved = _due(motion, segment, picked[-1], step)
        while place is not None:
            picked.append(_sharpest(motion, segment, place, picked[-1], window))
            place, moved = _due(motion, segment, picked[-1], step)
        last = len(segment) - 1
        if moved > 0.5 * step and last > picked[-1]:
            picked.append(_sharpest(motion, segment, last, picked[-1], window))
        if len(picked) > 1 or len(segment) > 2 * window:  # a moment between two breaks shows little
            chosen.extend(int(segment[p]) for p in picked)
    return chosen


def _due(motion: Motion, segment: NDArray[np.int64], start: int, step: float) -> tuple[int | None, float]:
    """The first place of a segment at which the picture has moved by a step since `start`, and by how much.

    None where there is none; the way is that to the end then.
    """
    total, moved = np.eye(3), 0.0
    for place in range(start + 1, len(segment)):
        total = np.vstack([motion.step[segment[place]], [0.0, 0.0, 1.0]]) @ total
        moved = float(np.linalg.norm((_INNER @ total.T)[:, :2] - _INNER[:, :2], axis=1).mean())
        if moved >= step:
            return place, moved
    return None, moved


def _sharpest(motion: Motion, segment: NDArray[np.int64], place: int, last: int | None, window: int) -> int:
    """The sharpest frame within the window around a place of a segment; nearer to it than to the last one."""
    back = window if last is None else min(window, (place - last - 1) // 2)
    first, end = max(0, place - back), min(len(segment), place + window + 1)
    return first + int(np.argmax(motion.sharpness[segment[first:end]]))
