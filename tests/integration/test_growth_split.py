"""A reconstruction that look-alikes have joined from two places becomes two maps."""

import itertools
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from featuredb.geometry.rigid3 import Rigid3
from featuredb.geometry.sim3 import Sim3
from featuredb.store import Database
from ingest.colmap.bridge import Model
from ingest.growth.graph import map_graph
from ingest.growth.growth_report import GrowthReport
from ingest.growth.place.component import AT_SEVERAL_PLACES
from ingest.growth.run import grow
from ingest.growth.values import GrowthPhotos, Refused
from tests.support.few_canaries import few_canaries as few_canaries
from tests.support.growth_box import DESCRIPTORS, FRAME, KEY, POINTS, existing, prior, walk
from tests.support.new_photos import SFM_FROM_LOCAL, NewPhotos, take_photos
from tests.support.scenes import looking_at
from tools.growth_gates import read_judgements, recorded

_JOINT = 25  # points of one facade that the joint rests on; photos see several hundred
_APART_M = 60.0  # that the reconstruction has the two groups from where they are to each other


def _north(count: int = 5) -> list[Rigid3]:
    """Cameras on the other side, which see other faces of the box from a little further off."""
    return [
        looking_at(np.array([-12.0 + 6.0 * k, 50.0, 32.0]), np.array([6.0 * k - 8.0, 0.0, 3.0]))
        for k in range(count)
    ]


def _joined(first: Model, second: Model) -> Model:
    """Both as one, tied by points that the last photo of the first and the first of the second see."""
    count = len(first.rows)
    tied = first.point_of[first.photo_of == count - 1][:_JOINT]
    spare = np.flatnonzero(second.photo_of == 0)[:_JOINT]  # keypoints that see the joint's points instead
    left = np.setdiff1d(np.arange(len(second.point_of)), spare)
    point_of = np.concatenate([first.point_of, second.point_of[left] + len(first.xyz), tied])
    photo_of = np.concatenate([first.photo_of, second.photo_of[left] + count, np.full(_JOINT, count)])
    keypoint_of = np.concatenate([first.keypoint_of, second.keypoint_of[left], second.keypoint_of[spare]])
    order = np.lexsort((photo_of, point_of))
    return Model(
        cameras=first.cameras,
        rows=np.arange(count + len(second.rows)),
        camera_of=np.zeros(count + len(second.rows), dtype=np.int64),
        cam_from_sfm=(*first.cam_from_sfm, *second.cam_from_sfm),
        xyz=np.concatenate([first.xyz, second.xyz]),
        point_of=point_of[order],
        photo_of=photo_of[order],
        keypoint_of=keypoint_of[order],
    )


def _groups(south: int, north: int, *, tagged: bool = False) -> tuple[NewPhotos, NewPhotos]:
    """Photos from two sides; with `tagged` those from the north say truly where they are."""
    shift = Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([_APART_M, 0.0, 0.0]))
    rng, poses = np.random.default_rng(11), _north(north)
    return (
        take_photos(rng, POINTS, DESCRIPTORS, walk(south, step_m=4.0), camera_key=KEY),
        take_photos(
            rng, POINTS, DESCRIPTORS, poses, camera_key=KEY, sfm_from_local=SFM_FROM_LOCAL @ shift,
            gps=[prior(p) for p in poses] if tagged else None,
        ),
    )  # fmt: skip


def _grown(groups: tuple[NewPhotos, NewPhotos], folder: Path) -> GrowthReport:
    south, north = groups
    photos = [
        *(replace(p, owner="anna") for p in south.photos),
        *(
            replace(p, owner="ben", name=f"north-{p.name}", sha256=f"{k + 9000:064x}")
            for k, p in enumerate(north.photos)
        ),
    ]
    features = [*south.features, *north.features]
    database = Database.create(folder / "db")
    database.commit_map(existing())
    model = _joined(south.model, north.model)
    everyone = NewPhotos(
        photos=photos,
        features=features,
        poses=[*south.poses, *north.poses],
        model=model,
        world_of=[*south.world_of, *north.world_of],
    )
    new = GrowthPhotos(
        photos=photos,
        features_of=everyone.features_of,
        models=lambda: [model],
        overlaps=list(itertools.combinations(range(len(photos)), 2)),
        geometry_of=everyone.geometry_of,
    )
    return grow(database, new, folder / "work")


def test_both_places_become_maps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As a whole it is refused; each judgement can be written down."""
    noted = tmp_path / "gates.jsonl"
    with caplog.at_level(logging.INFO, "ingest.growth"), recorded(noted, FRAME, lambda name: None):
        report = _grown(_groups(5, 5), tmp_path)
    assert [len(j.key.split()) for j in read_judgements([noted]) if j.step == "budget"] == [5, 5]
    names = [set(m.photos) for m in report.maps if m.map_id]
    apart = [r.message for r in caplog.records if "at several places" in r.message]
    assert len(apart) == 1
    assert apart[0].startswith("10 photos are at several places: ")
    assert apart[0].endswith("apart at links of 0.1")
    north = {f"north-new-{k}.jpg" for k in range(5)}
    south = {f"new-{k}.jpg" for k in range(5)}
    assert sorted(names, key=min) == sorted((south, north), key=min)


def test_geotags_that_contradict_are_not_cut_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Three of ten photos say that they are elsewhere: the others are not taken as what is left of it.

    What is left are photos that are localised one by one, and stand where each of them is.
    """
    real, reasons = map_graph.grow_component, []

    def noted(*args: Any) -> Any:
        outcome = real(*args)
        reasons.append(outcome.reason if isinstance(outcome, Refused) else None)
        return outcome

    monkeypatch.setattr(map_graph, "grow_component", noted)
    with caplog.at_level(logging.INFO, "ingest.growth"):
        report = _grown(_groups(7, 3, tagged=True), tmp_path)
    assert reasons == ["CONTRADICTS_GPS", None]  # the group of the lone photos
    assert not [r for r in caplog.records if "at several places" in r.message]
    assert [len(m.photos) for m in report.maps if m.map_id] == [10]


@pytest.mark.parametrize(
    "reason", [*AT_SEVERAL_PLACES, pytest.param("CONTRADICTS_GPS", marks=pytest.mark.evaluation)]
)
def test_what_is_refused_as_a_whole_is_tried_in_parts_if_places_may_be_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reason: str
) -> None:
    """The first answer is that of a gate; the parts are placed as they are."""
    real, asked = map_graph.grow_component, []

    def refused_first(model: Model, *args: Any) -> Any:
        asked.append(len(model.rows))
        return Refused(reason=reason, message="as told") if len(asked) == 1 else real(model, *args)

    monkeypatch.setattr(map_graph, "grow_component", refused_first)
    report = _grown(_groups(5, 5), tmp_path)
    # What is not split is in a group of lone photos afterwards.
    assert asked == ([10, 5, 5] if reason in AT_SEVERAL_PLACES else [10, 10])
    maps = [len(m.photos) for m in report.maps if m.map_id]
    assert maps == ([5, 5] if reason in AT_SEVERAL_PLACES else [10])
