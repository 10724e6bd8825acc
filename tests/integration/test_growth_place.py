"""Growth on a small made-up world whose truth is known: placed, refined, refused."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from featuredb.geometry.sim3 import Sim3
from featuredb.maps.move import move_map
from ingest.colmap.anchored import with_observations
from ingest.colmap.bridge import Model
from ingest.growth.graph.map_graph import grow_within_budget
from ingest.growth.map_places import drift_m, places_of
from ingest.growth.place.component import GrownMap, grow_component, lone_groups
from ingest.growth.place.localised import localise_photos
from ingest.growth.values import LocalisedPhoto, Refused
from reloc.localise.candidates import IndexedArea
from tests.support.growth_box import (
    DESCRIPTORS,
    EAST,
    FRAME,
    KEY,
    POINTS,
    WORLD,
    centers_error,
    existing,
    prior,
    walk,
)
from tests.support.new_photos import FINGERPRINT, NewPhotos, identity, take_photos
from tests.support.scenes import (
    CAMERA,
    indexed,
    looking_at,
    ring,
    scene_map,
)
from tools.growth_gates import read_judgements, recorded

_PAIRS = [(0, 1), (0, 2), (1, 2)]


def _left_out(grown: GrownMap) -> dict[int, str]:
    """What the placement left out, by place in the model, and the codes of the reasons."""
    return {k: code for k, (code, _) in grown.placement.left_out.items()}


@pytest.fixture(scope="module")
def area() -> IndexedArea:
    return indexed(existing())


@pytest.fixture(scope="module")
def new() -> NewPhotos:
    return take_photos(np.random.default_rng(3), POINTS, DESCRIPTORS, walk(), camera_key=KEY)


@pytest.fixture(scope="module")
def localised(new: NewPhotos, area: IndexedArea) -> dict[int, LocalisedPhoto]:
    found, reasons = localise_photos(new.given, range(len(new.photos)), [area])
    assert not reasons
    return found


def test_what_the_gates_say_is_recorded_beside_the_truth(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea, tmp_path: Path
) -> None:
    """One photo has no place here: it is the wrong one."""
    true = {photo.name: pose.center for photo, pose in zip(new.photos, new.poses, strict=True)}
    del true[new.photos[0].name]
    with recorded(tmp_path / "gates.jsonl", FRAME, true.get):
        grow_component(new.model, new.given, localised, [area], identity())
    placed, refined = read_judgements([tmp_path / "gates.jsonl"])
    assert (placed.step, refined.step) == ("place", "refine")
    assert (placed.right, placed.wrong, placed.refused_by) == (len(new.photos) - 1, 1, [])
    assert "visibility" in placed.gates


def test_a_reconstruction_is_placed_and_becomes_a_map(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    grown = grow_component(new.model, new.given, localised, [area], identity())
    assert isinstance(grown, GrownMap), grown
    feature_map = grown.feature_map
    assert centers_error(grown, new).max() < 0.05
    assert feature_map.status == "quarantined"
    assert feature_map.generation == 1
    assert feature_map.parents == ("old",)
    assert feature_map.placement.method == "map"
    assert feature_map.height_datum == "ellipsoidal"
    assert all(gate.passes for gate in grown.placement.gates)
    assert 0.0 < drift_m(grown.covariance_relative, places_of(feature_map)) < 0.5
    # On Earth it is as uncertain as its parent, and a little more.
    earth = np.sqrt(np.diag(feature_map.placement.covariance)[4:])
    assert (earth > 0.5).all()
    assert (earth < 0.6).all()
    # It reaches beyond the old map's points, and its points are where the world's are.
    placed = feature_map.points_local(FRAME)
    assert np.quantile(placed[:, 0], 0.95) > 35.0
    nearest = np.array([np.linalg.norm(POINTS - p, axis=1).min() for p in placed[::25]])
    assert np.median(nearest) < 0.1


@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 4), marks=pytest.mark.evaluation)], ids=["one", "more"]
)
def test_the_bound_of_drift_holds(area: IndexedArea, seeds: range) -> None:
    """Independent photos, matches and noise: no point of the map is further off than the map says (95 %)."""
    beyond = 0
    for seed in seeds:
        rng = np.random.default_rng(100 + seed)
        new = take_photos(rng, POINTS, DESCRIPTORS, walk(4), camera_key=KEY)
        found, _ = localise_photos(new.given, range(4), [area])
        grown = grow_component(new.model, new.given, found, [area], identity())
        assert isinstance(grown, GrownMap)
        bound = drift_m(grown.covariance_relative, places_of(grown.feature_map))
        beyond += int(centers_error(grown, new).max() > bound)
    assert beyond <= len(seeds) // 2


def test_one_localised_photo_is_not_enough(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    grown = grow_component(new.model, new.given, {2: localised[2]}, [area], identity())
    assert isinstance(grown, Refused)
    assert grown.reason == "TOO_FEW_AGREE"


def test_nothing_localised(new: NewPhotos, area: IndexedArea) -> None:
    grown = grow_component(new.model, new.given, {}, [area], identity())
    assert isinstance(grown, Refused)
    assert grown.reason == "NOT_LOCALISED"


def test_what_no_step_foresaw_costs_this_reconstruction_only(
    new: NewPhotos,
    localised: dict[int, LocalisedPhoto],
    area: IndexedArea,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("ingest.growth.place.component.place_by_maps", singular)
    refused = grow_within_budget(new.model, new.given, localised, [area], {}, 0.5)
    assert isinstance(refused, Refused)
    assert refused.reason == "FAILED"
    assert "LinAlgError: Singular matrix" in refused.message
    assert "Traceback" in caplog.text


def test_photos_that_contradict_each_other_are_refused(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    """Half of the photos' poses shuffled: what they see is elsewhere than the model says."""
    turned = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.6, 3.0, -8.0, 0.0]))
    wrong = {
        r: p
        if r % 2
        else replace(
            p,
            cam_from_local=turned.act_on_pose(p.cam_from_local),
            points=turned.act(p.points + 4.0 * (r + 1)),
        )
        for r, p in localised.items()
    }
    grown = grow_component(new.model, new.given, wrong, [area], identity())
    assert isinstance(grown, Refused)
    assert grown.reason == "PHOTOS_DISAGREE"


def test_a_photo_that_contradicts_the_others_is_left_out(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    turned = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.6, 3.0, -8.0, 0.0]))
    liar = replace(
        localised[1],
        cam_from_local=turned.act_on_pose(localised[1].cam_from_local),
        points=turned.act(localised[1].points),
    )
    grown = grow_component(new.model, new.given, {**localised, 1: liar}, [area], identity())
    assert isinstance(grown, GrownMap), grown
    assert _left_out(grown) == {1: "CONTRADICTS"}
    assert 1 not in grown.model.rows
    assert centers_error(grown, new).max() < 0.05


def test_photos_that_see_a_look_alike_elsewhere_refuse_it(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    """Two of five photos see the same block 200 m north: another placement that holds together."""
    away = Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([0.0, 200.0, 0.0]))
    there = {
        r: replace(p, cam_from_local=away.act_on_pose(p.cam_from_local), points=away.act(p.points))
        for r, p in localised.items()
        if r in (0, 1)
    }
    some = {r: localised[r] for r in (2, 3, 4)} | there
    grown = grow_component(new.model, new.given, some, [area], identity())
    assert isinstance(grown, Refused)
    assert {g.name for g in grown.gates if not g.passes} >= {"agreement"}


@pytest.mark.parametrize(("liars", "refused"), [(1, False), (5, True)])
def test_positions_that_lie(area: IndexedArea, liars: int, refused: bool) -> None:
    """One photo that lies about its place does not matter; most of them do."""
    poses = walk(6)
    gps = [prior(p, (150.0, 0.0) if k < liars else (2.0, 1.0)) for k, p in enumerate(poses)]
    new = take_photos(np.random.default_rng(5), POINTS, DESCRIPTORS, poses, camera_key=KEY, gps=gps)
    found, _ = localise_photos(new.given, range(6), [area])
    assert len(found) == 6
    grown = grow_component(new.model, new.given, found, [area], identity())
    if refused:
        assert isinstance(grown, Refused)
        assert grown.reason == "CONTRADICTS_GPS"
    else:
        assert isinstance(grown, GrownMap), grown


def _cornered(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], rows: Sequence[int]
) -> tuple[Model, dict[int, LocalisedPhoto]]:
    """These photos show a corner of the place where they should show all of it: behind a wall."""
    kept = dict(localised)
    hidden = np.zeros(len(new.model.point_of), dtype=np.bool_)
    for r in rows:
        photo = localised[r]
        near = np.argsort(np.linalg.norm(photo.pixels - np.median(photo.pixels, axis=0), axis=1))[:40]
        kept[r] = replace(
            photo,
            feature_rows=photo.feature_rows[near],
            pixels=photo.pixels[near],
            map_of=photo.map_of[near],
            point_of=photo.point_of[near],
            points=photo.points[near],
            point_covariance=photo.point_covariance[near],
        )
        of_old = np.flatnonzero(new.world_of[r] < len(WORLD))
        gone = np.setdiff1d(of_old, photo.feature_rows[near])
        hidden |= (new.model.photo_of == r) & np.isin(new.model.keypoint_of, gone)
    views = np.bincount(new.model.point_of[~hidden], minlength=len(new.model.xyz))
    return with_observations(new.model, ~hidden & (views[new.model.point_of] >= 2)), kept


def test_photos_blind_for_what_they_should_show(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    bare, kept = _cornered(new, localised, list(localised))
    grown = grow_component(bare, new.given, kept, [area], identity())
    assert isinstance(grown, Refused)
    assert "visibility" in {g.name for g in grown.gates if not g.passes}


def test_a_single_blind_photo_is_left_out(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    bare, kept = _cornered(new, localised, [1])
    grown = grow_component(bare, new.given, kept, [area], identity())
    assert isinstance(grown, GrownMap), grown
    assert _left_out(grown) == {1: "NOT_VISIBLE"}
    assert grown.left_out[1][0] == "NOT_VISIBLE"
    assert 1 not in grown.model.rows
    whole = grow_component(new.model, new.given, localised, [area], identity())
    assert isinstance(whole, GrownMap), whole
    assert _left_out(whole) == {}
    assert 1 in whole.model.rows


def test_a_photo_that_shows_little_of_what_its_neighbours_see_is_left_out(
    new: NewPhotos, localised: dict[int, LocalisedPhoto], area: IndexedArea
) -> None:
    """No map localises it, and it hangs on the others by a corner of what it should show of their points."""
    others = {r: photo for r, photo in localised.items() if r != 4}
    of_it = new.model.photo_of == 4
    pixels = new.keypoints()[4][new.model.keypoint_of[of_it]]
    seen = ~of_it
    seen[of_it] = (pixels < 0.4 * np.array([CAMERA.width, CAMERA.height])).all(axis=1)
    views = np.bincount(new.model.point_of[seen], minlength=len(new.model.xyz))
    bare = with_observations(new.model, seen & (views[new.model.point_of] >= 2))
    lone = grow_component(bare, new.given, others, [area], identity())
    assert isinstance(lone, GrownMap), lone
    assert _left_out(lone) == {4: "NOT_VISIBLE"}
    assert lone.left_out[4][0] == "NOT_VISIBLE"
    grown = grow_component(new.model, new.given, others, [area], identity())
    assert isinstance(grown, GrownMap), grown
    assert _left_out(grown) == {}
    assert 4 in grown.model.rows


def test_overlaps_with_two_maps_tell_how_these_differ(new: NewPhotos) -> None:
    """The other map shows the east, placed 0.4 m off; the new photos overlap both."""
    shift = Sim3(scale=1.0, rotation=np.eye(3), translation=np.array([0.0, 0.4, 0.0]))
    east = scene_map(
        points=EAST,
        descriptors=DESCRIPTORS[len(WORLD) :],
        poses=[
            looking_at(p.center + np.array([38.0, 0.0, 0.0]), np.array([38.0, 0.0, 3.0])) for p in ring(10)
        ],
        map_id="east",
        camera_keys=(KEY,),
        fingerprint=FINGERPRINT,
        point_covariance=(4e-4, 0.0, 0.0, 4e-4, 0.0, 4e-4),
        seed=4,
    )
    both = indexed(existing(), move_map(east, shift))
    found, _ = localise_photos(new.given, range(len(new.photos)), [both])
    grown = grow_component(new.model, new.given, found, [both], identity())
    assert isinstance(grown, GrownMap), grown
    assert set(grown.feature_map.parents) == {"old", "east"}
    edges = {edge.map_id: edge.other_from_map for edge in grown.placement.edges}
    middle = np.array([20.0, 0.0, 3.0])
    apart = (edges["old"] @ edges["east"].inverse()).act(middle) - middle
    assert float(np.linalg.norm(apart)) == pytest.approx(0.4, abs=0.15)


def test_lone_photos_vouch_for_each_other(new: NewPhotos, area: IndexedArea) -> None:
    """No reconstruction at all: localised photos whose matches fit their poses become a map."""
    found, _ = localise_photos(new.given, range(3), [area])
    (group,), waiting = lone_groups(found, replace(new.given, overlaps=_PAIRS))
    assert not waiting
    made = grow_component(group, new.given, found, [area], identity())
    assert isinstance(made, GrownMap), made
    assert sorted(made.model.rows.tolist()) == [0, 1, 2]
    assert centers_error(made, new).max() < 0.1
    assert np.quantile(made.feature_map.points_local(FRAME)[:, 0], 0.9) > 25.0


def test_a_lone_photo_waits(new: NewPhotos, area: IndexedArea) -> None:
    found, _ = localise_photos(new.given, [0], [area])
    groups, waiting = lone_groups(found, replace(new.given, overlaps=_PAIRS))
    assert not groups
    assert waiting[0].startswith("ALONE")


def test_lone_photos_whose_matches_contradict_their_poses_wait(new: NewPhotos, area: IndexedArea) -> None:
    found, _ = localise_photos(new.given, range(2), [area])
    away = Sim3.exp(np.array([0.0, 0.0, 0.0, 0.05, 1.5, 0.0, 0.0]))
    found[1] = replace(
        found[1],
        cam_from_local=away.act_on_pose(found[1].cam_from_local),
        points=away.act(found[1].points),
    )
    (group,), _ = lone_groups(found, replace(new.given, overlaps=_PAIRS))
    refused = grow_component(group, new.given, found, [area], identity())
    assert isinstance(refused, Refused)
    assert refused.reason == "TOO_FEW_AGREE"
