"""Edits and their cameras, geotags, copied blocks, people: values against closed forms and renderings."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from featuredb.errors import InvalidValueError
from featuredb.geometry.camera import Camera
from featuredb.geometry.rigid3 import Rigid3
from featuredb.simworld.camera.photograph import render_depth, render_view
from featuredb.simworld.camera.raster import render
from featuredb.simworld.flight import FlightOptions, received_positions, survey
from featuredb.simworld.town.scene import Ellipsoids, Scene
from featuredb.simworld.town.town import make_town
from tools.worlds.album import day_key, day_scene
from tools.worlds.community import CommunityOptions, plan_community
from tools.worlds.edits import Edit, edited, edited_camera
from tools.worlds.people import (
    GeotagOptions,
    Tagging,
    community,
    geotag_at,
    give_geotags,
    stored_upright,
    zoomed,
)
from tools.worlds.poison_world import Rect, blocks_of, forged, with_copied_block
from tools.worlds.sights import Surroundings, find_sights, look_at

SIZE = (200.0, 180.0)
TINY = CommunityOptions(
    seed=6,
    town_size_m=SIZE,
    flight=FlightOptions(lines=2, per_line=2, oblique=0, width=320, gps_error="rtk"),
    photos=24,
    other_town=8,
    copies=5,
    indoor=1,
    portraits=1,
    sights=3,
    width=320,
    texel_m=0.25,
    pieces=1,
)


@pytest.fixture(scope="module")
def town() -> Scene:
    return make_town(6, size_m=SIZE, texel_m=0.25)


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV"])
def test_the_edited_picture_is_what_the_edited_camera_sees(model: str) -> None:
    """A white dot at a known point of the world is where the edited camera projects that point."""
    lens = (600.0, 320.5, 239.0, 0.02)
    camera = Camera(
        model=model,
        width=640,
        height=480,
        params=lens if model == "SIMPLE_RADIAL" else (600.0, 602.0, 320.5, 239.0, -0.03, 0.01, 0.0005, 0.0),
    )
    point = np.array([0.15, -0.1, 1.0])
    image = np.zeros((480, 640, 3), np.uint8)
    u, v = camera.project(point[None])[0]
    y, x = np.mgrid[:480, :640] + 0.5
    image[np.hypot(x - u, y - v) < 6.0] = 255
    edits = (
        Edit(kind="cropped", amount=0.1),
        Edit(kind="resized", amount=0.73),
        Edit(kind="bordered", amount=0.03),
    )
    result, changed = edited(image, edits, seed=3), edited_camera(camera, edits, seed=3)
    assert changed is not None
    assert result.shape[:2] == (changed.height, changed.width)
    inner = result[20:-20, 20:-20, 0].astype(float)  # without the frame, which may be white
    rows, columns = np.mgrid[20 : 20 + inner.shape[0], 20 : 20 + inner.shape[1]] + 0.5
    centre = (columns * inner).sum() / inner.sum(), (rows * inner).sum() / inner.sum()
    np.testing.assert_allclose(centre, changed.project(point[None])[0], atol=0.15)


def test_a_mirror_has_no_camera_and_other_edits_keep_theirs() -> None:
    camera = Camera.from_focal(64, 48, 60.0)
    assert edited_camera(camera, (Edit(kind="mirrored"),), 1) is None
    for kind in ("watermarked", "pasted", "moved", "painted_over", "warped"):
        edit = Edit(kind=kind, amount=0.2)
        assert edited_camera(camera, (edit,), 1) == camera
        image = np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        changed = edited(image, (edit,), 2)
        assert changed.shape == image.shape
        assert (changed != image).any(axis=2).mean() > 0.01
        np.testing.assert_array_equal(changed, edited(image, (edit,), 2))


def test_an_unknown_edit_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="resized"):
        Edit(kind="bent")
    with pytest.raises(InvalidValueError, match="amount"):
        Edit(kind="resized", amount=0.0)


def test_geotags_have_the_errors_that_were_asked_for(town: Scene) -> None:
    """Errors recomputed from the degrees: spread per axis, correlation in a visit, share of kilometres."""
    options = GeotagOptions(sigma_m=30.0, far_share=0.1)
    photos = [
        Tagging(center=np.array([5.0, -7.0, 40.0]), visit=i // 4, tagged=i % 10 != 9, by_hand=i % 2 == 0)
        for i in range(4000)
    ]
    given = give_geotags(town, photos, options, np.random.default_rng(2))
    assert sum(tag is None for tag in given) == 400
    errors = {
        i: town.frame.enu_from_geodetic((tag.latitude_deg, tag.longitude_deg, town.frame.height_m))[:2]
        - photos[i].center[:2]
        for i, tag in enumerate(given)
        if tag is not None
    }
    far = [i for i, error in errors.items() if np.linalg.norm(error) > 900.0]
    assert len(far) == 360
    near = np.array([errors[i] for i in errors if i not in set(far)])
    np.testing.assert_allclose(near.std(axis=0), 30.0, rtol=0.05)
    pairs = [(i, i + 1) for i in range(0, 4000, 4) if {i, i + 1} <= errors.keys() - set(far)]
    first, second = (np.array([errors[p[k]] for p in pairs]) for k in (0, 1))
    assert np.corrcoef(first[:, 0], second[:, 0])[0, 1] == pytest.approx(0.5, abs=0.1)
    heights = {tag.height_m is None for i, tag in enumerate(given) if tag and i % 2 == 0}
    assert heights == {True}


def test_a_geotag_is_where_the_point_is(town: Scene) -> None:
    tag = geotag_at(town, np.array([120.0, -35.0, 10.0]), 2.5, 8.0)
    assert tag.height_m is not None
    back = town.frame.enu_from_geodetic((tag.latitude_deg, tag.longitude_deg, tag.height_m))
    np.testing.assert_allclose(back, [120.0, -35.0, 12.5], atol=1e-3)


def pair_of_blocks(town: Scene) -> tuple[Rect, Rect]:
    rows: dict[float, list[Rect]] = {}
    for block in blocks_of(town.plan):
        rows.setdefault(block[1], []).append(block)
    row = sorted(next(r for r in rows.values() if len(r) >= 2))
    return row[0], row[-1]


def view_of(scene: Scene, middle: float, y: float, offset: tuple[float, float], flip: float) -> Rigid3:
    eye = np.array([middle + flip * offset[0], y + offset[1], 32.0])
    return look_at(scene, eye, np.array([middle, y, 0.0]))


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_copy_of_a_block_looks_like_the_block(town: Scene, mirrored: bool) -> None:
    """The copy seen from the same side (or its mirror image from the mirrored side) has the same pixels."""
    source, target = pair_of_blocks(town)
    # Without what is high around it: other surroundings are what differs.
    bare = replace(town, ellipsoids=no_crowns())
    twice = with_copied_block(bare, source, target, mirrored=mirrored)
    camera = Camera.from_focal(160, 120, 300.0)
    y = 0.5 * (source[1] + source[3])
    middles = [0.5 * (r[0] + r[2]) for r in (source, target)]
    original = render_view(twice, camera, view_of(twice, middles[0], y, (4.0, -14.0), 1.0), moment=1)
    flip = -1.0 if mirrored else 1.0
    copy = render_view(twice, camera, view_of(twice, middles[1], y, (4.0, -14.0), flip), moment=1)
    if mirrored:
        copy = copy[:, ::-1]
    inner = slice(30, 90), slice(40, 120)
    same = np.abs(original[inner].astype(int) - copy[inner]).max(axis=2) < 25
    assert same.mean() > 0.93
    before = render_view(bare, camera, view_of(bare, middles[1], y, (4.0, -14.0), flip), moment=1)
    assert (np.abs(before[inner].astype(int) - copy[inner]).max(axis=2) < 25).mean() < 0.7


def no_crowns() -> Ellipsoids:
    empty = np.zeros((0, 3))
    return Ellipsoids(
        center=empty, radii=empty, tint=empty, texture_uv=np.zeros((0, 2)), object_id=np.zeros(0, np.int32)
    )


def test_blocks_of_different_rows_are_refused(town: Scene) -> None:
    blocks = blocks_of(town.plan)
    other = next(b for b in blocks if b[1] != blocks[0][1])
    with pytest.raises(InvalidValueError, match="row"):
        with_copied_block(town, blocks[0], other)


def test_the_forged_town_differs_in_buildings_alone(town: Scene) -> None:
    rect = (-70.0, -20.0, 70.0, 70.0)
    lie = forged(town, rect, seed=3)
    assert lie.plan == town.plan
    moved = np.linalg.norm(lie.faces.origin - town.faces.origin, axis=1)
    painted = lie.faces.texture != town.faces.texture
    touched = np.unique(town.faces.object_id[(moved > 1e-9) | painted])
    assert len(touched) >= 5
    assert touched.min() >= 10_000
    assert touched.max() < 20_000
    distances = moved[moved > 1e-9]
    assert 1.9 < distances.min() <= distances.max() < 6.1


def test_stands_see_their_sights_and_are_free(town: Scene) -> None:
    sights, around = find_sights(town, 4, seed=1), Surroundings(town)
    assert len(sights) == 4
    camera = Camera.from_focal(48, 36, 40.0)
    for sight in sights:
        for stand in sight.stands:
            eye, target = np.array(stand), np.array(sight.target)
            assert around.free(eye)
            rendered = render(town.faces, town.ellipsoids, camera, look_at(town, eye, target), look=None)
            away = np.linalg.norm(target - eye)
            assert 0.2 * away < np.median(rendered.depth[12:24, 16:32]) < 1.5 * away


def test_nobody_stands_in_a_house_or_in_the_ground(town: Scene) -> None:
    around = Surroundings(town)
    b = town.plan.buildings[0]
    assert not around.free(np.array([b.x, b.y, b.eaves - 1.0]))
    assert around.free(np.array([b.x, b.y, b.eaves + b.ridge + 30.0]))
    assert not around.free(np.array([b.x, b.y, -5.0]))


def test_devices_are_turned_and_zoomed_as_lenses_are() -> None:
    people = {p.name: p for p in community(1600)}
    assert len(people) == 12
    phone = people["hugo"].ground
    assert phone is not None
    upright = stored_upright(phone)
    assert (upright.camera.width, upright.camera.height) == (phone.camera.height, phone.camera.width)
    # A quarter turn: x to the right becomes y down, so the pixel (u, v) becomes (h - v, u).
    u, v = phone.camera.project(np.array([[0.2, 0.1, 1.0]]))[0]
    turned = upright.camera.project(np.array([[-0.1, 0.2, 1.0]]))[0]
    np.testing.assert_allclose(turned, [phone.camera.height - v, u], atol=1e-9)
    near = zoomed(phone, 2.0)
    assert near.camera.focal_px == pytest.approx(2 * phone.camera.focal_px)
    assert near.focal_mm == 2 * phone.focal_mm


def test_rtk_is_good_to_centimetres_and_the_survey_can_be_moved(town: Scene) -> None:
    rng = np.random.default_rng(1)
    errors = received_positions(np.zeros((3000, 3)), 1.0, "rtk", rng)
    np.testing.assert_allclose(errors.std(axis=0), [0.015, 0.015, 0.025], rtol=0.06)
    here = FlightOptions(lines=2, per_line=2, oblique=0, gps_error="none")
    there = replace(here, center_m=(30.0, -12.0))
    for a, b in zip(survey(town, here, 1), survey(town, there, 1), strict=True):
        shift = town.enu_from_town.T @ (b.cam_from_local.center - a.cam_from_local.center)
        np.testing.assert_allclose(shift, [30.0, -12.0, 0.0], atol=1e-9)


def test_days_differ_in_cars_and_light_alone(town: Scene) -> None:
    key = day_key("home", 200, 9.0)
    day = day_scene(town, key)
    assert day_scene(town, "home/0/000") is town
    camera = Camera.from_focal(64, 48, 60.0)
    b = town.plan.buildings[0]
    pose = look_at(town, np.array([b.x, b.y - 1, b.eaves + 30.0]), np.array([b.x, b.y, b.eaves]))
    np.testing.assert_array_equal(
        render_depth(town, camera, pose).depth[20:28, 28:36],
        render_depth(day, camera, pose).depth[20:28, 28:36],
    )
    assert len(day.faces) < len(town.faces)
    assert day.plan.to_sun != town.plan.to_sun


def test_the_community_is_planned_as_asked() -> None:
    photos = plan_community(TINY)
    kinds = Counter(p.fact.kind for p in photos)
    assert kinds["street"] + kinds["drone"] == 24
    assert (kinds["other_town"], kinds["copy"], kinds["indoor"], kinds["portrait"]) == (8, 5, 1, 1)
    names = {p.shot.name for p in photos}
    assert len(names) == len(photos) == len({p.fact.photo_id for p in photos})
    around = Surroundings(TINY.scene("home/0/000"))
    for p in photos:
        assert p.fact.name == p.shot.name
        assert p.fact.kind not in p.fact.name
        assert p.fact.owner in p.fact.name
        if p.fact.kind in ("street", "drone"):
            town_axes = around.scene.enu_from_town.T @ p.shot.cam_from_local.center
            assert around.free(town_axes, margin_m=0.9)
        if p.fact.kind == "copy":
            assert p.fact.copy_of in names
    again = plan_community(TINY)
    assert [p.shot.seed for p in again] == [p.shot.seed for p in photos]
