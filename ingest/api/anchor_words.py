"""What an anchoring did, in words."""

import shlex

from featuredb.cli.common import format_table
from ingest.anchoring import Anchoring
from ingest.register.anchor.report import FRAME_HEADER, frame_rows
from ingest.register.structure.surface_fit import median_m


def anchoring_text(done: Anchoring, database: str) -> str:
    """What happened, for the terminal; the report has the rest."""
    report, result = done.report, done.report.result
    lines = list(report.notes)
    rows = frame_rows(report)
    if rows:
        lines.append(format_table(FRAME_HEADER, rows).rstrip())
    lines.extend(f"{name}: {seconds:.2f} s" for name, seconds in report.times_s().items())
    if done.placed and result is not None and "outlines" in result.checks:
        where = shlex.quote(database)
        lines.append(
            f"map {report.map_id} is placed by the outlines of its scan: version {done.version}. It answers "
            "once somebody has looked at it:"
        )
        lines.append(f"  featuredb promote {where} {report.map_id} --reason 'looked at it'")
        lines.append(f"without a place: featuredb rollback {where} {done.version_before}")
    elif done.placed and result is not None and result.before is not None and result.after is not None:
        move = result.checks["move"]
        lines.append(
            f"map {report.map_id} is placed by its scan: version {done.version}; moved "
            f"{move['horizontal_m']:.2f} m in plan and {move['up_m']:+.2f} m up; its points lie "
            f"{median_m(result.after):.3f} m (median) from the scan, {median_m(result.before):.2f} m before"
        )
        lines.extend(f"quarantined, since this map had placed it: {map_id}" for map_id in done.flagged)
        lines.append(f"the old placement: featuredb rollback {shlex.quote(database)} {done.version_before}")
    elif result is not None:
        lines.append(f"not placed: {result.reason}: {result.message}")
    elif done.proposed:
        lines.append(f"look at {done.page}; if the edges of the scan lie on the photos, place the map:")
        lines.append(f"  {done.command}")
    else:
        lines.append(_nothing(done))
    lines.append(f"report: {done.page}")
    return "\n".join(lines) + "\n"


def _nothing(done: Anchoring) -> str:
    tried = done.report.tried.tried
    if not tried:
        return (
            "nothing proposed: no frame of the map sees enough of the scan from where the map is placed now"
        )
    reasons = "; ".join(f"{f.image.name}: {f.registration.reason}: {f.registration.message}" for f in tried)
    return f"nothing proposed: no frame was registered: {reasons}"
