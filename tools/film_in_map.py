"""A film without positions becomes a map, and the same film is followed in that map's own frame.

    python -m tools.film_in_map FILM.mp4 --work FOLDER

Ingests the film without its telemetry, tracks it by the largest map, which has no place, and compares the
track at the keyframes with the poses that the map itself has of them: the distance of the centres over the
median distance from the map's cameras to their points, and the angle. Exit code 0 if a frame was followed.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from featuredb.geometry.rotation import matrix_from_quaternion, rotation_angle
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from tools.commands import featuredb
from tools.figures import study_parser, write_figures
from tools.film_placed import keyframe_count, tracked_by


def main(argv: Sequence[str] | None = None) -> int:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("film", type=Path)
    args = parser.parse_args(argv)
    figures = film_in_map(args.film, args.work)
    write_figures(args.json, figures)
    return 0 if figures["tracked"] else 1


def film_in_map(film: Path, work: Path) -> dict[str, float]:
    """Ingest and track a film in a folder: keyframes and frames that are in the map, and against the map's
    own cameras at keyframes the medians of distance, relative, and angle."""
    database = work / "db"
    featuredb("ingest", "video", str(database), str(film), "--no-telemetry", "--quiet", may_refuse=True)
    snapshot = Database.open(database).snapshot()
    largest = max(snapshot.unplaced_maps(), key=lambda m: m.images).map_id
    rows = tracked_by(database, largest, film, work)
    unplaced = snapshot.load_unplaced(largest)
    assert isinstance(unplaced, UnplacedMap)
    found = {int(row["frame"]): row for row in rows if row["own_x"]}
    center_rel, angle_deg = _against_keyframes(unplaced, found)
    keyframes = keyframe_count(database)
    return {
        "keyframes": keyframes,
        "mapped": len(unplaced.images),
        "mapped_share": len(unplaced.images) / keyframes,
        "frames": len(rows),
        "tracked": len(found),
        "tracked_share": len(found) / len(rows),
        "center_rel": center_rel,
        "angle_deg": angle_deg,
    }


def _against_keyframes(unplaced: UnplacedMap, found: dict[int, dict[str, str]]) -> tuple[float, float]:
    """Medians of centres' distances, relative, and of angles."""
    away, turned, far = [], [], []
    for image in unplaced.images:
        own = image.cam_from_local
        far.append(float(np.median(np.linalg.norm(unplaced.points.xyz - own.center, axis=1))))
        row = found.get(int(Path(image.name).stem))
        if row is None:
            continue
        center = np.array([float(row[f"own_{a}"]) for a in "xyz"])
        rotation = matrix_from_quaternion(np.array([float(row[f"own_q{a}"]) for a in "xyzw"]))
        away.append(float(np.linalg.norm(center - own.center)))
        turned.append(float(np.degrees(rotation_angle(rotation @ own.rotation.T))))
    return float(np.median(away) / np.median(far)), float(np.median(turned))


if __name__ == "__main__":
    sys.exit(main())
