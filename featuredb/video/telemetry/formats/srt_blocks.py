"""Subtitles as blocks: the time at which each begins, and its text without markup."""

import math
import re
from collections import Counter
from dataclasses import dataclass

_TIMES = re.compile(r"^\s*(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})\s*-->\s*\d{1,3}:\d{2}:\d{2}[,.]\d{1,3}")
_NUMBER_LINE = re.compile(r"^\s*\d{1,9}\s*$")
_MARKUP = re.compile(r"<[^<>]{0,200}>|\{\\[^{}]{0,200}\}")
_WORD = re.compile(r"[A-Za-z][A-Za-z_]*")
_MISSING = re.compile(r"\bn/a\b", re.IGNORECASE)
# Known blocks have 100 to 400 characters; what is longer is no telemetry.
_MAX_BLOCK_CHARS = 4000
# Blocks before the last one with which it is compared; enough to see what every block of the kind has.
_COMPARED = 20


@dataclass(frozen=True, slots=True)
class Subtitle:
    """One subtitle.

    Attributes:
        start_s: when it is shown first, seconds of the video; NaN in files without such times.
        text: its lines without markup and without its number.
    """

    start_s: float
    text: str


def split_blocks(text: str) -> list[Subtitle]:
    """The blocks of a SubRip text, in their order.

    A block begins at its line of times. Where a file has none (it happens), a line with nothing but a number
    begins a block.
    """
    lines = re.split(r"\r\n|\r|\n", text)
    starts = [(row, _start_s(match)) for row, line in enumerate(lines) if (match := _TIMES.match(line))]
    if not starts:
        starts = [(row, math.nan) for row, line in enumerate(lines) if _NUMBER_LINE.match(line)]
    ends = [*(row for row, _ in starts), len(lines)][1:]
    return [
        Subtitle(start_s, plain_text(_without_number(lines[row + 1 : end])))
        for (row, start_s), end in zip(starts, ends, strict=True)
    ]


def _start_s(match: re.Match[str]) -> float:
    hours, minutes, seconds = (float(match[part]) for part in (1, 2, 3))
    return 3600.0 * hours + 60.0 * minutes + seconds + float(f"0.{match[4]}")


def has_times(text: str) -> bool:
    """Whether a line of SubRip's times is in the text."""
    return any(_TIMES.match(line) for line in text.splitlines())


def plain_text(lines: list[str]) -> str:
    """Lines as one text without markup, cut to what a block of telemetry can have."""
    return _MARKUP.sub(" ", "\n".join(lines)[:_MAX_BLOCK_CHARS]).strip()


def _without_number(lines: list[str]) -> list[str]:
    """The lines of a block without the number of the next one at their end."""
    end = len(lines)
    while end and not lines[end - 1].strip():
        end -= 1
    if end and _NUMBER_LINE.match(lines[end - 1]):
        end -= 1
    return lines[:end]


def is_cut_off(text: str) -> bool:
    """Whether a bracket is left open, which no dialect does."""
    return text.count("[") > text.count("]") or text.count("(") > text.count(")")


def lacks_words(text: str, before: list[str]) -> bool:
    """Whether words (names of fields, units) are missing that every earlier block of the kind has.

    A recording that ends in a crash or with a full card leaves a last block that ends anywhere; a number cut
    short would be wrong by any amount, and only what should follow it tells.
    """
    common: Counter[str] | None = None
    for other in before[-_COMPARED:]:
        words = _words(other)
        common = words if common is None else common & words
    return bool(common and common - _words(text))


def _words(text: str) -> Counter[str]:
    # Values that are not known count as nothing, so that a fix found or lost at the end is not a cut.
    return Counter(_WORD.findall(_MISSING.sub(" ", text)))
