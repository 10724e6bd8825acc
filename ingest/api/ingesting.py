"""What a person says of an ingest, and the ingest of photos that follows from it."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

from featuredb.errors import InvalidValueError
from featuredb.features.extractor import ExtractorOptions
from featuredb.store import Database
from ingest.api.progress_bars import progress_bars
from ingest.map_builder import MapOptions
from ingest.photos.scan import ScanOptions
from ingest.pipeline import IngestOptions, ingest_photos
from ingest.reconstruction import MapMakingOptions, Stage
from ingest.register.control.control_file import read_control_file
from ingest.register.control.maps import Survey
from ingest.register.control.placement import GcpOptions
from ingest.register.control.report import residual_table
from ingest.report.films import FilmOutcome, films_text
from ingest.report.page import write_report
from ingest.report.values import IngestReport
from ingest.sfm.mapper import SfmOptions

_LISTED = 40  # photos that are named on the terminal


class IngestChoices(TypedDict, total=False):
    """Choices of an ingest, all optional; None is the default, as in `featuredb ingest photos --help`.

    exclude: globs of files to skip. name: of the map. owner, licence: of photos that do not name theirs.
    trust_geotags: positions of a table place active maps. cameras: whether photos of one camera share a lens.
    camera_model: COLMAP's name. keep_focal: do not refine focal lengths. max_features: per photo.
    max_side: pixels. min_track_length: photos that see a point with descriptors. height_datum: of the
    positions. gps_sigma: metres, horizontal and vertical. gcp: a file of control points, with gcp_crs,
    gcp_sigma (m), ground_height (m and its sigma). work: folder of unfinished work. stop_after: a stage.
    dask: address of a scheduler. workers: processes.
    """

    exclude: Sequence[str]
    name: str
    owner: str
    licence: str
    trust_geotags: bool
    cameras: Literal["shared", "per-image"]
    camera_model: str | None
    keep_focal: bool
    max_features: int | None
    max_side: int | None
    min_track_length: int | None
    height_datum: str
    gps_sigma: tuple[float, float] | None
    gcp: Path | None
    gcp_crs: str | None
    gcp_sigma: tuple[float, float] | None
    ground_height: tuple[float, float] | None
    work: Path | None
    stop_after: Stage | None
    dask: str | None
    workers: int | None


def ingest(
    database: Database,
    folder: Path,
    options: IngestOptions,
    films: Sequence[FilmOutcome] = (),
    *,
    report: Path | None = None,
    quiet: bool = False,
) -> IngestReport:
    """Make maps of photos, with bars that show the progress.

    Args:
        films: whose keyframes the folder holds.

    Raises:
        IngestError, StoreError: see `ingest_photos`.
    """
    with progress_bars(quiet) as progress:
        done = replace(ingest_photos(database, folder, options, progress), films=tuple(films))
    if report is not None:
        write_report(report, done)
    return done


def ingest_options(*, films: bool = False, **choices: Unpack[IngestChoices]) -> IngestOptions:
    """The pipeline's options; what is left open keeps its default.

    Raises:
        InvalidValueError, ControlFileError: a choice that cannot be.
    """
    asked: dict[str, Any] = {**choices}
    unknown = asked.keys() - IngestChoices.__annotations__.keys()
    if unknown:
        raise InvalidValueError(
            f"ingest: expected some of {', '.join(sorted(IngestChoices.__annotations__))}, found "
            f"{', '.join(sorted(unknown))}"
        )
    of_points = [name for name in ("gcp_crs", "gcp_sigma", "ground_height") if asked.get(name) is not None]
    if of_points and asked.get("gcp") is None:
        raise InvalidValueError(f"ingest: {', '.join(of_points)}: expected gcp beside it, control points")
    for name in ("max_features", "max_side", "min_track_length", "workers"):
        check_kind(f"ingest: {name}", asked.get(name), Integral, "a whole number")
    for name in ("gps_sigma", "gcp_sigma", "ground_height"):
        pair = (0, 0) if asked.get(name) is None else several(asked[name])
        if len(pair) != 2 or not all(isinstance(value, Real) for value in pair):
            raise InvalidValueError(f"ingest: {name}: expected two numbers in metres, found {asked[name]!r}")
    for glob in several(asked.get("exclude") or ()):
        check_kind("ingest: exclude", glob, str, "globs such as *_small.JPG")
    if asked.get("work") is not None:
        asked["work"] = as_path(asked["work"])

    def given(**names: str) -> dict[str, Any]:
        return {name: asked[choice] for name, choice in names.items() if asked.get(choice) is not None}

    keep_focal = bool(asked.get("keep_focal"))
    making = MapMakingOptions(
        extractor=ExtractorOptions(**given(max_features="max_features", first_octave_px="max_side")),
        sfm=SfmOptions(refine_focal=not keep_focal, **given(camera_model="camera_model")),
        maps=MapOptions(**given(height_datum="height_datum", min_track_length="min_track_length")),
        **given(cameras="cameras"),
    )
    scan = ScanOptions(
        exclude=several(asked.get("exclude") or ()),
        films=films,
        **given(owner="owner", licence="licence", trust_geotags="trust_geotags"),
    )
    return IngestOptions(
        scan=scan,
        making=making,
        survey=_survey(asked, keep_focal),
        **given(
            gps_sigma_m="gps_sigma", name="name", work="work", stop_after="stop_after", dask="dask",
            workers="workers",
        ),
    )  # fmt: skip


def as_path(path: Any) -> Path:
    """
    Raises:
        InvalidValueError: no path.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in str(path):
        raise InvalidValueError(f"expected a path, found {path!r}")
    return Path(path)


def check_kind(name: str, value: Any, kind: type, what: str = "") -> None:
    """Raises InvalidValueError: the value is neither None nor of the kind, which people call `what`."""
    if value is not None and not isinstance(value, kind):
        what = what or f"{kind.__module__}.{kind.__qualname__}"
        raise InvalidValueError(f"{name}: expected {what}, found {value!r}")


def several(given: Any) -> tuple[Any, ...]:
    """One or several; a text is one, and not its letters."""
    return tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else (given,)


def _survey(asked: dict[str, Any], keep_focal: bool) -> Survey | None:
    if asked.get("gcp") is None:
        return None
    return Survey(
        file=read_control_file(as_path(asked["gcp"]), asked.get("gcp_crs")),
        options=GcpOptions(
            sigma_m=asked.get("gcp_sigma"), ground_m=asked.get("ground_height"), keep_lens=keep_focal
        ),
    )


def summary(report: IngestReport) -> str:
    """A few lines for the terminal; the report has the rest."""
    lines = [
        f"{report.count('registered')} of {len(report.photos)} files registered, "
        f"{report.count('unplaced')} in maps without a place, {report.count('not_registered')} not, "
        f"{report.count('skipped')} skipped, {report.seconds:.1f} s"
    ]
    for outcome in report.maps:
        if outcome.status == "refused":
            lines.append(f"refused: {outcome.name}: {outcome.reason_code}: {outcome.reason}")
        elif outcome.status == "retired":
            way = "; `featuredb promote` takes it into service again" if outcome.epsg else ""
            lines.append(
                f"map {outcome.map_id} ({outcome.name}): was retired ({outcome.reason}) and stays so{way}"
            )
        elif outcome.status == "unplaced":
            lines += [
                f"map {outcome.map_id} ({outcome.name}): without a place, {outcome.photos} photos, "
                f"{outcome.points} points; {outcome.reason_code}: {outcome.reason}",
                "  `featuredb maps` says what would give it one; named by --map it answers in its own frame",
            ]
        else:
            lines.append(
                f"map {outcome.map_id} ({outcome.name}): {outcome.status.replace('_', ' ')}, "
                f"{outcome.photos} photos, {outcome.points} points, EPSG:{outcome.epsg}, "
                f"{'control' if outcome.control else 'GPS'} residual {outcome.residual_rms_m or 0.0:.2f} m"
            )
            lines.extend(f"  {words}" for words in outcome.place_words)
        if outcome.control is not None and outcome.control.control.marks:
            lines.extend(f"note: {text}" for text in outcome.control.control.file.notes)
            lines.append(residual_table(outcome.control).rstrip("\n"))
    lines += films_text(report.films, report.photos)
    left_out = [photo for photo in report.photos if photo.status in ("not_registered", "skipped")]
    lines.extend(f"  {p.name}: {p.reason_code}: {p.reason}" for p in left_out[:_LISTED])
    if len(left_out) > _LISTED:
        counts = Counter(p.reason_code for p in left_out[_LISTED:])
        more = ", ".join(f"{count} {code}" for code, count in counts.most_common())
        lines.append(f"  and {len(left_out) - _LISTED} more: {more}; --report DIR has them all")
    lines.extend(f"warning: {warning}" for outcome in report.maps for warning in outcome.warnings)
    lines.extend(f"warning: {warning}" for warning in report.warnings)
    return "\n".join(lines) + "\n"
