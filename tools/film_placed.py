"""A film with telemetry becomes a map with a place; its track is compared with the telemetry itself.

    python -m tools.film_placed FILM.mp4 --work FOLDER

`featuredb ingest video`, then `featuredb track` by the map. The receiver's own noise is part of the
distances between track and telemetry, the radius is that of the track: of the horizontal ellipse that holds
95 %, at the median frame.
"""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from featuredb.geo.utm import utm_from_geodetic
from featuredb.geometry.arrays import FloatArray
from featuredb.store import Database
from featuredb.video.telemetry import telemetry_of_video
from tools.commands import featuredb
from tools.figures import study_parser, write_figures

_WITHIN = float(chi2.ppf(0.95, 2))


def main() -> None:
    parser = study_parser(__doc__, "--work")
    parser.add_argument("film", type=Path)
    args = parser.parse_args()
    write_figures(args.json, film_placed(args.film, args.work))


def film_placed(film: Path, work: Path) -> dict[str, float]:
    """Ingest and track a film in a folder: keyframes in the map, frames with a pose, those compared, and the
    horizontal distances."""
    database = work / "db"
    featuredb("ingest", "video", str(database), str(film), "--quiet")
    (placed,) = Database.open(database).snapshot().maps()
    rows = [row for row in tracked_by(database, placed.map_id, film, work) if row["easting"]]
    off, covariances = _off_telemetry(film, rows)
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances), off)
    metres = np.linalg.norm(off, axis=1)
    radii = np.sqrt(_WITHIN * np.linalg.eigvalsh(covariances)[:, -1])
    return {
        "keyframes": keyframe_count(database),
        "mapped": placed.images,
        "active": int(placed.status == "active"),
        "tracked": len(rows),
        "compared": len(off),
        "radius_m": float(np.median(radii)),
        "rms_m": float(np.sqrt((metres**2).mean())),
        "largest_m": float(metres.max()),
        "inside": float((squares <= _WITHIN).mean()),
    }


def tracked_by(database: Path, map_id: str, film: Path, work: Path) -> list[dict[str, str]]:
    """The rows of a film's track by a map."""
    track = work / "track.csv"
    featuredb("track", str(database), str(film), "--map", map_id, "--out", str(track), may_refuse=True)
    with track.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def keyframe_count(database: Path) -> int:
    """Of the films that an ingest into a database has kept."""
    return len(list((database / "_work" / "films").rglob("*.jpg")))


def _off_telemetry(film: Path, rows: Sequence[dict[str, str]]) -> tuple[FloatArray, FloatArray]:
    """East and north from telemetry to track (n, 2) where it has a position, and the track's covariances."""
    telemetry = telemetry_of_video(film)
    assert telemetry is not None
    at = telemetry.at([float(row["time_s"]) for row in rows])
    known = at.has_position
    there = np.column_stack([at.latitude_deg, at.longitude_deg, np.zeros(len(rows))])[known]
    told = utm_from_geodetic(there, int(rows[0]["epsg"]))[:, :2]
    found = np.array([[float(row[axis]) for axis in ("easting", "northing")] for row in rows])[known]
    spread = np.array([[[row["cov_e_e"], row["cov_e_n"]], [row["cov_e_n"], row["cov_n_n"]]] for row in rows])
    return found - told, spread.astype(np.float64)[known]


if __name__ == "__main__":
    main()
