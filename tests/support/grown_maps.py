"""Databases that growth works on: copied, asked, told apart."""

import shutil
from pathlib import Path

import numpy as np

from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.store import Database
from featuredb.store.candidates.photos import list_candidates
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from tests.support.hill_photos import CAMERA, FRAME
from tests.support.hill_walk import (
    Shot,
)


def copied(folder: Path, to: Path) -> Database:
    shutil.copytree(folder, to / "db", dirs_exist_ok=True)
    return Database.open(to / "db")


def states(database: Database) -> dict[str, str]:
    return {c.candidate_id: c.state for c in list_candidates(database)}


def ask(database: Database, shot: Shot) -> float | None:
    """Error in metres of the answer to a photo, None without one."""
    result = Localiser.open(database).localise(
        decode_gray(shot.data, INGEST_LIMITS), LocaliseRequest(camera=CAMERA)
    )
    if result.pose is None:
        return None
    center = FRAME.enu_from(result.pose.frame).act(result.pose.cam_from_local.center)
    return float(np.linalg.norm(center - shot.cam_from_local.center))


def described(database: Database, map_id: str) -> float:
    """Share of a map's points that answer."""
    found = database.snapshot().load_map(map_id)
    seen = found.observations
    return len(np.unique(seen.point_index[seen.has_descriptor])) / len(found.points)
