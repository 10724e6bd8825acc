"""Telemetry that DJI's (and Autel's) drones write as subtitles: .SRT files, or a track of subtitles.

The time of a sample is the time at which its block is shown first. Drones of the older dialects write one
block a second and do not say when within it the receiver was read, so that places lag by up to a second;
estimating that is left to those who see the pictures. The clock is the drone's local time, zone not known.
"""

import math
import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from featuredb.errors import TelemetryError
from featuredb.geometry.arrays import FloatArray
from featuredb.video.telemetry.axis_order import ThirdValue, decide_order
from featuredb.video.telemetry.formats.srt_fields import BlockFields, looks_like_telemetry, parse_block
from featuredb.video.telemetry.formats.text import decode_text, parse_wall_clock
from featuredb.video.telemetry.values import METRES_PER_DEGREE, Telemetry, assemble, check_count

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


# Coarser than what any receiver of these drones does: worth telling.
_COARSE_M = 5.0


def read_srt(data: bytes, origin: str = "subtitles") -> Telemetry:
    """The telemetry of a drone's subtitle file.

    Args:
        data: the file's bytes, UTF-8 or UTF-16, any line ends.

    Raises:
        TelemetryError: no subtitles, no telemetry in them, no position, or an order of coordinates that
            cannot be told.
    """
    if not data.strip():
        raise TelemetryError(f"{origin}: the file is empty; was the recording interrupted?")
    return telemetry_of_blocks(split_blocks(decode_text(data)), origin)


def telemetry_of_blocks(blocks: Sequence[Subtitle], origin: str) -> Telemetry:
    """The telemetry of subtitles that were read already; arguments and errors as for `read_srt`."""
    check_count(len(blocks), origin)
    if not any(looks_like_telemetry(block.text) for block in blocks):
        first = next((f"; the first says {block.text[:60]!r}" for block in blocks if block.text), "")
        raise TelemetryError(
            f"{origin}: {len(blocks)} subtitles, none with a drone's telemetry (expected words like GPS(...) "
            f"or [latitude: ...]){first}"
        )
    parsed = [parse_block(block.text) for block in blocks]
    warnings: list[str] = []
    whole = _whole(blocks, parsed, warnings)
    if not whole:
        raise TelemetryError(f"{origin}: its only subtitle is cut off; was the recording interrupted?")
    blocks, parsed = blocks[:whole], parsed[:whole]
    times = _times(blocks, origin, warnings)
    decimals = max(fields.decimals for fields in parsed)
    _place_pairs(parsed, origin, warnings)
    _tell_heights(parsed, warnings)
    step_m = METRES_PER_DEGREE * 10.0**-decimals
    if decimals >= 0 and step_m > _COARSE_M:
        warnings.append(f"coordinates are written in steps of {step_m:.0f} m")
    names = {name for fields in parsed for name in fields.row}
    columns = {name: np.array([fields.row.get(name, np.nan) for fields in parsed]) for name in names}
    dialects = list(dict.fromkeys(fields.dialect for fields in parsed if fields.dialect))
    if len(dialects) > 1:
        warnings.append(f"{len(dialects)} dialects in one file: recordings of several drones were joined")
    return assemble(
        columns | times,
        source=", ".join(["SRT", *filter(None, [" + ".join(dialects)])]),
        origin=origin,
        clock="local",
        in_video_time="times_s" in times,
        warnings=warnings,
    )


def _whole(blocks: Sequence[Subtitle], parsed: list[BlockFields], warnings: list[str]) -> int:
    """Number of blocks without a cut-off last one. Damaged ones before it stay, without what they lost."""
    whole = len(blocks)
    last = blocks[-1].text
    # A cut may have left a block that looks like another kind: then it is compared with the one before it.
    kinds = [fields.dialect for fields in parsed[:-1] if fields.dialect]
    kind = parsed[-1].dialect if parsed[-1].dialect in kinds or not kinds else kinds[-1]
    same = [block.text for block, fields in zip(blocks[:-1], parsed, strict=False) if fields.dialect == kind]
    same = [text for text in same if not is_cut_off(text)]
    if is_cut_off(last) or lacks_words(last, same):
        warnings.append("the last block is cut off and left out")
        whole -= 1
    damaged = sum(is_cut_off(block.text) for block in blocks[:whole])
    if damaged:
        warnings.append(f"{damaged} of {len(blocks)} blocks are damaged; what is left of them is used")
    return whole


def _times(blocks: Sequence[Subtitle], origin: str, warnings: list[str]) -> dict[str, FloatArray]:
    """Seconds of the clock, and of the video in files with such times; columns for `assemble`."""
    found = [parse_wall_clock(block.text) for block in blocks]
    clocks = np.array([clock.seconds if clock else math.nan for clock in found])
    times = np.array([block.start_s for block in blocks])
    if np.isfinite(times).any():
        return {"times_s": times, "clock_s": clocks}
    if not np.isfinite(clocks).any():
        raise TelemetryError(f"{origin}: its blocks have neither times of the video nor a clock")
    warnings.append("no times of the video: times are those of its clock since the first sample")
    return {"clock_s": clocks}


def _place_pairs(parsed: list[BlockFields], origin: str, warnings: list[str]) -> None:
    """Gives the unnamed coordinates their names, dialect by dialect."""
    kinds: dict[str, list[BlockFields]] = defaultdict(list)
    for fields in parsed:
        if np.isfinite(fields.pair).all() and "latitude_deg" not in fields.row:
            kinds[fields.dialect].append(fields)
    for dialect, rows in kinds.items():
        thirds: set[ThirdValue] = {fields.third for fields in rows}
        step_deg = 10.0 ** -min(max(fields.decimals for fields in rows), 15)
        decision = decide_order(
            f"{origin} ({dialect})" if len(kinds) > 1 else origin,
            _column_of(rows, "pair"),
            _column_of(rows, "home"),
            np.array([fields.distance_m for fields in rows]),
            thirds.pop() if len(thirds) == 1 else "none",
            step_deg,
        )
        if not decision.certain:
            warnings.append(
                f"order of coordinates: {decision.evidence}; nothing else in the file confirms it"
            )
        names = ("latitude_deg", "longitude_deg")
        for fields in rows:
            fields.row.update(
                zip(names if decision.order == "lat_lon" else names[::-1], fields.pair, strict=True)
            )


def _column_of(rows: list[BlockFields], name: str) -> FloatArray:
    return np.array([getattr(fields, name) for fields in rows], dtype=np.float64).reshape(-1, 2)


def _tell_heights(parsed: list[BlockFields], warnings: list[str]) -> None:
    """Heights beside the coordinates, where they are heights and say something."""
    metres = [fields for fields in parsed if fields.third in ("metres", "decimal")]
    if any(fields.third_value != 0.0 for fields in metres):
        for fields in metres:
            fields.row.setdefault("height_m", fields.third_value)
    elif metres:
        warnings.append("the heights beside the coordinates are 0 throughout and not used")
    if any(fields.altitude_unnamed for fields in parsed):
        warnings.append(
            'heights are called "altitude" without saying above what; some models count them from take-off'
        )
