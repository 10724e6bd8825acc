"""People who photograph their way over the hills of `hill_photos`, away from an anchored survey."""

import io
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from featuredb.geometry.rigid3 import Rigid3
from featuredb.store import Database
from featuredb.store.candidates.photos import contribute
from featuredb.store.candidates.states import Contribution
from ingest.growing import GrowingOptions
from ingest.growth.values import GrowthOptions
from ingest.pipeline import IngestOptions, ingest_photos
from tests.support.hill_map import MAKING
from tests.support.hill_photos import CAMERA, FRAME, _exif, _render
from tests.support.planar_map import field_texture, view

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
WEST_M = -32.0  # middle of the survey that anchors the database


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """A photo of the walk: bytes, pose in FRAME, owner."""

    data: bytes
    cam_from_local: Rigid3
    owner: str


def survey(folder: Path, east_m: float = WEST_M, number: int = 0) -> None:
    """Nine photos with exact GPS around a place on the hills."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(9):
        pose = _pose(east_m + (k % 3 - 1) * 9.0, (k // 3 - 1) * 9.0, k)
        (folder / f"survey_{number}_{k}.jpg").write_bytes(_jpeg(pose, 100 * number + k, with_gps=True))


def anchored_database(folder: Path) -> Database:
    """A database with the map of one survey, good to centimetres."""
    survey(folder / "survey")
    database = Database.create(folder / "db")
    add_survey(database, folder / "survey")
    return database


def add_survey(database: Database, folder: Path) -> str:
    """Ingest a survey; the map's id."""
    options = IngestOptions(workers=1, gps_sigma_m=(0.02, 0.02), making=MAKING)
    return ingest_photos(database, folder, options).maps[0].map_id


def step_of(east_m: float, owners: tuple[str, ...] = ("anna", "ben"), each: int = 3) -> list[Shot]:
    """Photos around a place of the way, some of each owner, without GPS."""
    shots = []
    for who, owner in enumerate(owners):
        for k in range(each):
            seed = round(1000 + 10 * (east_m + 100) + 37 * who + k)
            north = (k - (each - 1) / 2) * 9.0 + 3.0 * who
            pose = _pose(east_m + 4.0 * (k % 2) - 5.0 * who, north, seed)
            shots.append(Shot(data=_jpeg(pose, seed, with_gps=False), cam_from_local=pose, owner=owner))
    return shots


def give(database: Database, shots: list[Shot], at: datetime = NOW) -> list[str]:
    """Contribute photos as the server does; their candidate ids."""
    return contribute(
        database,
        [
            Contribution(
                image=shot.data, width=CAMERA.width, height=CAMERA.height, owner=shot.owner,
                credit=f"name of {shot.owner}",
                licence="CC0-1.0", received_at=at + timedelta(seconds=k),
            )
            for k, shot in enumerate(shots)
        ],
    )  # fmt: skip


def growing(
    *, budget_m: float = 0.5, trusted: tuple[str, ...] = (), give_up_days: float = 1e6
) -> GrowingOptions:
    """Options that fit these small photos."""
    return GrowingOptions(
        growth=GrowthOptions(drift_budget_m=budget_m, trusted=trusted),
        making=MAKING,
        give_up_days=give_up_days,
    )


def error_m(database: Database, shots: list[Shot], map_id: str) -> float:
    """Largest error of the centres of the shots that a map has, against the truth."""
    import hashlib

    truth = {hashlib.sha256(s.data).hexdigest(): s.cam_from_local for s in shots}
    feature_map = database.snapshot().load_map(map_id)
    frame_from_map = FRAME.enu_from(feature_map.frame)
    errors = [
        float(np.linalg.norm(frame_from_map.act(i.cam_from_local.center) - truth[i.sha256].center))
        for i in feature_map.images
    ]
    return max(errors)


def _pose(east: float, north: float, k: int) -> Rigid3:
    up = 45.0 + 3.0 * ((k * 7) % 3)
    return view(east, north, up, tilt_deg=float((k * 5) % 13), heading_deg=float((k * 37) % 50))


def _jpeg(pose: Rigid3, seed: int, *, with_gps: bool) -> bytes:
    buffer = io.BytesIO()
    picture = Image.fromarray(_render(field_texture(1), pose, seed=seed))
    exif = _exif(pose.center, seed % 1000, with_gps=with_gps)
    exif[ExifTags.Base.Model.value] = "Hill 1"
    picture.save(buffer, format="JPEG", quality=92, exif=exif)
    return buffer.getvalue()
