"""The report as one page: no network, no scripts, pictures inside."""

import math
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ingest.html_parts import duration, folded, note, number, page, picture, pill, table
from ingest.plot_parts import plan_png
from ingest.register.control.report import control_html
from ingest.report.films import films_html
from ingest.report.values import IngestReport, MapOutcome, PhotoOutcome, report_json
from ingest.workspace import write_json_and_page

REPORT_JSON = "report.json"

_FILE_PILLS = {
    "registered": ("good", "in a map"),
    "unplaced": ("fair", "in a map without a place"),
    "not_registered": ("fair", "not registered"),
    "skipped": ("none", "skipped"),
}
_MAP_PILLS = {
    "committed": ("good", "committed"),
    "already_there": ("good", "was there already"),
    "unplaced": ("fair", "kept without a place"),
    "retired": ("fair", "retired before, and stays so"),
    "refused": ("bad", "refused"),
}
# As `ingest.register.gps` names them; those of `angles` stand below it there. What has no line is not shown.
FIGURES = {
    "photos_with_gps": "photos that have a position",
    "inliers": "photos whose position agrees; others are far out. Of more than 400 as many, evenly in time, "
    "place the map",
    "rms_horizontal_m": "distance of used positions from the photos' places in the map (RMS), metres",
    "rms_vertical_m": "the same in height",
    "noise_m": "estimated noise of one position, horizontally and in height, metres",
    "drift_m": "estimated drift of the receiver from the first photo to the last, the same way",
    "lag_s": "by how many seconds positions are late; 0 where that is not known",
    "bias_sigma_m": "by what all positions may be wrong together (68 % an axis: east, north, up), metres",
    "scale_sigma": "what the scale is known to (68 %), as a share",
    "turn_sigma_deg": "what the turn is known to about its worst axis (68 %), degrees",
    "checked_turn_sigma_deg": "the same if nothing were assumed of how the photos are held",
    "log10_chance": "how often positions of other photos would fit as well, as a power of ten",
    "told": "whether photos tell their own angles; if not, they are taken to be held level",
    "tilt_off_deg": "median angle in the map between photos and what they tell, or level",
    "upside_down": "whether the positions lay the photos upside down",
    "tilt_contradicts": "whether that is more than such angles are ever wrong by",
    "yaw_off_deg": "median angle in the map between the photos' compass or gimbal and north",
    "yaw_contradicts": "whether that is more than such angles are ever wrong by",
}


def write_report(folder: Path, report: IngestReport) -> None:
    """Write `report.json` and `report.html` into the folder, each atomically."""
    write_json_and_page(folder / "report", report_json(report), report_page(report))


def report_page(report: IngestReport) -> str:
    """The page as HTML. Everything that comes from files is escaped."""
    title = f"Ingest of {report.folder.rstrip('/').rsplit('/', 1)[-1] or report.folder}"
    document = report_json(report)
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="soft">from <code>{escape(report.folder)}</code> '
        f"into <code>{escape(report.database)}</code>, "
        f"started {report.started:%Y-%m-%d %H:%M:%S %Z}, job <code>{escape(report.job_id[:16])}</code></p>",
        _cards(report),
        *(note(warning) for warning in report.warnings),
        *(_map(outcome) for outcome in report.maps),
        films_html(report.films, report.photos),
        _stages(report),
        _files(report),
        folded("Options", document["options"]),
        folded("Versions", document["versions"]),
    ]
    return page(title, parts)


def _cards(report: IngestReport) -> str:
    placed = sum(outcome.status != "refused" for outcome in report.maps)
    points = sum(outcome.points for outcome in report.maps if outcome.status != "refused")
    figures = (
        (f"{report.count('registered')} of {len(report.photos)}", "files are in a map"),
        (str(report.count("unplaced")), "files are in a map without a place"),
        (str(report.count("not_registered")), "usable, but not registered"),
        (str(report.count("skipped")), "skipped"),
        (str(placed), "map" if placed == 1 else "maps"),
        (f"{points:,}", "points"),
        (duration(report.seconds), "wall time"),
    )
    cards = (f'<div class="card"><b>{escape(value)}</b><span>{what}</span></div>' for value, what in figures)
    return f'<div class="cards">{"".join(cards)}</div>'


def _map(outcome: MapOutcome) -> str:
    reason = ""
    if outcome.status in ("refused", "unplaced"):
        reason = f'<p class="note stop"><b>{escape(outcome.reason_code)}</b>: {escape(outcome.reason)}</p>'
    method = "GPS" if outcome.control is None else "control points"
    facts = [
        ("photos", str(outcome.photos)),
        ("points", f"{outcome.points:,}"),
        ("observations", f"{outcome.observations:,}, {outcome.descriptors:,} with descriptors"),
        ("reprojection error", _error_words(outcome)),
        (f"residual to {method}", number(outcome.residual_rms_m, "{:.2f} m root mean square")),
        *(words.split(": ", 1) for words in outcome.place_words),
        ("scale", number(outcome.scale, "{:.4g} m per unit of the reconstruction")),
        ("coordinates", f"EPSG:{outcome.epsg}, heights: {outcome.height_datum}" if outcome.epsg else "none"),
        ("map id", outcome.map_id or "none"),
    ]
    control = ""
    if outcome.control is not None and outcome.control.control.marks:
        control = control_html(outcome.control)
    notes = "".join(note(warning) for warning in outcome.warnings)
    pictures = ""
    if outcome.plan is not None:
        pictures = picture(plan_png(outcome.plan), "The map from above, and the residuals of its positions")
    return (
        f"<h2>Map {escape(outcome.name)} {pill(*_MAP_PILLS[outcome.status])}</h2><section>{reason}{notes}"
        + table((), facts, names=(0,))
        + pictures
        + control
        + _cameras(outcome)
        + _gates(outcome)
        + "</section>"
    )


def _error_words(outcome: MapOutcome) -> str:
    """Of its points; nothing where there are none."""
    if not len(outcome.errors_px):
        return ""
    median, most = np.percentile(outcome.errors_px, (50, 99))
    views = np.median(outcome.track_lengths)
    return f"median {median:.2f} px, 99 % below {most:.2f} px; a point is seen by {views:.0f} photos (median)"


def _gates(outcome: MapOutcome) -> str:
    """What the placement rests on; that by GPS with a line about each figure."""
    if outcome.control is not None:
        return folded("Gates and their figures", outcome.gates)
    rows = figure_rows(outcome.gates)
    if not rows:
        return ""
    head = ("figure", "value", "what it says")
    return f"<details><summary>Figures of the placement by GPS</summary>{table(head, rows)}</details>"


def _cameras(outcome: MapOutcome) -> str:
    if not outcome.cameras:
        return ""
    rows = []
    for camera in outcome.cameras:
        before, after = camera.focal_before_px, camera.focal_after_px
        change = f"{100 * (after / before - 1):+.1f} %" if before else ""
        rows.append(
            (
                camera.name,
                f"{camera.width}x{camera.height}",
                camera.model,
                str(camera.photos),
                number(before, "{:.0f}"),
                f"{after:.0f}",
                change,
            )
        )
    head = ("camera", "size", "model", "photos", "focal length by EXIF, px", "refined, px", "change")
    return "<h3>Cameras</h3>" + table(head, rows, numbers=(3, 4, 5, 6), names=(0,))


def _stages(report: IngestReport) -> str:
    if not report.stages:
        return ""
    longest = max(stage.seconds for stage in report.stages) or 1.0
    rows = [
        (
            stage.name,
            f"{stage.seconds:.1f} s",
            f'<div class="bar" style="width:{100 * stage.seconds / longest:.1f}%"></div>',
            f"{stage.reused} of {stage.total} from an earlier run" if stage.reused else "",
        )
        for stage in report.stages
    ]
    pairs = f"{report.verified_pairs} of {report.pairs} pairs of photos have verified matches."
    bars = table((), rows, numbers=(1,), html=(2,))
    return f'<h2>Time</h2><section class="bars">{bars}<p class="soft">{pairs}</p></section>'


def _files(report: IngestReport) -> str:
    head = ("file", "outcome", "why, and remarks", "size", "features", "matches", "observations", "error, px")
    rows = table(
        (*head, "GPS off by, m"),
        (_file_row(photo) for photo in report.photos),
        numbers=(4, 5, 6, 7, 8),
        names=(0,),
        html=(1, 2, 8),
    )
    return f'<h2>All {len(report.photos)} files</h2><section class="wide">{rows}</section>'


def _file_row(photo: PhotoOutcome) -> tuple[str, ...]:
    remarks = [escape(photo.reason)] if photo.reason else []
    remarks += [f'<span class="soft">{escape(warning)}</span>' for warning in photo.warnings]
    residual = ""
    if photo.gps_residual_m:
        east, north, up = photo.gps_residual_m
        residual = f"{math.hypot(east, north):.2f}" + (f"<br>{up:+.2f} up" if math.isfinite(up) else "")
        if photo.gps_used is False:
            remarks.append("its GPS was not used: it contradicts the others'")
    elif photo.status != "skipped" and not photo.has_gps:
        remarks.append('<span class="soft">no GPS</span>')
    return (
        photo.name,
        pill(*_FILE_PILLS[photo.status]),
        "<br>".join(remarks),
        f"{photo.width}x{photo.height}" if photo.width else "",
        *(number(count, "{:,}") for count in (photo.features, photo.matches, photo.observations)),
        number(photo.reprojection_px, "{:.2f}"),
        residual,
    )


def figure_rows(figures: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value and meaning of each figure, in the order above."""
    known = {**figures, **figures.get("angles", {})}
    return [
        (name, _value(known[name]), what) for name, what in FIGURES.items() if known.get(name) is not None
    ]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return "not known"
    if isinstance(value, list | tuple):
        return ", ".join(_value(one) for one in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)
