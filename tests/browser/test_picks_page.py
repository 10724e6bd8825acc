"""The page of picks in a real Chromium: a map without a place is placed on a scan by a person's clicks."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import requests
from playwright.sync_api import Browser, Page

from featuredb.features.decode import INGEST_LIMITS, decode_gray
from featuredb.geometry.sim3 import Sim3
from featuredb.lidar.add import add_scan
from featuredb.store import Database
from ingest.anchoring import AnchorRequest
from ingest.register.picks_page.server import create_app
from ingest.register.picks_page.session import PickSession
from reloc.listening import listen, uvicorn_server
from reloc.localise.result import LocaliseRequest
from reloc.localiser import Localiser
from reloc.viewer.server import HOST
from tests.browser.test_viewer import browser as browser
from tests.support.hill_map import hill_map
from tests.support.hill_photos import CAMERA, FRAME, hill_height, hill_photos
from tests.support.hill_scan import write_hill_scan
from tests.support.maps import without_place

pytestmark = pytest.mark.slow
OFFSET = np.array([1.5, -1.0, 8.0])
SPOTS = [(0.2, 0.2), (0.8, 0.22), (0.78, 0.8), (0.22, 0.78), (0.5, 0.4), (0.45, 0.65), (0.7, 0.5)]


@pytest.fixture(scope="module", autouse=True)
def _two_frames() -> Iterator[None]:
    """Two that agree are enough."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ingest.anchoring.FRAMES", 2)
        yield


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> PickSession:
    made, root = hill_map(tmp_path_factory), tmp_path_factory.mktemp("picks")
    (summary,) = Database.open(made / "db").snapshot().maps()
    placed = Database.open(made / "db").snapshot().load_map(summary.map_id)
    turn = Sim3.exp(np.array([0.3, 0.2, -0.1, 2.0, 5.0, -9.0, 4.0]))
    database = Database.create(root / "db")
    database.commit_map(without_place(placed, turn))
    add_scan(database, [write_hill_scan(root / "s.laz", offset_m=tuple(OFFSET), texture_seed=1)])
    snapshot = database.snapshot()
    (summary,) = snapshot.unplaced_maps()
    request = AnchorRequest(map_id=summary.map_id, photos=made / "photos", out=root / "out")
    return PickSession(database, request, snapshot.load_any(summary.map_id))


@pytest.fixture(scope="module")
def url(session: PickSession) -> Iterator[str]:
    server = uvicorn_server(create_app(session, "token"))
    with listen(HOST, 0) as bound:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [bound]})
        thread.start()
        end = time.monotonic() + 90.0  # a busy machine draws the overlay late
        while not server.started:
            assert time.monotonic() < end, "the page did not start in time"
            time.sleep(0.01)
        yield f"http://127.0.0.1:{bound.getsockname()[1]}"
        server.should_exit = True
        thread.join(30.0)


def click(page: Page, side: str, at: list[float]) -> None:
    """A real click at a place of one picture."""
    x, y = page.evaluate(f"window.featuredb.then((p) => p.panes.{side}.toScreen({at[0]}, {at[1]}))")
    page.locator(f"#{side}").click(position={"x": x, "y": y})


def until(page: Page, condition: str) -> None:
    """Wait for what holds in the page; its policy lets nothing be evaluated from a string inside it."""
    end = time.monotonic() + 90.0  # a busy machine draws the overlay late
    while not page.evaluate(f"window.featuredb.then((p) => {condition})"):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(50)


def test_a_map_is_placed_by_clicks(browser: Browser, session: PickSession, url: str, tmp_path: Path) -> None:
    truth = {p.name: p for p in hill_photos()}
    page = browser.new_page(viewport={"width": 1500, "height": 800})
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("response", lambda r: errors.append(f"{r.status} {r.url}") if r.status >= 400 else None)
    page.goto(f"{url}/token/")
    photo = page.evaluate("window.featuredb.then((p) => p.photo)")
    pose = truth[photo["name"]].cam_from_local

    def on_ground(x: float, y: float) -> list[float]:
        """Where the picture of the scan shows what the photo shows there."""
        ray = pose.rotation.T @ [*CAMERA.unproject([[x, y]])[0], 1.0]
        depth = np.linspace(5, 200, 40_000)
        along = pose.center + depth[:, None] * ray
        hit = along[np.argmax(along[:, 2] <= hill_height(along[:, 0], along[:, 1]))] + OFFSET
        local = session.cloud.frame.enu_from(FRAME).act(hit)
        return [(local[0] - session.ground.west) / session.ground.pixel_m,
                (session.ground.north - local[1]) / session.ground.pixel_m]  # fmt: skip

    for k, (u, v) in enumerate(SPOTS):
        at = [u * CAMERA.width, v * CAMERA.height]
        ground = on_ground(*at)
        click(page, "photo", at if k != 4 else [at[0] + 90, at[1] - 60])  # the fifth is wrong
        click(page, "ground", ground)
    page.wait_for_selector("tr.wrong")
    wrong = page.locator("tr.wrong .number").all_inner_texts()
    assert wrong == ["5"]
    before = page.evaluate(
        "window.featuredb.then((p) => Math.max(...p.told.picks.map((q) => q.residual_px)))"
    )
    page.screenshot(path=str(tmp_path / "wrong.png"))
    page.get_by_label("Remove pick 5").click()
    until(
        page,
        "!document.querySelector('tr.wrong') && p.told.picks.length === 6 && p.panes.photo.layer !== null",
    )
    after = page.evaluate("window.featuredb.then((p) => Math.max(...p.told.picks.map((q) => q.residual_px)))")
    assert after < 12 < before
    page.screenshot(path=str(tmp_path / "right.png"))
    page.locator("#refine").click()
    page.wait_for_selector("#confirm:enabled", timeout=180_000)
    page.locator("#confirm").click()
    page.wait_for_selector("#result[data-placed]", timeout=180_000)
    page.screenshot(path=str(tmp_path / "placed.png"))
    assert page.locator("#result").get_attribute("data-placed") == "true", page.locator(
        "#result"
    ).inner_text()
    page.close()
    assert errors == []

    other = next(name for name in truth if name != photo["name"])
    placed = session.database.snapshot().load_map(session.map.map_id)
    image = next(i for i in placed.images if i.name == other)
    center = FRAME.enu_from(placed.frame).act(image.cam_from_local.center)
    assert np.linalg.norm(center - truth[other].cam_from_local.center - OFFSET) < 0.3
    gray = decode_gray(session.request.photos / other, INGEST_LIMITS)
    answer = Localiser.open(session.database).localise(gray, LocaliseRequest())
    assert answer.pose is not None, answer.detail
    assert answer.pose.map_ids[0] == session.map.map_id


def test_other_pages_find_nothing(url: str) -> None:
    assert requests.get(f"{url}/api/state", timeout=10).status_code == 404
    assert (
        requests.get(f"{url}/token/api/state", timeout=10, headers={"Host": "evil.example"}).status_code
        == 400
    )
