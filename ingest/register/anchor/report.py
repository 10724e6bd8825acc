"""The report of an anchoring: anchor.json for programs, anchor.html for people, overlays as PNG files."""

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from featuredb.geometry.sim3 import point_jacobian
from featuredb.maps.feature_map import FeatureMap, MapImage
from featuredb.plain_json import plain
from featuredb.render.cloud import PointCloud
from ingest.html_parts import folded, note, page, picture, pill, table
from ingest.register.anchor.anchor_map import AnchorResult
from ingest.register.anchor.frames import TriedFrame, TriedFrames
from ingest.register.anchor.pictures import (
    FramePicture,
    flick_page,
    map_over_scan_png,
    overlay_rgb,
    png,
    residuals_png,
    scan_view,
)
from ingest.workspace import atomic_file, write_json

SCHEMA_ID = "featuredb/ingest/anchor/1"
REPORT_JSON, REPORT_HTML, FLICK_HTML = "anchor.json", "anchor.html", "frames.html"

PhotoRgb = Callable[[MapImage], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnchorReport:
    """All of an anchoring.

    Attributes:
        map_id, map_name: of the map. database: its address. photos: their folder. scan_ids: of the scans.
        epsg: of the map. datum_before, datum_after: of its heights; the scan's after.
        tried: ranking and registrations.
        result: of the placing, None where frames were only proposed.
        notes: for people.
    """

    map_id: str
    map_name: str
    database: str
    photos: str
    scan_ids: tuple[str, ...]
    epsg: int
    datum_before: str
    datum_after: str
    tried: TriedFrames
    result: AnchorResult | None
    notes: tuple[str, ...] = ()

    @property
    def placed(self) -> bool:
        return self.result is not None and self.result.feature_map is not None

    def times_s(self) -> dict[str, float]:
        """Seconds of the paper's building blocks, for one frame and for the map; wall time unless named CPU.

        On a busy machine the processor time tells what an idle one would take, or less with two cores.
        """
        tried = self.tried.tried
        times: dict[str, float] = {}
        if tried:
            times["(B) one frame, median"] = float(np.median([f.seconds for f in tried]))
            cpu = [f.cpu_s for f in tried if np.isfinite(f.cpu_s)]
            if cpu:
                times["(B) one frame, median, CPU"] = float(np.median(cpu))
        if self.result is not None and self.result.rounds:
            last = self.result.rounds[-1]
            times["(C) structure projection, all frames"] = last.structure_s
            times["(C) structure projection, all frames, CPU"] = last.structure_cpu_s
            times["adjustment of the map, all rounds"] = sum(r.adjust_s for r in self.result.rounds)
        return times


def frame_rows(report: AnchorReport) -> list[tuple[Any, ...]]:
    """One line per ranked or tried frame, for the terminal and the page, tried ones first."""
    used = report.result.used if report.result else ()
    tried = {frame.image.image_id: frame for frame in report.tried.tried}
    proposals = [frame.proposal for frame in report.tried.tried]
    proposals += [p for p in report.tried.ranking if p.image.image_id not in tried]
    rows = []
    for proposal in proposals:
        frame, score = tried.get(proposal.image.image_id), proposal.score
        verdict, inliers, sigma = "", None, None
        if frame is not None:
            registration = frame.registration
            verdict = registration.reason or f"registered by {registration.source}"
            if registration.covariance is not None:
                inliers = len(registration.pixels)
                sigma = round(float(np.sqrt(np.linalg.eigvalsh(registration.covariance[3:, 3:])[-1])), 3)
            if proposal.image.image_id in used:
                verdict += ", used"
        rows.append(
            (
                proposal.image.name,
                _rounded(score.score),
                _rounded(score.coverage),
                score.points,
                _rounded(score.texture),
                _rounded(score.sharpness),
                verdict,
                inliers,
                sigma,
                None if frame is None else round(frame.seconds, 1),
            )
        )
    return rows


FRAME_HEADER = (
    *("frame", "score", "covers", "points", "texture", "sharp", "registration"),
    *("inliers", "sigma m", "B s"),
)


def write_anchor_report(
    folder: Path, report: AnchorReport, old: FeatureMap, cloud: PointCloud, read_rgb: PhotoRgb, command: str
) -> tuple[Path | None, Path]:
    """Write report, pictures and the page to flick through; returns the paths of the page and of the report.

    Args:
        old: the map before. read_rgb: colours (h, w, 3) of a photo of the map.
        command: that confirms the proposed frames; the page shows it for each frame with its own name in the
            place of {image}.
    """
    folder.mkdir(parents=True, exist_ok=True)
    frames = _pictures(report, old, cloud, read_rgb, command)
    overlays: dict[str, bytes] = {}
    for frame in frames:
        overlays[frame.name] = png(overlay_rgb(frame.photo_rgb, frame.view))
        with atomic_file(folder / overlay_name(frame.name)) as temporary:
            temporary.write_bytes(overlays[frame.name])
    flick = folder / FLICK_HTML if frames else None
    if flick is not None:
        words = "Photos of the map with the edges of the scan, as the scan looks from each photo's pose."
        with atomic_file(flick) as temporary:
            temporary.write_text(flick_page(f"Frames of {report.map_name}", words, frames), encoding="utf-8")
    write_json(folder / REPORT_JSON, report_json(report))
    with atomic_file(folder / REPORT_HTML) as temporary:
        temporary.write_text(_page(report, old, cloud, overlays), encoding="utf-8")
    return flick, folder / REPORT_HTML


def overlay_name(image: str) -> str:
    """File name of an image's overlay."""
    return f"overlay-{Path(image).with_suffix('').as_posix().replace('/', '_')}.png"


def report_json(report: AnchorReport) -> dict[str, Any]:
    """Everything as JSON of `schemas/ingest/anchor.json`."""
    result = report.result
    placed: dict[str, Any] | None = None
    if result is not None:
        placed = {
            "reason": result.reason,
            "message": result.message,
            "used": list(result.used),
            "checks": result.checks,
            "seconds": result.seconds,
            "rounds": [
                {
                    "structure_s": r.structure_s,
                    "structure_cpu_s": r.structure_cpu_s,
                    "adjust_s": r.adjust_s,
                    "focal_px": list(r.focal_px),
                    "figures": r.figures,
                }
                for r in result.rounds
            ],
        }
    shift = report.tried.shift
    document: dict[str, Any] = plain(
        {
            "schema": SCHEMA_ID,
            "map_id": report.map_id,
            "map_name": report.map_name,
            "database": report.database,
            "photos": report.photos,
            "scans": list(report.scan_ids),
            "epsg": report.epsg,
            "height_datum": {"before": report.datum_before, "after": report.datum_after},
            "height_shift": None
            if shift is None
            else {"shift_m": shift.shift_m, "sigma_m": shift.sigma_m, "points": shift.points},
            "times_s": report.times_s(),
            "frames": [_frame_json(frame) for frame in report.tried.tried],
            "ranking": [{"name": p.image.name, **p.score.as_figures()} for p in report.tried.ranking],
            "placement": placed,
            "notes": list(report.notes),
        }
    )
    return document


def _frame_json(frame: TriedFrame) -> dict[str, Any]:
    registration = frame.registration
    pose = registration.cam_from_local
    return {
        "name": frame.image.name,
        "reason": registration.reason,
        "message": registration.message,
        "source": registration.source,
        "inliers": len(registration.pixels),
        "cam_from_local": None if pose is None else pose.matrix(),
        "covariance": registration.covariance,
        "evidence": registration.evidence,
        "seconds": frame.seconds,
        "cpu_s": frame.cpu_s,
        "stages_s": registration.seconds,
    }


def _pictures(
    report: AnchorReport, old: FeatureMap, cloud: PointCloud, read_rgb: PhotoRgb, command: str
) -> list[FramePicture]:
    """The tried frames; refused ones as the scan looks from where their registration started."""
    new = report.result.feature_map if report.result else None
    last = report.result.rounds[-1].frames if report.result and report.result.rounds else ()
    again = {frame.image.image_id: frame for frame in last}
    frames = []
    for frame in report.tried.tried:
        registration = again.get(frame.image.image_id, frame).registration
        camera = (new or old).cameras[frame.image.camera_id]
        pose = registration.cam_from_local
        details: tuple[str, ...]
        if pose is None:
            headline = f"{registration.reason}: {registration.message}. Shown from where its search started."
            verdict, pose, details, line = "bad", frame.proposal.prior.cam_from_local, (), ""
            camera = old.cameras[frame.image.camera_id]
        else:
            headline = f"registered by {registration.source} with {len(registration.pixels)} correspondences"
            verdict, details = "good", (_evidence_line(registration.evidence),)
            line = command.replace("{image}", shlex.quote(frame.image.name)) if report.result is None else ""
        frames.append(
            FramePicture(
                name=frame.image.name,
                photo_rgb=read_rgb(frame.image),
                view=scan_view(cloud, camera, pose),
                verdict=verdict,
                headline=headline,
                details=details,
                command=line,
            )
        )
    return frames


def _evidence_line(evidence: Mapping[str, Any]) -> str:
    pictures = {f"confirmation {k}": v for k, v in evidence.get("confirmation", {}).items()}
    shown = {
        k: v
        for k, v in {**evidence, **pictures}.items()
        if isinstance(v, (int, float, str)) and not isinstance(v, bool)
    }
    return ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items())


def _page(report: AnchorReport, old: FeatureMap, cloud: PointCloud, overlays: Mapping[str, bytes]) -> str:
    title = f"Anchoring of {report.map_name}"
    result = report.result
    if result is None:
        state = pill("fair", "proposed, nothing is changed")
    elif report.placed:
        state = pill("good", "placed")
    else:
        state = pill("bad", "not placed")
    parts = [
        f"<h1>{escape(title)} {state}</h1>",
        f'<p class="soft">map <code>{escape(report.map_id)}</code> of '
        f"<code>{escape(report.database)}</code>, "
        f"scans <code>{escape(', '.join(report.scan_ids))}</code></p>",
    ]
    if result is not None and result.reason:
        parts.append(f'<p class="note stop"><b>{escape(result.reason)}</b>: {escape(result.message)}</p>')
    parts += [note(text) for text in report.notes]
    if result is not None and result.feature_map is not None:
        parts.append(_placed_section(report, result, old, cloud))
    times = [(name, f"{seconds:.2f} s") for name, seconds in report.times_s().items()]
    parts.append("<h2>Time</h2><section>" + table((), times, numbers=(1,), names=(0,)) + "</section>")
    rows = [["" if v is None else str(v) for v in row] for row in frame_rows(report)]
    parts.append(
        "<h2>Frames</h2><section class='wide'>"
        + table(FRAME_HEADER, rows, numbers=(1, 2, 3, 4, 5, 7, 8, 9), names=(0,))
        + "</section>"
    )
    for name, overlay in overlays.items():
        parts.append(f"<h3>{escape(name)}</h3>" + picture(overlay, f"edges of the scan over {name}"))
    parts.append(folded("Everything", report_json(report)))
    return page(title, parts)


def _placed_section(report: AnchorReport, result: AnchorResult, old: FeatureMap, cloud: PointCloud) -> str:
    new = result.feature_map
    assert new is not None
    assert result.before is not None
    assert result.after is not None
    move = result.checks["move"]
    facts = [
        ("heights", f"{report.datum_before} before, {report.datum_after} after"),
        (
            "map points to scan",
            f"median {result.before.median_m:.2f} m before, {result.after.median_m:.3f} m after",
        ),
        ("moved", f"{move['horizontal_m']:.2f} m in plan, {move['up_m']:+.2f} m up"),
        ("turned", f"{move['heading_deg']:+.2f} degrees about the vertical, {move['tilt_deg']:.2f} tilted"),
        ("scale", f"{move['scale']:.5f}"),
        ("placement, 1 sigma", _sigmas(new)),
        *(
            (f"focal length of camera {k}", f"{before.focal_px:.1f} px before, {after.focal_px:.1f} px after")
            for k, (before, after) in enumerate(zip(old.cameras, new.cameras, strict=True))
        ),
    ]
    centers = np.array([image.cam_from_local.center for image in new.images])
    local = cloud.frame.enu_from(new.frame)
    pictures = picture(
        map_over_scan_png(
            cloud, old.points_local(cloud.frame), new.points_local(cloud.frame), local.act(centers)
        ),
        "Map points over the scan, before and after",
    ) + picture(
        residuals_png(result.before.distance_m, result.after.distance_m),
        "Distances of map points to the scan, before and after",
    )
    return f"<h2>The map</h2><section>{table((), facts, names=(0,))}{pictures}</section>"


def _sigmas(feature_map: FeatureMap) -> str:
    middle = np.median(feature_map.points_local(), axis=0)
    jacobian = point_jacobian(middle)
    spread = np.sqrt(np.diag(jacobian @ feature_map.placement.covariance @ jacobian.T))
    turn = np.degrees(np.sqrt(np.diag(feature_map.placement.covariance)[1:4]).max())
    return f"east {spread[0]:.3f}, north {spread[1]:.3f}, up {spread[2]:.3f} m, {turn:.3f} degrees"


def _rounded(value: float) -> float | None:
    return round(value, 3) if np.isfinite(value) else None
