"""What became of films: their shots, the keyframes of each, and the frames that none was made of."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Literal

from ingest.html_parts import pill, table

if TYPE_CHECKING:
    from ingest.report.values import PhotoOutcome

FilmStatus = Literal["used", "refused"]

DROPPED: Mapping[str, str] = {
    "between": "between keyframes, nothing new",
    "frozen": "repeat the frame before",
    "black": "black",
    "plain": "plain",
    "title": "titles",
    "break": "match no neighbouring frame: a blink, a blur, a dissolve",
}
"""Why no keyframe was made of a frame: for programs, and for people."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShotOutcome:
    """A part of a film without a cut.

    Attributes:
        start_s, end_s: of its first and last frame, on the film's clock.
        frames: number of them. keyframes: names of those that are photos of the ingest.
        step: between keyframes, a share of the picture's longer side.
        dropped: number of the other frames by reason, see `DROPPED`.
        bars: left, top, right and bottom, burnt in, shares of the picture's width and height.
        overlay_share: of the picture within the bars that logos and captions cover, painted over.
    """

    start_s: float
    end_s: float
    frames: int
    keyframes: tuple[str, ...]
    step: float
    dropped: Mapping[str, int] = field(default_factory=dict)
    bars: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    overlay_share: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmOutcome:
    """One film.

    Attributes:
        name: the folder of its keyframes within the ingest, unique there. path: the film.
        telemetry: where it is from, and to how many keyframes it gives a position; "" without any.
        notes: what was found of the film and its telemetry, and what was wrong with them.
    """

    name: str
    path: str
    status: FilmStatus = "used"
    reason: str = ""
    telemetry: str = ""
    shots: tuple[ShotOutcome, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def frames(self) -> int:
        """Frames that were looked at."""
        return sum(shot.frames for shot in self.shots)

    @property
    def keyframes(self) -> int:
        """Photos that were made of it."""
        return sum(len(shot.keyframes) for shot in self.shots)


def films_text(films: Sequence[FilmOutcome], photos: Sequence["PhotoOutcome"]) -> list[str]:
    """Lines for the terminal: every shot, and where its keyframes are."""
    known = {photo.name: photo for photo in photos}
    lines: list[str] = []
    for film in films:
        if film.status == "refused":
            lines.append(f"film {film.name}: not used: {film.reason}")
            continue
        lines.append(f"film {film.name}: {film.keyframes} keyframes of {film.frames} frames")
        lines += [
            f"  shot {number}, {_span(shot)}: {_kept(shot, known)}; {_dropped(shot)}"
            for number, shot in enumerate(film.shots, start=1)
        ]
    return lines


def films_html(films: Sequence[FilmOutcome], photos: Sequence["PhotoOutcome"]) -> str:
    """The report's part on films; nothing where there are none."""
    if not films:
        return ""
    known = {photo.name: photo for photo in photos}
    rows: list[tuple[str, ...]] = []
    for film in films:
        rows += [
            (film.name, f"{number}: {_span(shot)}", str(shot.frames), _kept(shot, known), _dropped(shot))
            for number, shot in enumerate(film.shots, start=1)
        ]
    refused = "".join(
        f"<p>{pill('bad', 'not used')} <code>{escape(film.path)}</code>: {escape(film.reason)}</p>"
        for film in films
        if film.status == "refused"
    )
    notes = "".join(
        f'<p class="soft">{escape(film.name)}: {escape(text)}</p>' for film in films for text in film.notes
    )
    head = ("film", "shot", "frames", "keyframes", "other frames")
    return f"<h2>Films</h2><section>{refused}{table(head, rows, numbers=(2,), names=(0,))}{notes}</section>"


def _span(shot: ShotOutcome) -> str:
    return f"{shot.start_s:.1f} to {shot.end_s:.1f} s"


def _kept(shot: ShotOutcome, known: Mapping[str, "PhotoOutcome"]) -> str:
    if not shot.keyframes:
        return "no keyframes"
    where: Counter[str] = Counter()
    for name in shot.keyframes:
        photo = known.get(name)
        if photo is not None:
            where[f"in map {photo.map_id}" if photo.map_id else f"in none: {photo.reason_code}"] += 1
    said = ", ".join(f"{count} {text}" for text, count in where.most_common())
    text = f"{len(shot.keyframes)} keyframes" + (f" ({said})" if said else "")
    if any(shot.bars):
        left, top, right, bottom = shot.bars
        text += f", bars over {1.0 - (1.0 - left - right) * (1.0 - top - bottom):.0%} of the picture"
    if shot.overlay_share:
        text += f", {shot.overlay_share:.1%} under logos or captions"
    lenses = {known[name].camera_key for name in shot.keyframes if name in known}
    if len(lenses) > 1:
        text += f", the lens zooms ({len(lenses)} focal lengths)"
    return text


def _dropped(shot: ShotOutcome) -> str:
    said = [f"{shot.dropped[code]} {text}" for code, text in DROPPED.items() if shot.dropped.get(code)]
    return f"other frames: {', '.join(said)}" if said else "no other frames"
