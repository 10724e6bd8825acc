"""Many films in one ingest: which they are, the keyframes of each, and one folder of them all."""

import os
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from featuredb.errors import FeatureDbError, TelemetryError, VideoError
from featuredb.video.telemetry.read import SIDECAR_SUFFIXES
from featuredb.video.telemetry.values import Telemetry
from ingest.executor import Progress, no_progress
from ingest.fingerprint import digest
from ingest.photos.walk import walk
from ingest.report.films import FilmOutcome
from ingest.video.stills import Stills, StillsOptions, make_stills

FILM_SUFFIXES = (".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".webm", ".avi", ".ts", ".mts", ".m2ts")


@dataclass(frozen=True, slots=True, kw_only=True)
class Films:
    """Keyframes of films, in one folder.

    Attributes:
        outcomes: every film, in order; keyframes by their names within the folder.
        heights: what the heights of positions count from; more than one where films differ.
    """

    folder: Path
    outcomes: tuple[FilmOutcome, ...]
    heights: frozenset[str]


def find_films(named: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Films among files and folders, searched through, each once; nothing is opened.

    Those of folders are sorted by name. Beside them: notes on what in the folders is none.

    Raises:
        IngestError: a folder cannot be listed.
        VideoError: there is no film in the folders.
    """
    paths: dict[Path, Path] = {}
    notes: list[str] = []
    for path in named:
        if not path.is_dir():
            paths.setdefault(path.absolute(), path)
            continue
        found = walk(path)
        films = [f.path for f in found if f.path.suffix.lower() in FILM_SUFFIXES and not f.reason_code]
        paths |= {film.absolute(): film for film in films if film.absolute() not in paths}
        bad = Counter(f.reason for f in found if f.reason_code)
        notes += [f"{path}: {count} not looked at: {reason}" for reason, count in bad.items()]
        others = len(found) - len(films) - sum(bad.values())
        others -= sum(f.path.suffix.lower() in SIDECAR_SUFFIXES and not f.reason_code for f in found)
        if others:
            notes.append(f"{path}: {others} files are no films by their names ({', '.join(FILM_SUFFIXES)})")
    if not paths:
        said = "; ".join(notes) or "the folder is empty"
        raise VideoError(
            f"{', '.join(map(str, named))}: expected films, found none ({said}); folders of pictures go to "
            "`featuredb ingest photos`"
        )
    return list(paths.values()), notes


def make_films(
    paths: Sequence[Path],
    telemetry_of: Callable[[Path], Telemetry | None],
    root: Path,
    options: StillsOptions,
    progress: Progress = no_progress,
) -> Films:
    """Keyframes of every film below `root`; films that cannot be used do not stop the others.

    Args:
        telemetry_of: of a film; None for none.

    Of several films, those whose telemetry cannot be read or laid on them are used without it.

    Raises:
        VideoError, TelemetryError: the only film cannot be used; or none of several.
    """
    made: list[tuple[FilmOutcome, Stills | None]] = []
    names: Counter[str] = Counter()
    for path in paths:
        stem = path.stem.lstrip(".") or "film"
        names[stem] += 1
        name = stem if names[stem] == 1 else f"{stem} ({names[stem]})"
        try:
            made.append(_made(name, path, telemetry_of, root, options, progress, alone=len(paths) == 1))
        except FeatureDbError as error:
            if len(paths) == 1:
                raise
            made.append((FilmOutcome(name=name, path=str(path), status="refused", reason=str(error)), None))
    if sum(outcome.keyframes for outcome, _ in made) < 2:
        said = "; ".join(outcome.reason or f"{outcome.path}: one keyframe" for outcome, _ in made)
        raise VideoError(f"two keyframes are needed for a map: {said}: the picture hardly moves")
    return Films(
        folder=_linked([(outcome.name, stills) for outcome, stills in made if stills is not None], root),
        outcomes=tuple(outcome for outcome, _ in made),
        heights=frozenset(stills.heights for _, stills in made if stills is not None and stills.positions),
    )


def _made(
    name: str,
    path: Path,
    telemetry_of: Callable[[Path], Telemetry | None],
    root: Path,
    options: StillsOptions,
    progress: Progress,
    *,
    alone: bool,
) -> tuple[FilmOutcome, Stills]:
    """The keyframes of one film; one of several does without telemetry that is of no use."""
    said = ""
    notes: tuple[str, ...] = ()
    try:
        telemetry = telemetry_of(path)
        stills = make_stills(path, telemetry, root, options, progress)
        if telemetry is not None:
            source = telemetry.origin or telemetry.source
            said = f"telemetry of {source}: {stills.positions} keyframes have a position, "
            said += f"heights {stills.heights}"
    except TelemetryError as error:
        if alone:
            raise
        stills, notes = make_stills(path, None, root, options, progress), (f"without its telemetry: {error}",)
    shots = tuple(
        replace(shot, keyframes=tuple(f"{name}/{file}" for file in shot.keyframes)) for shot in stills.shots
    )
    return FilmOutcome(
        name=name, path=str(path), telemetry=said, shots=shots, notes=(*notes, *stills.notes)
    ), stills


def _linked(films: Sequence[tuple[str, Stills]], root: Path) -> Path:
    """A folder with all keyframes as links, FILM/NNNNNN.jpg, named by what it holds."""
    content = [part for name, stills in films for part in (name, stills.folder.name)]
    folder = root / "films" / digest(*content)[:16]
    for name, stills in films:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for shot in stills.shots:
            for file in shot.keyframes:
                _link(stills.folder / file, folder / name / file)
    return folder


def _link(source: Path, target: Path) -> None:
    """The same file under another name; a copy where the file system has no links."""
    try:
        if target.exists() and target.samefile(source):
            return
        target.unlink(missing_ok=True)
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
