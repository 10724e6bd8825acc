"""The viewer's page in a real Chromium: what a person sees and clicks; nothing comes from elsewhere."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

from featuredb.store import Database
from reloc.tracking.trajectory.files import read_trajectory_csv
from reloc.viewer.page import write_static_page
from reloc.viewer.photos import Pictures
from reloc.viewer.scene import ViewerSceneOptions, build_scene
from tests.support.datasets import varied_database
from tests.support.maps import random_map, random_unplaced_map
from tests.support.seen_page import Seen, coloured, reddish
from tests.support.viewer import MISSING, QUERY_POSE, ViewerWorld, make_world, running_viewer

pytestmark = pytest.mark.slow


CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> ViewerWorld:
    return make_world(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="module")
def url(world: ViewerWorld) -> Iterator[str]:
    tracks = [read_trajectory_csv(world.track)]
    scene = build_scene(world.database, world.database.snapshot(), tracks)
    with running_viewer(world.database, scene, world.photos) as address:
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Debian's Chromium with software OpenGL; Playwright's own browsers are not downloaded."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    options = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    options += ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield running
        running.close()


@pytest.fixture
def seen(browser: Browser) -> Iterator[Seen]:
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    watched = Seen(page)
    page.on("request", lambda request: watched.requests.append(request.url))
    page.on("pageerror", lambda error: watched.errors.append(str(error)))
    page.on(
        "console",
        lambda told: watched.errors.append(told.text) if told.type in ("error", "warning") else None,
    )
    yield watched
    page.close()
    assert watched.errors == []


def test_everything_comes_from_this_server(seen: Seen, url: str) -> None:
    seen.open(url)
    seen.page.click("#view-space")
    seen.click_photo(0, 0)
    seen.page.wait_for_selector("#picture img")
    hosts = {urlsplit(r).netloc for r in seen.requests if urlsplit(r).scheme not in ("data", "blob")}
    assert hosts == {urlsplit(url).netloc}
    assert any(r.endswith("three.module.min.js") for r in seen.requests)


def test_a_view_is_pointed_at_right_before_its_first_frame(seen: Seen, url: str) -> None:
    seen.open(url)
    spot = "viewer.stage.project(viewer.place.maps[0].photos[0].center)"
    at_once = seen.of_viewer(f"(viewer.view('space'), {spot})")
    seen.frame()
    assert at_once is not None
    assert at_once == pytest.approx(seen.of_viewer(spot), abs=0.01)


def test_points_are_drawn_and_a_map_can_be_hidden(seen: Seen, url: str) -> None:
    seen.open(url)
    seen.only("points")
    all_maps = seen.pixels()
    assert reddish(all_maps) > 1000
    seen.page.get_by_label("Show field (flat)").uncheck()
    without = seen.pixels()
    assert reddish(without) < 0.05 * reddish(all_maps)
    assert coloured(without) > 200  # the child's points are still there
    seen.page.locator("#statuses label", has_text="quarantined").locator("input").uncheck()
    # What is left is north arrow and scale bar.
    assert coloured(seen.pixels()) < coloured(without) - 200


def test_colours_say_status_and_height(seen: Seen, url: str) -> None:
    seen.open(url)
    seen.only("points")
    seen.page.select_option("#colour", "status")
    by_status = seen.pixels()
    assert int((np.abs(by_status - [42, 125, 63]).max(axis=2) < 40).sum()) > 1000  # active, as the legend
    seen.page.select_option("#colour", "height")
    assert reddish(seen.pixels()) < 100
    assert "m" in seen.page.locator("#legend .ends").inner_text()


def test_both_views_show_the_points(seen: Seen, url: str) -> None:
    seen.open(url)
    seen.only("points")
    plan = seen.pixels()
    seen.page.click("#view-space")
    space = seen.pixels()
    assert reddish(space) > 1000
    assert (plan != space).any(axis=2).sum() > 2000


def test_north_is_up_and_the_scale_is_true(seen: Seen, url: str) -> None:
    seen.open(url)
    here = seen.of_viewer("viewer.stage.project([0, 0, 0])")
    assert isinstance(here, list)
    north, east = (seen.of_viewer(f"viewer.stage.project({spot})") for spot in ("[0, 10, 0]", "[10, 0, 0]"))
    assert north[0] == pytest.approx(here[0], abs=1e-3)  # type: ignore[index]
    assert north[1] < here[1]  # type: ignore[index]
    assert east[1] == pytest.approx(here[1], abs=1e-3)  # type: ignore[index]
    bar = seen.page.locator("#scale-bar").bounding_box()
    assert bar is not None
    metres = float(seen.page.locator("#scale-text").inner_text().removesuffix(" m"))
    per_pixel = 10.0 / (east[0] - here[0])  # type: ignore[index]
    assert bar["width"] * per_pixel == pytest.approx(metres, rel=0.02)


@pytest.mark.parametrize("view", ["#view-plan", "#view-space"])
def test_a_click_on_a_photo_shows_its_picture_and_its_pose(
    seen: Seen, url: str, world: ViewerWorld, view: str
) -> None:
    seen.open(url)
    seen.page.click(view)
    seen.frame()
    seen.click_photo(0, 3)
    seen.page.wait_for_selector("#picture img")
    image = world.field.images[3]
    easting, northing, height = world.field.frame.utm_from_enu(image.cam_from_local.center, world.field.epsg)
    rows = seen.panel()
    assert seen.page.locator("#panel h2").inner_text() == image.name
    assert float(rows["easting"].removesuffix(" m")) == pytest.approx(easting, abs=1e-3)
    assert float(rows["northing"].removesuffix(" m")) == pytest.approx(northing, abs=1e-3)
    assert rows["height"] == f"{height:.3f} m, ellipsoidal"
    assert rows["owner"] == "Ann & <b>Bo</b>"  # text, not HTML
    # The picture is the photo's own, by its pixels.
    shown = seen.page.locator("#picture img")
    size = shown.evaluate("(i) => [i.naturalWidth, i.naturalHeight]")
    assert size == [640, 480]
    drawn = shown.evaluate(
        "(i) => { const c = document.createElement('canvas'); c.width = 64; c.height = 48;"
        "const x = c.getContext('2d'); x.drawImage(i, 0, 0, 64, 48);"
        "return Array.from(x.getImageData(0, 0, 64, 48).data).filter((_, k) => k % 4 === 0); }"
    )
    photo = Image.open(world.photos / image.name).resize((64, 48), Image.Resampling.BOX)
    assert np.corrcoef(np.asarray(photo, dtype=float).ravel(), drawn)[0, 1] > 0.95


def test_a_photo_that_is_not_there_is_said_to_be_missing(seen: Seen, url: str, world: ViewerWorld) -> None:
    seen.open(url)
    row = [image.name for image in world.field.images].index(MISSING)
    # Chromium reports an answer of 404 in the console, which is no failure of the page.
    seen.click_photo(0, row)
    seen.page.wait_for_selector("#picture .note:has-text('No picture')")
    assert "there is no such file" in seen.page.locator("#picture").inner_text()
    seen.errors[:] = [e for e in seen.errors if "404" not in e]


def test_a_query_shows_its_answer_overlay_inliers_and_ellipse(
    seen: Seen, url: str, world: ViewerWorld
) -> None:
    seen.open(url)
    seen.page.set_input_files("#file", world.query)
    seen.page.wait_for_selector("#panel .good")
    rows = seen.panel()
    utm = np.array([float(rows[name].split(" m")[0]) for name in ("easting", "northing", "height")])
    enu = world.field.frame.enu_from_utm(utm, world.field.epsg)
    # The lens is not told, and over flat ground height and focal length are hard to tell apart.
    np.testing.assert_allclose(enu[:2], QUERY_POSE.center[:2], atol=0.5)
    assert int(rows["inliers"]) >= 50
    assert seen.page.locator("#panel img").evaluate("(i) => i.complete && i.naturalWidth") == 640
    assert "95 %" in seen.page.locator("#panel .ellipse").inner_text()
    drawn = seen.of_viewer(
        "({ellipse: viewer.selection.children[1].children[1].geometry.attributes.position.array.length / 3,"
        "inliers: viewer.selection.children[2].children[1].geometry.attributes.position.count})"
    )
    assert drawn == {"ellipse": 96, "inliers": int(rows["inliers"])}
    # Inliers are drawn in the answer's green.
    assert int((np.abs(seen.pixels() - [10, 143, 60]).max(axis=2) < 30).sum()) > 300


def test_a_photo_of_elsewhere_is_not_localised_and_says_why(seen: Seen, url: str, world: ViewerWorld) -> None:
    seen.open(url)
    data = world.elsewhere.read_bytes()
    transfer = seen.page.evaluate_handle(
        "(bytes) => { const t = new DataTransfer();"
        "t.items.add(new File([new Uint8Array(bytes)], 'elsewhere.png')); return t; }",
        list(data),
    )
    seen.page.dispatch_event("#canvas", "drop", {"dataTransfer": transfer})
    seen.page.wait_for_selector("#panel .bad")
    assert seen.page.locator("#panel .bad").inner_text().startswith("Not localised: TOO_FEW_")
    assert seen.of_viewer("viewer.selection.children.length") == 0


def test_what_is_no_photo_is_refused_in_words(seen: Seen, url: str, world: ViewerWorld) -> None:
    seen.open(url)
    seen.page.set_input_files("#file", world.track)
    seen.page.wait_for_selector("#panel .note:has-text('No answer')")
    seen.errors[:] = [e for e in seen.errors if "400" not in e]


def test_a_track_plays_and_tells_what_is_lost(seen: Seen, url: str) -> None:
    seen.open(url)
    moment = seen.page.locator("#moment")
    assert "relocalised" in moment.inner_text()
    start = seen.of_viewer("viewer.player.frame.pose.center[0]")
    seen.page.locator("#time").fill("0.9")
    assert "lost" in moment.inner_text()
    assert "too dark" in moment.inner_text()
    assert seen.of_viewer("viewer.player.camera") is None
    seen.page.locator("#time").fill("0")
    seen.page.select_option("#speed", "10")
    seen.page.get_by_label("Play", exact=True).click()
    seen.page.wait_for_selector("#moment:has-text('frame 10')")
    seen.page.wait_for_selector("#play[aria-label=Play]")  # it stops at the end
    end = seen.of_viewer("viewer.player.frame.pose.center[0]")
    assert end - start == pytest.approx(40.0, abs=0.05)  # type: ignore[operator]


def test_a_track_alone_is_shown(seen: Seen, world: ViewerWorld, tmp_path: Path) -> None:
    database = Database.create(tmp_path / "empty.db")
    scene = build_scene(database, database.snapshot(), [read_trajectory_csv(world.track)])
    with running_viewer(database, scene) as address:
        seen.open(address)
        seen.page.locator("#time").fill("2")
        assert "frame 10" in seen.page.locator("#moment").inner_text()
        assert coloured(seen.pixels()) > 500
        seen.page.locator("#canvas").hover(position={"x": 300, "y": 200})
        seen.page.wait_for_selector("#readout:has-text('EPSG:32632')")


def test_the_lineage_is_a_tree_whose_maps_can_be_opened(seen: Seen, url: str, world: ViewerWorld) -> None:
    seen.open(url)
    below = seen.page.locator("#tree > li", has=seen.page.locator("button[title=field]")).locator("ul button")
    assert below.get_attribute("title") == "child"
    below.click()
    assert seen.page.locator("#panel h2").inner_text() == "random map 3"
    rows = seen.panel()
    assert rows["status"] == "quarantined"
    assert rows["lineage"] == "1 step from anchor field"
    seen.page.locator("#panel dd button", has_text="field (flat)").click()
    assert seen.page.locator("#panel .photos button").count() == 9
    seen.page.get_by_role("button", name="Fit").click()
    wide = seen.of_viewer("viewer.stage.widthOfPlan")
    seen.of_viewer("viewer.stage.zoom(0.2)")
    seen.page.get_by_role("button", name="Go there").click()
    assert seen.of_viewer("viewer.stage.widthOfPlan") < 2.5 * wide  # type: ignore[operator]
    panel = seen.page.locator("#panel").bounding_box()
    assert panel is not None
    for row in range(len(world.field.images)):  # all of them beside the panel
        at = seen.of_viewer(f"viewer.stage.project(viewer.place.maps[0].photos[{row}].center)")
        assert 0 < at[0] < panel["x"] - 284  # type: ignore[index]
        assert 0 < at[1] < 720  # type: ignore[index]


def test_it_can_be_used_by_keyboard(seen: Seen, url: str) -> None:
    seen.open(url)
    seen.page.locator("#canvas").focus()
    before = seen.of_viewer("viewer.stage.metresPerPixel")
    seen.page.keyboard.press("+")
    assert seen.of_viewer("viewer.stage.metresPerPixel") < before  # type: ignore[operator]
    at = seen.of_viewer("viewer.stage.project([0, 0, 0])")
    seen.page.keyboard.press("ArrowLeft")
    assert seen.of_viewer("viewer.stage.project([0, 0, 0])")[0] != at[0]  # type: ignore[index]
    seen.page.locator("#tree button[title=field]").focus()
    seen.page.keyboard.press("Enter")
    seen.page.locator("#panel .photos button").first.focus()
    seen.page.keyboard.press("Enter")
    seen.page.wait_for_selector("#picture img")


def test_the_static_page_needs_no_server(seen: Seen, world: ViewerWorld, tmp_path: Path) -> None:
    scene = build_scene(world.database, world.database.snapshot(), [read_trajectory_csv(world.track)])
    out = tmp_path / "sent.html"
    assert write_static_page(out, scene, Pictures(world.photos)) == out.stat().st_size
    seen.open(out.as_uri())
    schemes = {urlsplit(request).scheme for request in seen.requests}
    assert schemes <= {"file", "data", "blob"}
    assert [r for r in seen.requests if r.startswith("file:")] == [out.as_uri()]
    seen.only("points", "photos")
    assert reddish(seen.pixels()) > 1000
    seen.click_photo(0, 3)
    seen.page.wait_for_selector("#picture img")
    assert seen.page.locator("#picture img").evaluate("(i) => i.naturalWidth") == 480
    assert not seen.page.locator("#drop").is_visible()
    assert "featuredb view" in seen.page.locator("#no-queries").inner_text()


def test_places_far_apart_are_shown_one_at_a_time(seen: Seen, tmp_path: Path) -> None:
    with running_viewer(varied_database(tmp_path / "maps.db")) as address:
        seen.open(address)
        assert seen.page.locator("#place option").count() == 4
        for number in range(4):
            seen.page.select_option("#place", str(number))
            seen.page.wait_for_function(f"() => window.featuredb.then((v) => v.number === {number})")
            name = seen.of_viewer("viewer.place.maps[0].id")
            seen.page.wait_for_selector(f"#tree button[title='{name}']")
            seen.only("points", "photos")
            assert coloured(seen.pixels()) > 500


def test_a_map_without_a_place_is_shown_in_its_own_frame_and_says_how_to_place_it(
    seen: Seen, tmp_path: Path
) -> None:
    database = Database.create(tmp_path / "maps.db")
    unplaced = random_unplaced_map(1)
    database.commit_maps([random_map(2), unplaced])
    options = ViewerSceneOptions(photos=tmp_path / "my photos")
    scene = build_scene(database, database.snapshot(), options=options)
    with running_viewer(database, scene) as address:
        seen.open(address)
        assert not seen.page.locator("#own-frame").is_visible()
        seen.page.select_option("#place", label="random map 1, no place on Earth")
        seen.page.wait_for_selector("#own-frame:has-text('No place on Earth')")
        assert not seen.page.locator("#north").is_visible()
        seen.page.wait_for_selector("#scale-text:has-text(' units')")  # of the next frame that is drawn
        seen.only("points", "photos")
        assert coloured(seen.pixels()) > 500
        seen.page.locator("#canvas").hover(position={"x": 300, "y": 200})
        seen.page.wait_for_selector("#readout:has-text('units, no place on Earth')")
        seen.page.wait_for_timeout(300)  # longer than a spot on Earth would be asked for
        assert not [request for request in seen.requests if "/api/where" in request]
        seen.page.locator("#tree button[title=map-1]").click()
        command = f"featuredb anchor {database.url} map-1 --photos '{tmp_path}/my photos' --page"
        assert seen.page.locator("#place-this-map").inner_text() == command
        assert seen.page.locator("#panel li").all_inner_texts() == ["place it by picks"]
        assert not {"zone", "placed by"} & seen.panel().keys()
        seen.page.locator("#panel .photos button").first.click()
        rows = seen.panel()
        assert float(rows["x"]) == pytest.approx(unplaced.images[0].cam_from_local.center[0], abs=1e-3)
        assert not {"easting", "latitude", "zone"} & rows.keys()
        seen.page.wait_for_selector("#picture .note:has-text('No picture')")
    seen.errors[:] = [e for e in seen.errors if "404" not in e]


def test_an_empty_database_says_so(seen: Seen, tmp_path: Path) -> None:
    with running_viewer(Database.create(tmp_path / "empty.db")) as address:
        seen.open(address)
        assert "no map" in seen.page.locator("#message").inner_text()
