"""Maps of one long strip of made-up points: overlapping, owned by different people, displaced at will."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from featuredb.features.extractor import ExtractorOptions
from featuredb.geo.local_frame import LocalFrame
from featuredb.geometry.arrays import FloatArray
from featuredb.geometry.sim3 import Sim3
from featuredb.maps.feature_map import FeatureMap, MapStatus, Placement
from featuredb.maps.lineage import GROWTH
from featuredb.maps.move import in_frame, move_map
from featuredb.store import Database
from featuredb.store.candidates.photos import Owners, contribute, mark_confirmed, mark_used
from featuredb.store.candidates.states import Contribution
from ingest.growth.graph.map_graph import place_key
from ingest.growth.trust.confirmation import Sources
from ingest.growth.values import Edge
from tests.support.scenes import (
    EASTING,
    EPSG,
    HEIGHT,
    NORTHING,
    looking_at,
    noisy,
    random_descriptors,
    scene_map,
)

FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
FINGERPRINT = ExtractorOptions().fingerprint
_LENGTH_M, _HALF_M, _DENSITY = 240.0, 25.0, 0.18
_RNG = np.random.default_rng(5)
_COUNT = round(_LENGTH_M * 2 * _HALF_M * _DENSITY)
POINTS: FloatArray = _RNG.uniform([-20.0, -_HALF_M, 0.0], [_LENGTH_M - 20.0, _HALF_M, 10.0], (_COUNT, 3))
DESCRIPTORS = random_descriptors(_RNG, _COUNT)
_TIGHT = np.diag(np.repeat([1e-7, 0.02], [4, 3]) ** 2)
EDGE = np.diag(np.array([5e-4, 5e-4, 5e-4, 5e-4, 0.05, 0.05, 0.05]) ** 2)


def strip_map(
    map_id: str,
    east_m: float,
    *,
    owners: Sequence[str] = ("",),
    parents: Sequence[FeatureMap] = (),
    status: MapStatus | None = None,
    move: Sim3 | None = None,
    drift_m: float = 0.1,
    reach_m: float = 30.0,
    seed: int = 0,
    days: Sequence[int] = (1,),
    covariance: FloatArray | None = None,
    cameras: int = 8,
) -> FeatureMap:
    """A map of the strip around `east_m` by cameras on a circle; owners and days take turns.

    Args:
        parents: maps that placed it, each by an edge that says it lies exactly right.
        move: displacement of the whole map in FRAME: its error.
    """
    near = np.flatnonzero(np.abs(POINTS[:, 0] - east_m) < reach_m)
    rng = np.random.default_rng(seed)
    turn = np.arange(cameras) * (2 * np.pi / cameras)
    centers = np.column_stack(
        [east_m + 35 * np.cos(turn), 35 * np.sin(turn), 35 + rng.uniform(-3, 3, cameras)]
    )
    poses = [looking_at(center, np.array([east_m, 0.0, 3.0])) for center in centers]
    made = scene_map(
        points=POINTS[near],
        descriptors=noisy(rng, DESCRIPTORS[near]),
        poses=poses,
        map_id=map_id,
        frame=FRAME,
        fingerprint=FINGERPRINT,
        placement_covariance=_TIGHT if covariance is None else covariance,
        seed=seed,
    )
    images = tuple(
        replace(
            image,
            name=f"{map_id}/{image.name}",
            sha256=hashlib.sha256(photo_of(map_id, image.image_id)).hexdigest(),
            owner=owners[k % len(owners)],
            capture_time=datetime(2026, 5, days[k % len(days)], 12),
        )
        for k, image in enumerate(made.images)
    )
    made = replace(made, images=images, status=status or ("quarantined" if parents else "active"))
    if move is not None:
        made = move_map(made, in_frame(move, FRAME, made.frame), covariance=made.placement.covariance)
    return grown(made, parents, drift_m) if parents else made


def grown(feature_map: FeatureMap, parents: Sequence[FeatureMap], drift_m: float = 0.1) -> FeatureMap:
    """The map as if these had placed it where it is."""
    edges = [
        Edge(
            map_id=parent.map_id, place=place_key(parent.frame, parent.placement),
            other_from_map=Sim3.identity(), covariance=EDGE, shared_points=500, photos=8,
        )
        for parent in parents
    ]  # fmt: skip
    growth: dict[str, Any] = {
        "drift_m": drift_m,
        "budget_m": 0.5,
        "covariance_relative": EDGE.ravel().tolist(),
        "edges": [edge.as_json() for edge in edges],
    }
    placement = feature_map.placement
    return replace(
        feature_map,
        placement=Placement(
            method="map",
            local_from_sfm=placement.local_from_sfm,
            covariance=placement.covariance,
            residual_rms_m=0.01,
            evidence={GROWTH: growth},
        ),
        parents=tuple(parent.map_id for parent in parents),
        generation=1 + max(parent.generation for parent in parents),
    )


def east(metres: float) -> Sim3:
    """A displacement."""
    return Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([metres, 0.0, 0.0]))


def error_m(feature_map: FeatureMap, east_m: float, reach_m: float = 30.0) -> float:
    """Largest distance of the map's points from where they are in truth."""
    near = np.flatnonzero(np.abs(POINTS[:, 0] - east_m) < reach_m)
    return float(np.linalg.norm(feature_map.points_local(FRAME) - POINTS[near], axis=1).max())


def photo_of(map_id: str, image_id: int) -> bytes:
    """What stands for the bytes of an image's photo."""
    return f"photo {image_id} of {map_id}".encode()


def given_by(feature_map: FeatureMap) -> dict[str, str]:
    """Who has contributed which photo of a map, by candidate id: each its `owner`, but those of a survey."""
    return {i.sha256[:32]: i.owner for i in feature_map.images if i.owner not in ("", "survey")}


def sources_of(*maps: FeatureMap, on_record: Sequence[str] = (), trusted: Sequence[str] = ()) -> Sources:
    """The sources of maps that were made of contributions by their images' `owner`s."""
    owners = Owners(
        givers={c: owner for m in maps for c, owner in given_by(m).items()},
        made_of={m.map_id: frozenset(given_by(m)) for m in maps},
        on_record=frozenset(on_record),
    )
    return Sources(owners=owners, trusted=tuple(trusted))


def put_on_record(database: Database, *owners: str, by: str = "A") -> None:
    """As if a photo of each of them had been confirmed in that map."""
    photos = [f"known photo of {owner}".encode() for owner in owners]
    mark_confirmed(database, contribute(database, list(map(_contribution, photos, owners))), by)


def note_contributed(database: Database, feature_map: FeatureMap, owner: str = "") -> None:
    """Have the photos of a map contributed and used for it, as the server and growth do.

    Args:
        owner: of all of them, whatever names were given with them; default: each by its `owner`.
    """
    given = given_by(feature_map)
    ids = contribute(
        database,
        [
            _contribution(photo_of(feature_map.map_id, image.image_id), owner or image.owner)
            for image in feature_map.images
            if image.sha256[:32] in given
        ],
    )
    mark_used(database, ids, feature_map.map_id)


def _contribution(image: bytes, owner: str) -> Contribution:
    return Contribution(
        image=image, width=1, height=1, owner=owner, credit="A. Person", licence="CC0-1.0",
        received_at=datetime(2026, 6, 1, tzinfo=UTC),
    )  # fmt: skip


ANCHOR = strip_map("A", 20.0, owners=["survey"])


def database_of(folder: Path, *maps: FeatureMap) -> Database:
    """A new one with these maps, one after the other, as they came."""
    database = Database.create(folder / "db")
    for feature_map in maps:
        add(database, feature_map)
    return database


def add(database: Database, feature_map: FeatureMap) -> None:
    """As growth does; photos of "survey" are the operator's, others contributed by that identity."""
    note_contributed(database, feature_map)
    database.commit_map(feature_map)
