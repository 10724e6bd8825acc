"""A film becomes a map, and is followed by it: against its own telemetry, or without positions by itself.

`featuredb ingest video`, then the film is tracked by the largest map as `featuredb track` does. With
telemetry the map has a place, and the track is compared with that. The receiver's own noise is part of these
distances; the radius is that of the track: of the horizontal ellipse that holds 95 %, at the median frame.

Without telemetry the map has no place. At the keyframes the track is compared with the poses that the map
itself has of them: the distance of the centres over the median distance from the map's cameras to their
points, and the angle.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from featuredb.geo.utm import utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from featuredb.video.telemetry.read import telemetry_of_video
from ingest.track.finders import FilmGround, finder_for
from reloc.tracking.options import TrackOptions
from reloc.tracking.track_video import track_video
from reloc.tracking.trajectory.values import TrajectoryPoint
from tools.commands import featuredb, largest_map
from tools.figures import study_parser, write_figures

_WITHIN = float(chi2.ppf(0.95, 2))


def main() -> None:
    parser = study_parser(__doc__, "film", "--work")
    parser.add_argument("--no-telemetry", action="store_true", help="as if the film had none")
    args = parser.parse_args()
    database, more = args.work / "db", ["--no-telemetry"] if args.no_telemetry else []
    featuredb("ingest", "video", str(database), str(args.film), "--quiet", *more, refusals=(1,))
    made = largest_map(database)
    finder = finder_for(Database.open(database), FilmGround(maps=(made.map_id,)), None, TrackOptions())
    points = track_video(args.film, finder).trajectory.points
    keyframes = len(list((database / "_work" / "films").rglob("*.jpg")))
    tracked = sum(point.found for point in points)
    against = against_keyframes(made, points) if args.no_telemetry else against_telemetry(args.film, points)
    figures = {
        "keyframes": keyframes,
        "mapped": len(made.images),
        "mapped_share": len(made.images) / keyframes,
        "active": int(not args.no_telemetry and made.status == "active"),
        "frames": len(points),
        "tracked": tracked,
        "tracked_share": tracked / len(points),
    }
    write_figures(args.json, figures | against)


def against_telemetry(film: Path, points: Sequence[TrajectoryPoint]) -> dict[str, float]:
    """Frames that have a position in the telemetry, too, and the horizontal distances."""
    found = [point for point in points if point.pose is not None]
    at = telemetry_of_video(film).at([point.time_s for point in found])
    known = at.has_position
    there = np.column_stack([at.latitude_deg, at.longitude_deg, np.zeros(len(found))])[known]
    told = utm_from_geodetic(there, found[0].pose.epsg)[:, :2]
    off: FloatArray = np.array([point.pose.utm[:2] for point in found])[known] - told
    covariances = np.array([point.pose.covariance[3:5, 3:5] for point in found])[known]
    metres = np.linalg.norm(off, axis=1)
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off)
    radii = np.sqrt(_WITHIN * np.linalg.eigvalsh(covariances)[:, -1])
    return {
        "compared": len(off),
        "radius_m": float(np.median(radii)),
        "rms_m": float(np.sqrt((metres**2).mean())),
        "largest_m": float(metres.max()),
        "inside": float((squares <= _WITHIN).mean()),
    }


def against_keyframes(unplaced: UnplacedMap, points: Sequence[TrajectoryPoint]) -> dict[str, float]:
    """Medians of centres' distances, relative, and of angles, against the map's own cameras."""
    away, turned, far = [], [], []
    for image in unplaced.images:
        own, found = image.cam_from_local, points[int(Path(image.name).stem)].in_map
        far.append(float(np.median(np.linalg.norm(unplaced.points.xyz - own.center, axis=1))))
        if found is not None:
            away.append(float(np.linalg.norm(found.cam_from_map.center - own.center)))
            turned.append(found.cam_from_map.angle_to_deg(own))
    return {"center_rel": float(np.median(away) / np.median(far)), "angle_deg": float(np.median(turned))}


if __name__ == "__main__":
    main()
