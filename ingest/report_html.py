"""The report as one page: no network, no scripts, pictures inside."""

import base64
import json
import math
from collections.abc import Iterable, Sequence
from html import escape

from ingest.report import IngestReport, MapOutcome, PhotoOutcome, report_json
from ingest.report_plots import histograms_png, plan_png

_STYLE = """
:root{--ink:#1b2733;--soft:#5b6b7a;--line:#dfe5ea;--good:#2e7d32;--fair:#b26a00;--bad:#c62828;--back:#f6f8fa}
*{box-sizing:border-box}body{margin:0;background:var(--back);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:25px;margin:0 0 4px}h2{font-size:19px;margin:36px 0 10px}h3{font-size:15px;margin:22px 0 6px}
p{margin:6px 0}.soft{color:var(--soft)}code{font:12.5px ui-monospace,Menlo,Consolas,monospace}
section{background:#fff;border:1px solid var(--line);border-radius:10px;padding:16px 20px;margin:14px 0}
.cards{display:flex;flex-wrap:wrap;gap:12px;margin:18px 0}
.card{background:#fff;border:1px solid var(--line);border-radius:10px;padding:10px 18px;min-width:130px}
.card b{display:block;font-size:25px;line-height:1.25}.card span{color:var(--soft);font-size:13px}
table{border-collapse:collapse;width:100%;font-size:13px}
th{text-align:left;color:var(--soft);font-weight:600;border-bottom:1px solid var(--line);padding:5px 8px}
td{border-bottom:1px solid #eef1f4;padding:4px 8px;vertical-align:top}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
td.name{overflow-wrap:anywhere;min-width:130px}
.pill{border-radius:9px;padding:1px 9px;font-size:12px;white-space:nowrap;color:#fff}
.good{background:var(--good)}.fair{background:var(--fair)}.bad{background:var(--bad)}.none{background:#78879a}
.wide{overflow-x:auto}img{max-width:100%;height:auto;display:block;margin:10px auto}
.track{width:55%}.bar{background:#3f7fbf;height:11px;border-radius:3px;min-width:1px}
.note{border-left:4px solid var(--fair);background:#fff8ec;padding:8px 14px;
margin:10px 0;border-radius:0 6px 6px 0}
.stop{border-left-color:var(--bad);background:#fdf0ef}
details{margin:10px 0}summary{cursor:pointer;color:var(--soft)}
pre{font-size:12px;white-space:pre-wrap;overflow-wrap:anywhere}
"""
_FILE_PILLS = {
    "registered": ("good", "in a map"),
    "not_registered": ("fair", "not registered"),
    "skipped": ("none", "skipped"),
}
_MAP_PILLS = {
    "committed": ("good", "committed"),
    "already_there": ("good", "was there already"),
    "refused": ("bad", "refused"),
}


def report_page(report: IngestReport) -> str:
    """The page as HTML. Everything that comes from files is escaped."""
    title = f"Ingest of {report.folder.rstrip('/').rsplit('/', 1)[-1] or report.folder}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="soft">from <code>{escape(report.folder)}</code> '
        f"into <code>{escape(report.database)}</code>, "
        f"started {report.started:%Y-%m-%d %H:%M:%S %Z}, job <code>{escape(report.job_id[:16])}</code></p>",
        _cards(report),
        *(_note(warning) for warning in report.warnings),
        *(_map(outcome) for outcome in report.maps),
        _stages(report),
        _files(report),
        _options(report),
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body><main>"
        + "\n".join(parts)
        + "</main></body></html>\n"
    )


def _cards(report: IngestReport) -> str:
    placed = sum(outcome.status != "refused" for outcome in report.maps)
    points = sum(outcome.points for outcome in report.maps if outcome.status != "refused")
    figures = (
        (f"{report.count('registered')} of {len(report.photos)}", "files are in a map"),
        (str(report.count("not_registered")), "usable, but not registered"),
        (str(report.count("skipped")), "skipped"),
        (str(placed), "map" if placed == 1 else "maps"),
        (f"{points:,}", "points"),
        (_duration(report.seconds), "wall time"),
    )
    cards = (f'<div class="card"><b>{escape(value)}</b><span>{what}</span></div>' for value, what in figures)
    return f'<div class="cards">{"".join(cards)}</div>'


def _map(outcome: MapOutcome) -> str:
    reason = ""
    if outcome.status == "refused":
        reason = f'<p class="note stop"><b>{escape(outcome.reason_code)}</b>: {escape(outcome.reason)}</p>'
    facts = [
        ("photos", str(outcome.photos)),
        ("points", f"{outcome.points:,}"),
        ("observations", f"{outcome.observations:,}, {outcome.descriptors:,} with descriptors"),
        ("residual to GPS", _number(outcome.residual_rms_m, "{:.2f} m root mean square")),
        ("scale", _number(outcome.scale, "{:.4g} m per unit of the reconstruction")),
        ("coordinates", f"EPSG:{outcome.epsg}, heights: {outcome.height_datum}" if outcome.epsg else "none"),
        ("map id", outcome.map_id or "none"),
    ]
    notes = "".join(_note(warning) for warning in outcome.warnings)
    pictures = ""
    if outcome.plan is not None:
        pictures += _picture(plan_png(outcome.plan), "Plan view and side view of the map")
    if len(outcome.errors_px):
        pictures += _picture(histograms_png(outcome), "Reprojection errors and track lengths")
    return (
        f"<h2>Map {escape(outcome.name)} {_pill(*_MAP_PILLS[outcome.status])}</h2><section>{reason}{notes}"
        + _table((), facts, names=(0,))
        + pictures
        + _cameras(outcome)
        + _folded("Gates and their figures", outcome.gates)
        + "</section>"
    )


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
                _number(before, "{:.0f}"),
                f"{after:.0f}",
                change,
            )
        )
    head = ("camera", "size", "model", "photos", "focal length by EXIF, px", "refined, px", "change")
    return "<h3>Cameras</h3>" + _table(head, rows, numbers=(3, 4, 5, 6), names=(0,))


def _stages(report: IngestReport) -> str:
    if not report.stages:
        return ""
    longest = max(stage.seconds for stage in report.stages) or 1.0
    rows = ""
    for stage in report.stages:
        reused = f"{stage.reused} of {stage.total} from an earlier run" if stage.reused else ""
        rows += (
            f'<tr><td>{escape(stage.name)}</td><td class="n">{stage.seconds:.1f} s</td>'
            f'<td class="track"><div class="bar" style="width:{100 * stage.seconds / longest:.1f}%"></div>'
            f'</td><td class="soft">{reused}</td></tr>'
        )
    pairs = f"{report.verified_pairs} of {report.pairs} pairs of photos have verified matches."
    return f'<h2>Time</h2><section><table>{rows}</table><p class="soft">{pairs}</p></section>'


def _files(report: IngestReport) -> str:
    head = (
        "file",
        "outcome",
        "why, and remarks",
        "size",
        "features",
        "matches",
        "observations",
        "error, px",
        "GPS off by, m",
    )
    numbers = (4, 5, 6, 7, 8)
    cells = "".join(f'<th class="{"n" if i in numbers else ""}">{h}</th>' for i, h in enumerate(head))
    rows = "".join(_file_row(photo) for photo in report.photos)
    return (
        f'<h2>All {len(report.photos)} files</h2><section class="wide"><table><thead><tr>{cells}</tr></thead>'
        f"<tbody>{rows}</tbody></table></section>"
    )


def _file_row(photo: PhotoOutcome) -> str:
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
    figures = (
        _count(photo.features),
        _count(photo.matches),
        _count(photo.observations),
        _number(photo.reprojection_px, "{:.2f}"),
        residual,
    )
    size = f"{photo.width}x{photo.height}" if photo.width else ""
    return (
        f'<tr><td class="name">{escape(photo.name)}</td><td>{_pill(*_FILE_PILLS[photo.status])}</td>'
        f"<td>{'<br>'.join(remarks)}</td><td>{size}</td>"
        + "".join(f'<td class="n">{figure}</td>' for figure in figures)
        + "</tr>"
    )


def _options(report: IngestReport) -> str:
    document = report_json(report)
    return _folded("Options", document["options"]) + _folded("Versions", document["versions"])


def _folded(title: str, value: object) -> str:
    if not value:
        return ""
    text = json.dumps(value, indent=1, sort_keys=True, default=str)
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def _table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: Sequence[int] = (),
    names: Sequence[int] = (),
) -> str:
    def kind(i: int) -> str:
        return "n" if i in numbers else "name" if i in names else ""

    header = "".join(f'<th class="{kind(i)}">{escape(h)}</th>' for i, h in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f'<td class="{kind(i)}">{escape(cell)}</td>' for i, cell in enumerate(row)) + "</tr>"
        for row in rows
    )
    return f"<table>{f'<thead><tr>{header}</tr></thead>' if head else ''}<tbody>{body}</tbody></table>"


def _picture(png: bytes, words: str) -> str:
    return f'<img alt="{escape(words)}" src="data:image/png;base64,{base64.b64encode(png).decode("ascii")}">'


def _note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _pill(kind: str, text: str) -> str:
    return f'<span class="pill {kind}">{escape(text)}</span>'


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
