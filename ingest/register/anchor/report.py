"""What an anchoring did: one value, its JSON for programs (anchor.json), and its lines for people."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from featuredb.plain_json import plain
from ingest.register.anchor.anchor_map import AnchorResult
from ingest.register.anchor.frames import TriedFrame, TriedFrames

SCHEMA_ID = "featuredb/ingest/anchor/1"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnchorReport:
    """All of an anchoring.

    Attributes:
        database: its address. photos: their folder.
        datum_before, datum_after: of the map's heights; the scan's after.
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
        frame = tried.get(proposal.image.image_id)
        verdict, inliers, sigma, seconds = "", None, None, None
        if frame is not None:
            registration, seconds = frame.registration, round(frame.seconds, 1)
            verdict = registration.reason or f"registered by {registration.source}"
            if registration.covariance is not None:
                inliers = len(registration.pixels)
                sigma = round(float(np.sqrt(np.linalg.eigvalsh(registration.covariance[3:, 3:])[-1])), 3)
            if proposal.image.image_id in used:
                verdict += ", used"
        figures = (_rounded(proposal.score), _rounded(proposal.coverage), proposal.points)
        rows.append((proposal.image.name, *figures, verdict, inliers, sigma, seconds))
    return rows


FRAME_HEADER = ("frame", "score", "covers", "points", "registration", "inliers", "sigma m", "B s")


def report_json(report: AnchorReport) -> dict[str, Any]:
    """Everything as JSON of `schemas/ingest/anchor.json`."""
    result, shift = report.result, report.tried.shift
    of_round = ("structure_s", "structure_cpu_s", "adjust_s", "focal_px", "figures")
    of_rank = ("score", "coverage", "downward", "points", "spread")
    placed = result and {
        **_named(result, "reason", "message", "used", "checks", "seconds"),
        "rounds": [_named(r, *of_round) for r in result.rounds],
    }
    document: dict[str, Any] = plain(
        {
            "schema": SCHEMA_ID,
            **_named(report, "map_id", "map_name", "database", "photos", "epsg", "notes"),
            "scans": report.scan_ids,
            "height_datum": {"before": report.datum_before, "after": report.datum_after},
            "height_shift": shift and asdict(shift),
            "times_s": report.times_s(),
            "frames": [_frame_json(frame) for frame in report.tried.tried],
            "ranking": [{"name": p.image.name, **_named(p, *of_rank)} for p in report.tried.ranking],
            "placement": placed,
        }
    )
    return document


def _frame_json(frame: TriedFrame) -> dict[str, Any]:
    registration = frame.registration
    pose = registration.cam_from_local
    return {
        "name": frame.image.name,
        **_named(registration, "reason", "message", "source", "covariance", "evidence"),
        "inliers": len(registration.pixels),
        "cam_from_local": None if pose is None else pose.matrix(),
        **_named(frame, "seconds", "cpu_s"),
        "stages_s": registration.seconds,
    }


def _named(value: object, *names: str) -> dict[str, Any]:
    """Some attributes of a value."""
    return {name: getattr(value, name) for name in names}


def _rounded(value: float) -> float | None:
    return round(value, 3) if np.isfinite(value) else None
