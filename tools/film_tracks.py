"""How right the tracks of films are, and whether their errors lie inside the bounds that they state."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from reloc.tracking.trajectory.values import Trajectory
from tools.film_folder import FrameTruth
from tools.track_evaluation import axis_errors

_LEVEL = 0.95
_AXES = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JudgedTrack:
    """The track of a film against the truth.

    Attributes:
        film: name of its file. frames: that show the place. foreign: poses of frames that do not.
        metres, degrees: (k,) errors of the place's frames that have a pose.
        normalised: (k,) squared errors of all six axes by their covariance.
    """

    film: str
    frames: int
    foreign: int
    metres: FloatArray
    degrees: FloatArray
    normalised: FloatArray

    @property
    def inside(self) -> int:
        """Frames whose pose lies inside the region that its covariance gives 95 %."""
        return int((self.normalised <= chi2.ppf(_LEVEL, _AXES)).sum())


def judge_track(
    film: str, trajectory: Trajectory, truth: Sequence[FrameTruth], frame: LocalFrame
) -> JudgedTrack:
    """Compare each frame that has a pose with the truth."""
    poses = [one.pose for one in truth]
    off = axis_errors(trajectory, frame, poses)
    rows = np.flatnonzero(np.isfinite(off).all(axis=1))
    normalised = []
    for row in rows:
        pose = trajectory.points[row].pose
        assert pose is not None  # it has errors
        normalised.append(float(off[row] @ np.linalg.solve(pose.covariance, off[row])))
    tracked = sum(point.pose is not None for point in trajectory.points)
    return JudgedTrack(
        film=film,
        frames=sum(pose is not None for pose in poses),
        foreign=tracked - len(rows),
        metres=np.linalg.norm(off[rows, 3:], axis=1),
        degrees=np.degrees(np.linalg.norm(off[rows, :3], axis=1)),
        normalised=np.array(normalised),
    )


def track_figures(tracks: Iterable[JudgedTrack]) -> dict[str, float]:
    """Figures over all films."""
    films = list(tracks)
    nothing = np.array([np.nan])
    metres, degrees, normalised = (
        np.concatenate([getattr(track, name) for track in films] or [nothing])
        for name in ("metres", "degrees", "normalised")
    )
    frames = sum(track.frames for track in films)
    known = len(metres) > 0
    return {
        "place_frames": frames,
        "tracked": len(metres),
        "tracked_share": len(metres) / max(frames, 1),
        "inside": sum(track.inside for track in films),
        "inside_share": sum(track.inside for track in films) / max(frames, 1),
        "foreign_tracked": sum(track.foreign for track in films),
        "median_m": float(np.median(metres)) if known else np.nan,
        "p95_m": float(np.quantile(metres, 0.95)) if known else np.nan,
        "largest_m": float(metres.max()) if known else np.nan,
        "median_deg": float(np.median(degrees)) if known else np.nan,
        "largest_deg": float(degrees.max()) if known else np.nan,
        "normalised_median": float(np.median(normalised) / _AXES) if known else np.nan,
        "normalised_p95": float(np.quantile(normalised, 0.95) / _AXES) if known else np.nan,
    }
