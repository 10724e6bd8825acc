"""A film tracked by a database: the poses, files of them, and a summary."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from featuredb.atomic import check_output
from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.maps.feature_map import GeoPrior
from featuredb.plain_json import plain
from featuredb.store import Database
from ingest.track.finders import FilmGround, finder_for
from reloc.localise.result import LocaliseRequest
from reloc.tracking.map_ground import MapFinder
from reloc.tracking.track_video import TrackedVideo, TrackVideoOptions, track_video
from reloc.tracking.trajectory.files import Outputs, check_outputs, format_of, write_outputs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackedFilm:
    """The frames of a film with their poses, and the files that were written."""

    video: TrackedVideo
    outputs: Outputs
    overlay: Path | None

    def summary(self) -> dict[str, Any]:
        """Figures, JSON-able."""
        found = self.video
        points = found.trajectory.points
        states = {
            state: sum(p.state == state for p in points) for state in ("tracking", "relocalised", "lost")
        }
        lost = [p for p in points if p.state == "lost"]
        return {
            "video": found.trajectory.source,
            "frames": len(points),
            **states,
            "stretches": [list(times) for times in found.trajectory.times_found()],
            "frame": "own" if found.trajectory.is_in_map else "earth",
            "last_reason": lost[-1].detail if lost else "",
            "frames_per_s": round(len(points) / max(found.seconds["total"], 1e-9), 1),
            "seconds": {name: round(seconds, 3) for name, seconds in found.seconds.items()},
            "camera": None if found.camera is None else plain(asdict(found.camera)),
            "complaints": list(found.complaints),
            "written": [*self.outputs.written, *([] if self.overlay is None else [str(self.overlay)])],
        }

    def as_text(self) -> str:
        """For the terminal."""
        summary = self.summary()
        lines = [
            f"{summary['video']}: {summary['frames']} frames, {summary['tracking']} tracked, "
            f"{summary['relocalised']} relocalised, {summary['lost']} lost"
        ]
        lines += [f"  from {a:.2f} s to {b:.2f} s" for a, b in summary["stretches"]]
        if summary["last_reason"]:
            lines.append(f"  lost at the end or before: {summary['last_reason']}")
        seconds = summary["seconds"]
        lines.append(
            f"  {summary['frames_per_s']} frames a second: {seconds['tracking']:.1f} s tracking, "
            f"{seconds['drawing']:.1f} s drawing, {seconds['waiting']:.1f} s waiting for frames"
        )
        if summary["frame"] == "own":
            lines.append("  poses are in the map's own frame, and say nothing of where on Earth that is")
        lines += [f"  the film: {what}" for what in summary["complaints"]]
        lines += [f"  wrote {file}" for file in summary["written"]]
        return "\n".join(lines) + "\n"


def track_film(
    database: Database,
    film: str | Path,
    *,
    out: Sequence[Path] = (),
    overlay: Path | None = None,
    ground: FilmGround | None = None,
    camera: Camera | None = None,
    prior: GeoPrior | None = None,
    options: TrackVideoOptions | None = None,
) -> TrackedFilm:
    """The pose of every frame of a film, or that it is lost.

    Args:
        film: a file, a folder of pictures, or an address. out: trajectories to write, by their suffix.
        ground: by what it is followed. camera: intrinsics of the upright frames. prior: where it begins.

    Raises:
        InvalidValueError, VideoError, StoreError, RegistrationError, ScanNotFoundError
    """
    ground = ground or FilmGround()
    check_outputs(out, film, ground.pose_file)
    if overlay is not None:
        check_output("--overlay", overlay, film, ground.pose_file)
    options = options or TrackVideoOptions()
    finder = finder_for(database, ground, camera, options.track)
    if isinstance(finder, MapFinder) and finder.own_map is not None:
        for file in out:
            format_of(file, finder.own_map)
        if prior is not None:
            raise InvalidValueError(
                f"--prior is a place on Earth, and map {finder.own_map} has none; leave it out"
            )
    found = track_video(
        str(film),
        finder,
        camera=camera,
        request=LocaliseRequest(prior=prior),
        overlay=overlay,
        options=options,
    )
    outputs = write_outputs(out, found.trajectory)
    if found.undrawn:
        outputs, overlay = replace(outputs, failed=(found.undrawn, *outputs.failed)), None
    return TrackedFilm(video=found, outputs=outputs, overlay=overlay)
