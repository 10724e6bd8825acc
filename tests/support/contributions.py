"""Contributed photos and known poses for tests of the store."""

import hashlib
from datetime import UTC, datetime, timedelta

import numpy as np

from featuredb.store.canaries import KnownPose
from featuredb.store.candidates.photos import list_candidates, load_images
from featuredb.store.candidates.states import Candidate, Contribution
from featuredb.store.database import Database
from tests.support.maps import EASTING, EPSG, HEIGHT, NORTHING

NOON = datetime(2026, 5, 1, 12, tzinfo=UTC)


def contribution(
    seed: int = 0, owner: str = "ada", *, credit: str = "A. Person", minute: int = 0
) -> Contribution:
    """A few hundred bytes that are no picture (the store does not look), different for each seed."""
    return Contribution(
        image=hashlib.sha512(f"photo {seed}".encode()).digest() * 8,
        width=640,
        height=480,
        owner=owner,
        credit=credit,
        licence="CC-BY-4.0",
        client_id="phone 7",
        received_at=NOON + timedelta(minutes=minute),
        request={"prior": {"lat": 49.0, "lon": 8.4, "sigma_m": 20.0}, "exif": {"make": "Maker"}},
        answer={"status": "localised", "utm": {"easting": EASTING, "northing": NORTHING}},
        snapshot=3,
    )


def known_pose(tolerance_m: float = 0.3) -> KnownPose:
    """Looking down at the middle of the maps of tests/support/maps.py."""
    return KnownPose(
        epsg=EPSG,
        utm=np.array([EASTING + 1 / 3, NORTHING, HEIGHT + 40.0]),
        height_datum="unknown",
        cam_from_utm_xyzw=np.array([1.0, 0.0, 0.0, 0.0]),
        tolerance_m=tolerance_m,
        tolerance_deg=0.5,
    )


def find_candidate(database: Database, candidate_id: str) -> Candidate:
    """One contributed photo."""
    (found,) = [c for c in list_candidates(database) if c.candidate_id == candidate_id]
    return found


def load_image(database: Database, candidate_id: str) -> bytes:
    """The bytes of one contributed photo."""
    ((_, image),) = load_images(database, [candidate_id])
    return image
