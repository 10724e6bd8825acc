"""The gateway's phone page in a real Chromium whose camera shows a photo of the map."""

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from featuredb.geo.local_frame import LocalFrame
from featuredb.store import Database
from reloc.service.options import ServeOptions
from reloc.service.serve import start_server
from tests.browser.test_viewer import CHROMIUM
from tests.support.gateway import RunningGateway, running_gateway
from tests.support.planar_map import EASTING, EPSG, HEIGHT, NORTHING, field_texture, planar_map, render, view

pytestmark = pytest.mark.slow

POSE = view(4, -6, 40, 10, 33)
FRAME = LocalFrame.from_utm(EASTING, NORTHING, HEIGHT, EPSG)
PHONE = {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningGateway]:
    database = Database.create(tmp_path_factory.mktemp("phone") / "field")
    database.commit_map(planar_map(1))
    with (
        # What a busy machine makes of a deadline is no question of the page.
        start_server(database, ServeOptions(listen=("tcp/127.0.0.1:0",), deadline_s=120.0)) as server,
        running_gateway(server.endpoints[0], prefix="/vps", timeout_s=120.0) as running,
    ):
        yield running


@pytest.fixture(scope="module")
def picture() -> bytes:
    return bytes(cv2.imencode(".jpg", render(field_texture(1), POSE, seed=50))[1])


@pytest.fixture(scope="module")
def browser(picture: bytes, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    film = tmp_path_factory.mktemp("camera") / "camera.mjpeg"
    film.write_bytes(5 * picture)
    options = ["--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={film}"]
    options += ["--no-sandbox"] if os.geteuid() == 0 else []
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=options)
        yield running
        running.close()


def opened(browser: Browser, url: str, wrong: list[str], permissions: list[str]) -> Page:
    place = {"latitude": FRAME.latitude_deg, "longitude": FRAME.longitude_deg, "accuracy": 20.0}
    context = browser.new_context(
        viewport=PHONE, is_mobile=True, has_touch=True, permissions=permissions, geolocation=place
    )
    page = context.new_page()
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    page.on("request", lambda asked: None if asked.url.startswith(url) else wrong.append(asked.url[:60]))
    page.add_init_script(
        "const send = fetch; window.fetch = (to, what) =>"
        " { window.sentPrior = what.body.get('prior'); return send(to, what); };"
    )
    page.goto(f"{url}/phone")
    return page


def state(page: Page, *wanted: str) -> str:
    """The page's state, once it is one of these; its policy lets nothing be waited for inside it."""
    end = time.monotonic() + 90.0  # a busy machine answers late
    while (found := page.evaluate("document.body.dataset.state")) not in wanted:
        assert time.monotonic() < end, page.locator("#message").inner_text()
        page.wait_for_timeout(50)
    return str(found)


def test_the_camera_is_asked_and_the_pose_is_drawn_over_its_photo(
    browser: Browser, gateway: RunningGateway, tmp_path: Path
) -> None:
    wrong: list[str] = []
    page = opened(browser, gateway.url, wrong, ["camera", "geolocation"])
    page.locator("#ask:enabled").wait_for(timeout=30_000)
    page.locator("#ask").tap()
    assert state(page, "found", "refused", "unknown") == "found", page.locator("#message").inner_text()
    told = dict(zip(page.locator("dt").all_inner_texts(), page.locator("dd").all_inner_texts(), strict=True))
    latitude, longitude = (float(told[name].rstrip("°")) for name in ("Latitude", "Longitude"))
    assert np.linalg.norm(FRAME.enu_from_geodetic((latitude, longitude, HEIGHT))[:2] - POSE.center[:2]) < 0.5
    # It looks down by 80 degrees, towards 33 from the frame's north.
    heading, pitch = (float(part.split("°")[0]) for part in told["Looks"].split(","))
    assert (heading, pitch) == (pytest.approx(33, abs=1.0), pytest.approx(-80, abs=0.5))
    prior = json.loads(page.evaluate("window.sentPrior"))
    assert prior == {"lat": FRAME.latitude_deg, "lon": FRAME.longitude_deg, "sigma_m": 20}
    green = page.evaluate(
        "(() => { const c = document.getElementById('shot');"
        " const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;"
        " for (let i = 0; i < d.length; i += 4) n += d[i + 1] > d[i] + 80; return n; })()"
    )
    assert green > 500  # circles around what agrees, over a grey photo
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.screenshot(path=str(tmp_path / "found.png"))
    page.locator("#ask").tap()  # back to the camera
    assert page.locator("#camera").is_visible()
    page.context.close()
    assert wrong == []


def test_without_a_camera_a_photo_is_chosen_and_refusals_are_told(
    browser: Browser, gateway: RunningGateway, picture: bytes, tmp_path: Path
) -> None:
    wrong: list[str] = []
    page = opened(browser, gateway.url, wrong, [])
    page.get_by_text("No camera here").wait_for(timeout=30_000)
    photo, text = tmp_path / "photo.jpg", tmp_path / "broken.jpg"
    photo.write_bytes(picture)
    text.write_bytes(b"no picture")
    page.locator("#file").set_input_files(photo)
    assert state(page, "found", "refused", "unknown") == "found"
    assert wrong == []
    page.locator("#file").set_input_files(text)
    assert state(page, "refused", "unknown") == "refused"
    assert "BAD_IMAGE" in page.locator("#message").inner_text()
    elsewhere = bytes(cv2.imencode(".png", render(field_texture(9), POSE, seed=1))[1])
    photo.write_bytes(elsewhere)
    page.locator("#file").set_input_files(photo)
    assert state(page, "unknown", "found") == "unknown"
    assert page.locator("#pose").is_hidden()
    page.context.close()


def test_the_page_loads_its_own_files_only_and_holds_to_its_policy(gateway: RunningGateway) -> None:
    page = gateway.get("/phone")
    policy = page.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert [gateway.get(f"/phone/{name}").status_code for name in ("phone.js", "phone.css")] == [200, 200]
    for name in ("gone.js", "..%2Fapp.py", "%2e%2e"):
        assert gateway.get(f"/phone/{name}").status_code == 404
