"""A film becomes a map, and is followed by it: against its own telemetry, or without positions by itself.

    python -m tools.film_tracked FILM.mp4 --work FOLDER [--no-telemetry]

`featuredb ingest video`, then `featuredb track` by the largest map. With telemetry the map has a place, and
the track is compared with the telemetry. The receiver's own noise is part of these distances; the radius is
that of the track: of the horizontal ellipse that holds 95 %, at the median frame.

Without telemetry the map has no place. At the keyframes the track is compared with the poses that the map
itself has of them: the distance of the centres over the median distance from the map's cameras to their
points, and the angle.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from featuredb.geo.utm import utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.rotation import matrix_from_quaternion, rotation_angle
from featuredb.maps.unplaced_map import UnplacedMap
from featuredb.store import Database
from featuredb.video.telemetry.read import telemetry_of_video
from tools.commands import featuredb
from tools.figures import study_parser, write_figures

_WITHIN = float(chi2.ppf(0.95, 2))


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("film", type=Path)
    parser.add_argument("--no-telemetry", action="store_true", help="as if the film had none")
    args = parser.parse_args()
    write_figures(args.json, (film_in_map if args.no_telemetry else film_placed)(args.film, args.work))


def film_placed(film: Path, work: Path) -> dict[str, float]:
    """Ingest and track a film in a folder: keyframes in the map, frames with a pose, those compared, and the
    horizontal distances."""
    database = work / "db"
    featuredb("ingest", "video", str(database), str(film), "--quiet")
    (placed,) = Database.open(database).snapshot().maps()
    rows = [row for row in _tracked(database, placed.map_id, film, work) if row["easting"]]
    off, covariances = _off_telemetry(film, rows)
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off)
    metres = np.linalg.norm(off, axis=1)
    radii = np.sqrt(_WITHIN * np.linalg.eigvalsh(covariances)[:, -1])
    return {
        "keyframes": _keyframes(database),
        "mapped": placed.images,
        "active": int(placed.status == "active"),
        "tracked": len(rows),
        "compared": len(off),
        "radius_m": float(np.median(radii)),
        "rms_m": float(np.sqrt((metres**2).mean())),
        "largest_m": float(metres.max()),
        "inside": float((squares <= _WITHIN).mean()),
    }


def film_in_map(film: Path, work: Path) -> dict[str, float]:
    """Ingest and track a film in a folder: keyframes and frames that are in the map, and against the map's
    own cameras at keyframes the medians of distance, relative, and angle."""
    database = work / "db"
    featuredb("ingest", "video", str(database), str(film), "--no-telemetry", "--quiet", refusals=(1,))
    snapshot = Database.open(database).snapshot()
    largest = max(snapshot.unplaced_maps(), key=lambda m: m.images).map_id
    rows = _tracked(database, largest, film, work)
    unplaced = snapshot.load_unplaced(largest)
    found = {int(row["frame"]): row for row in rows if row["own_x"]}
    center_rel, angle_deg = _against_keyframes(unplaced, found)
    keyframes = _keyframes(database)
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


def _tracked(database: Path, map_id: str, film: Path, work: Path) -> list[dict[str, str]]:
    """The rows of a film's track by a map."""
    track = work / "track.csv"
    featuredb("track", str(database), str(film), "--map", map_id, "--out", str(track), refusals=(1,))
    with track.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def _keyframes(database: Path) -> int:
    """Of the films that an ingest into a database has kept."""
    return len(list((database / "_work" / "films").rglob("*.jpg")))


def _off_telemetry(film: Path, rows: Sequence[dict[str, str]]) -> tuple[FloatArray, FloatArray]:
    """East and north from telemetry to track (n, 2) where it has a position, and the track's covariances."""
    telemetry = telemetry_of_video(film)
    at = telemetry.at([float(row["time_s"]) for row in rows])
    known = at.has_position
    there = np.column_stack([at.latitude_deg, at.longitude_deg, np.zeros(len(rows))])[known]
    told = utm_from_geodetic(there, int(rows[0]["epsg"]))[:, :2]
    found = np.array([[float(row[axis]) for axis in ("easting", "northing")] for row in rows])[known]
    spread = np.array([[[row["cov_e_e"], row["cov_e_n"]], [row["cov_e_n"], row["cov_n_n"]]] for row in rows])
    return found - told, spread.astype(np.float64)[known]


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
    main()
