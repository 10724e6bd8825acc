"""All positions of a flight shifted by 50 km together: placed, and told where a scan or a map contradicts.

1. Every second photo becomes a map by its own positions; the others become one by a table of theirs that are
   50 km too far east. This ingest has to say so, and to keep that map in quarantine.
2. `featuredb anchor` of the second map on the scan of the place, and `featuredb grow` with the second half
   contributed to a database of the first: both have to say the distance, too.
"""

import re
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from featuredb.features.exif.read import ExifInfo, read_exif
from featuredb.geo.utm import geodetic_from_utm, utm_epsg, utm_from_geodetic
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute
from featuredb.store.candidates.states import Contribution
from tools.commands import featuredb
from tools.figures import study_parser, write_figures
from tools.photo_files import copied, photo_names, position_table

_SHIFT_M = 50_000.0


def main() -> None:
    args = study_parser(__doc__, "--photos", "--scan", "--work").parse_args()
    names = photo_names(args.photos)
    right = copied(args.photos, names[::2], args.work / "right", strip=False)
    shifted = copied(args.photos, names[1::2], args.work / "shifted", strip=False)
    database, grown = args.work / "db", args.work / "grown.db"
    for one in (database, grown):
        featuredb("ingest", "photos", str(one), str(right), "--quiet")
    table = position_table(shifted, (_table_row(shifted / name) for name in names[1::2]))
    ingest_km = told_km("ingest", "photos", str(database), str(table), "--trust-geotags", "--quiet")
    _, second = sorted(Database.open(database).snapshot().maps(), key=lambda m: m.created_at)
    featuredb("lidar", "add", str(database), str(args.scan))
    away = args.work / "anchor"
    words = ("anchor", str(database), second.map_id, "--photos", str(shifted), "--out", str(away), "--auto")
    anchor_km = told_km(*words, "--quiet")
    contribute(Database.open(grown), [contribution(shifted / name) for name in names[1::2]])
    figures = {
        "quarantined": int(second.status == "quarantined"),
        "photos": second.images,
        "ingest_km": ingest_km,
        "anchor_km": anchor_km,
        "grow_km": told_km("grow", str(grown)),
    }
    write_figures(args.json, figures)


def shifted_position(photo: Path) -> tuple[ExifInfo, float, float]:
    """What a photo says of itself, and its latitude and longitude 50 km further east."""
    exif = read_exif(photo.read_bytes())
    epsg = utm_epsg(exif.latitude_deg, exif.longitude_deg)
    utm = utm_from_geodetic((exif.latitude_deg, exif.longitude_deg, 0.0), epsg)
    latitude, longitude, _ = geodetic_from_utm(utm + np.array([_SHIFT_M, 0.0, 0.0]), epsg)
    return exif, float(latitude), float(longitude)


def _table_row(photo: Path) -> tuple[object, ...]:
    exif, latitude, longitude = shifted_position(photo)
    return photo.name, latitude, longitude, exif.altitude_m, exif.sigma_horizontal_m, exif.sigma_vertical_m


def contribution(photo: Path) -> Contribution:
    """The photo as a query contributed it, from its shifted position."""
    exif, latitude, longitude = shifted_position(photo)
    prior = {"lat": latitude, "lon": longitude, "h": exif.altitude_m, "sigma_m": exif.sigma_horizontal_m}
    return Contribution(
        image=photo.read_bytes(),
        width=exif.width,
        height=exif.height,
        credit="somebody",
        licence="CC-BY-4.0",
        client_id="shifted",
        received_at=datetime.now(UTC),
        request={"prior": prior},
    )


def told_km(*words: str) -> float | None:
    """The distance that a command of featuredb names, None where it names none."""
    done = featuredb(*words, refusals=range(1, 256))
    text = done.stdout + done.stderr
    found = [float(km) for km in re.findall(r"([0-9.]+) km to the", text)]
    found += [float(m.replace(",", "")) / 1000.0 for m in re.findall(r"([0-9,]+) m from where", text)]
    return found[0] if found else None


if __name__ == "__main__":
    main()
