"""An ingest as its arguments ask for it: options, report, and what the terminal is told."""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ingest.pipeline import IngestOptions
    from ingest.register.control.model import Survey
    from ingest.report.films import FilmOutcome
    from ingest.report.values import IngestReport, MapOutcome

_LISTED = 40  # photos that are named on the terminal


def ingest_folder(args: argparse.Namespace, folder: Path, films: Sequence["FilmOutcome"] = ()) -> int:
    """Ingest, print what happened; 0 if a map is in the database, 1 if none could be made.

    Args:
        args: of `featuredb ingest photos` or `video`.
        films: whose keyframes the folder holds, a folder for each.
    """
    from featuredb.cli.common import storage_options
    from featuredb.store import Database
    from ingest.cli.progress_bars import progress_bars
    from ingest.pipeline import ingest_photos
    from ingest.report.page import write_report

    options = _options(args, films=bool(films))
    database = Database.create(args.db, storage_options=storage_options(args))
    with progress_bars(args.quiet) as progress:
        report = replace(ingest_photos(database, folder, options, progress), films=tuple(films))
    if args.report is not None:
        write_report(args.report, report)
    sys.stdout.write(summary(report))
    made = any(outcome.status != "refused" for outcome in report.maps)
    return 0 if made or args.stop_after else 1


def summary(report: "IngestReport") -> str:
    """A few lines for the terminal; the report has the rest."""
    from ingest.register.control.evidence import residual_table
    from ingest.report.films import films_text

    lines = [
        f"{report.count('registered')} of {len(report.photos)} files registered, "
        f"{report.count('unplaced')} in maps without a place, {report.count('not_registered')} not, "
        f"{report.count('skipped')} skipped, {report.seconds:.1f} s"
    ]
    for outcome in report.maps:
        if outcome.status == "refused":
            lines.append(f"refused: {outcome.name}: {outcome.reason_code}: {outcome.reason}")
        elif outcome.status == "unplaced":
            lines += _unplaced_lines(outcome)
        else:
            lines.append(
                f"map {outcome.map_id} ({outcome.name}): {outcome.status.replace('_', ' ')}, "
                f"{outcome.photos} photos, {outcome.points} points, EPSG:{outcome.epsg}, "
                f"{'control' if outcome.control else 'GPS'} residual {outcome.residual_rms_m or 0.0:.2f} m, "
                f"place known to {outcome.radius_m or 0.0:.2f} m (95 %)"
            )
        if outcome.control is not None and outcome.control.control.marks:
            lines.extend(f"note: {text}" for text in outcome.control.file.notes)
            lines.append(residual_table(outcome.control.placement, outcome.control.control).rstrip("\n"))
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


def _unplaced_lines(outcome: "MapOutcome") -> list[str]:
    return [
        f"map {outcome.map_id} ({outcome.name}): without a place, {outcome.photos} photos, "
        f"{outcome.points} points; {outcome.reason_code}: {outcome.reason}",
        "  `featuredb maps` says what would give it one; named by --map it answers in its own frame",
    ]


def _options(args: argparse.Namespace, *, films: bool) -> "IngestOptions":
    """The pipeline's options; what the command line leaves open keeps its default."""
    from featuredb.features.extractor import ExtractorOptions
    from featuredb.index.vocabulary import read_vocabulary
    from ingest.map_builder import MapOptions
    from ingest.photos.scan import ScanOptions
    from ingest.pipeline import IngestOptions
    from ingest.reconstruction import MapMakingOptions
    from ingest.sfm.mapper import SfmOptions

    making = MapMakingOptions(
        extractor=ExtractorOptions(**_given(max_features=args.max_features, max_side_px=args.max_side)),
        sfm=SfmOptions(refine_focal=not args.keep_focal, **_given(camera_model=args.camera_model)),
        maps=MapOptions(height_datum=args.height_datum, **_given(min_track_length=args.min_track_length)),
        cameras=args.cameras,
    )
    scan = ScanOptions(
        exclude=tuple(args.exclude),
        owner=args.owner,
        licence=args.licence,
        trust_geotags=args.trust_geotags,
        films=films,
    )
    return IngestOptions(
        scan=scan,
        making=making,
        gps_sigma_m=args.gps_sigma,
        name=args.name,
        work=args.work,
        stop_after=args.stop_after,
        survey=_survey(args),
        dask=args.dask,
        vocabulary=None if args.vocabulary is None else read_vocabulary(args.vocabulary),
        **_given(workers=args.workers),
    )


def _survey(args: argparse.Namespace) -> "Survey | None":
    """The control points of --gcp."""
    if args.gcp is None:
        return None
    from ingest.cli.register import control_options
    from ingest.register.control.control_file import read_control_file
    from ingest.register.control.model import Survey

    return Survey(
        file=read_control_file(args.gcp, args.gcp_crs),
        options=control_options(args, keep_lens=args.keep_focal),
    )


def _given(**values: Any) -> dict[str, Any]:
    """The arguments that the user gave."""
    return {name: value for name, value in values.items() if value is not None}
